"""Terms of a user's own (`model.terms`); see docs/terms.md."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsparc.processes.posterior import Exact
from gsparc.processes.term import Columns


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

    def check(self, places: Tensor) -> None:
        """Raise `ValueError` where columns at places (n, D) [m] have another shape or are not finite."""
        result = self.columns(places)
        if result.ndim != 2 or len(result) != len(places) or not result.isfinite().all():
            name, shape = type(self.term).__name__, (*result.shape,)
            raise ValueError(f"{name}.columns gave {shape}; ({len(places)}, Q) finite numbers are needed")


def learned(posterior: Exact, own: tuple[InWorld, ...]) -> list[str]:
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
