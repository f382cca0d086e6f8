"""Terms of a user's own (`model.terms`); see docs/terms.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.processes.places import of_both_ends
from gsparc.processes.posterior import Exact
from gsparc.processes.term import Columns


def as_terms(terms: Any) -> tuple[Columns, ...]:
    """Return terms (`model.terms`) as a tuple, one alone as of one; `ValueError` for what is none."""
    result = tuple(terms) if isinstance(terms, Sequence) else (terms,)
    for one in result:
        if not isinstance(one, Columns):
            raise ValueError(f"model.terms: {one!r} is not a gsparc.processes.term.Columns")
    return result


@dataclass(frozen=True)
class UserTerm(Columns):
    """A term that is asked of both ends in the coordinates of the measurements.

    Attributes:
        term: of a user.
        origin: (3,) of local coordinates [m].
        still: (3,) the end that stands, local [m]; NaN where unknown, or where both move.
    """

    term: Columns
    origin: Tensor
    still: Tensor

    @classmethod
    def of(cls, term: Columns, site: Site) -> UserTerm:
        """Return a term of a site of one station, or of ends that both move."""
        still = np.full_like(site.origin, np.nan) if site.static_position is None else site.static_position
        return cls(term, *(torch.from_numpy(np.asarray(one, np.float64)) for one in (site.origin, still)))

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`; of places of the moving end (n, 3), or of both (n, 6), in local coordinates."""
        both = places if of_both_ends(places) else torch.cat([places, self.still.expand_as(places)], 1)
        result = self.term.columns(both + torch.cat([self.origin, self.origin]))
        if not isinstance(result, Tensor):
            gave = f"{type(self.term).__name__}.columns gave {type(result).__name__}"
            raise ValueError(f"{gave}; a torch tensor ({len(places)}, Q) is needed")
        return result

    def check(self, places: Tensor) -> None:
        """Raise `ValueError` where columns at places (n, D) [m] have another shape or are not finite."""
        result = self.columns(places)
        if result.ndim != 2 or len(result) != len(places) or not result.isfinite().all():
            gave = f"{type(self.term).__name__}.columns gave {(*result.shape,)}"
            unknown = not of_both_ends(places) and not self.still.isfinite().all()
            why = ", but the place of the end that stands is not given" if unknown else ""
            raise ValueError(f"{gave}; ({len(places)}, Q) finite numbers are needed{why}")


def describe_weights(posterior: Exact, own: tuple[UserTerm, ...]) -> list[str]:
    """Return a sentence on each term: its weights [dB of a column's unit] and their deviations."""
    at = posterior.rows
    columns = posterior.prior.columns(at)
    weights, scale = (columns.T @ posterior.weights)[:, 0], posterior.prior.kernel.amplitude
    # Of weights of unit variance, times the amplitude: 1 - C^T K^-1 C.
    left = (scale * (1 - posterior.factor.whitened(columns).square().sum(0)).clamp_min(0)).sqrt()
    sizes = [one.columns(at[:1]).shape[1] for one in own]
    parts = (part[-sum(sizes) :].split(sizes) for part in (weights, left))
    return [
        f"{type(one.term).__name__}: " + ", ".join(f"{w:.3g} +- {d:.2g}" for w, d in zip(*both, strict=True))
        for one, *both in zip(own, *parts, strict=True)
    ]
