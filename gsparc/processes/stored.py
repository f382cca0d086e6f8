"""Objects as the plain containers that checkpoints hold, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import entry_points
from typing import Any, Self

import numpy as np
import torch

PLUGINS = "gsparc.terms"  # entry points of installed kinds
MAIN = "__main__"  # module of what a notebook or script defines
KINDS: dict[str, type[Stored]] = {}  # by the name that `to_plain` gives them


def kind_name(kind: type) -> str:
    """Return the name that a class is stored by: with its module where that is not ours."""
    ours = kind.__module__.startswith("gsparc.")
    return kind.__name__ if ours else f"{kind.__module__}.{kind.__qualname__}"


class Stored:
    """A kind of objects that checkpoints hold, told by its class's name.

    Attributes may be numbers, strings, tensors, NumPy arrays, None, tuples, mappings,
    and such objects.
    """

    def __init_subclass__(cls, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        KINDS[kind_name(cls)] = cls

    def state(self) -> dict[str, Any]:
        """Return what `read` needs: the fields of a dataclass, else all attributes."""
        names = (
            [setting_field.name for setting_field in fields(self)]
            if is_dataclass(self)
            else vars(self)
        )
        return {name: to_plain(getattr(self, name)) for name in names}

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> Self:
        """Return the object whose `state()` this was."""
        return cls(**{name: from_plain(part) for name, part in state.items()})


def to_plain(part: Any) -> Any:
    """Return what `from_plain` reads.

    >>> to_plain((1.0, None, np.zeros(2)))
    [1.0, None, {'array': tensor([0., 0.], dtype=torch.float64)}]
    """
    if isinstance(part, Stored):
        return {"kind": kind_name(type(part)), "state": part.state()}
    if isinstance(part, np.ndarray):
        return {"array": torch.from_numpy(part)}
    return [to_plain(each) for each in part] if isinstance(part, (tuple, list)) else part


def from_plain(part: Any) -> Any:
    """Return what `to_plain` was given; lists as tuples.

    Raises:
        ValueError: see `find_kind`.
    """
    if isinstance(part, list):
        return tuple(from_plain(each) for each in part)
    if not isinstance(part, Mapping) or part.keys() not in ({"kind", "state"}, {"array"}):
        return part
    if "array" in part:
        return part["array"].numpy()
    return find_kind(str(part["kind"])).read(part["state"])


def find_kind(name: str) -> type[Stored]:
    """Return the kind that `to_plain` names so, of what was imported or is installed.

    Raises:
        ValueError: there is none.
    """
    if name not in KINDS:
        # What is installed may be imported, a file's word may not
        for point in entry_points(group=PLUGINS):
            if f"{point.module}.{point.attr}" == name:
                point.load()
    if name in KINDS:
        return KINDS[name]
    module = name.rpartition(".")[0]
    if not module:
        raise ValueError(f"{name!r} is of another version of gsparc: fit again")
    if module == MAIN:
        raise ValueError(
            f"{name!r} is of a notebook or script: define it here, too, before it is read"
        )
    raise ValueError(
        f"a term {name!r} is not known: in Python `import {module}` first; for commands install "
        "a package "
        f"that names it in the group {PLUGINS} of its entry points, see docs/terms.md"
    )
