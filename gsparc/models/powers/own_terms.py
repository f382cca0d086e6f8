"""Terms of a user's own (`model.terms`), as objects or as entries of a configuration; see docs/terms.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from gsparc.data.instantiate import find
from gsparc.processes.term import Columns


def columns_of(entry: Any) -> Columns:
    """Return a term as it is, or what `{term: module.Class, argument: value, ...}` describes.

    Raises:
        ValueError: there is no such class, it is no such term, or it does not take these arguments.
    """
    if isinstance(entry, Mapping):
        rest = {name: value for name, value in entry.items() if name != "term"}
        kind = find(str(entry.get("term")))
        if not isinstance(kind, type):
            raise ValueError(f"model.terms: {entry.get('term')!r} is no class that can be imported")
        try:
            entry = kind(**rest)
        except TypeError as error:
            raise ValueError(f"model.terms: {error}") from None
    if not isinstance(entry, Columns):
        raise ValueError(f"model.terms: {entry!r} is not a gsparc.processes.term.Columns")
    return entry


@dataclass(frozen=True)
class InWorld(Columns):
    """A term that is asked in the coordinates of the measurements.

    Attributes:
        term: of a user.
        origin: (3,) of local coordinates [m].
    """

    term: Columns
    origin: Tensor

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`; of places in local coordinates."""
        # Places are of one end (n, 3), or of both (n, 6).
        return self.term.columns(places + self.origin.repeat(places.shape[1] // 3))
