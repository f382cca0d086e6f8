"""What all interpolating baselines share: rows, query axis, encoding, state."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.data.target import Kind, Target
from gsparc.models.method import Method, Prediction
from gsparc.models.target_rows import heard_rows, power_rows, training_targets, unheard_note
from gsparc.processes.powers import PowerRows
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch


def _runs_note(data: Measurements, rows: np.ndarray) -> tuple[str, ...]:
    """What a reader must know of channels of several runs that are learned as
    if they were of one.
    """
    count = len(np.unique(data.runs_of(rows))) if data.site.target.is_complex else 0
    note = (
        f"channels of {count} runs, each with a factor of its own, are taken as one; "
        "dataset.runs=[...] keeps"
    )
    return (f"{note} some, model=complex_gp learns the factors",) if count > 1 else ()


class Interpolator(Method):
    """Learns from `fold.train` and `fold.val` together (nothing is chosen on `val`)
    and looks up positions.

    The query is the position of the moving end; orientations are not used.
    """

    both_ends = True
    shape: tuple[int, ...] = ()
    seen = 0

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Fit on train and val rows; `ValueError` when there are none,
        or what it learned is not stored.
        """
        all_rows = fold.learned()
        rows = all_rows if self.uses_censored else heard_rows(data, all_rows)
        if not len(rows):
            raise ValueError(f"{self.name}: the training set is empty")
        start = Stopwatch()
        # Before learning, which asks for the kind and shape of targets.
        self.site, self.shape, self.seen = data.site, tuple(data.target.shape[1:]), len(rows)
        # What learning adds must be stored: a checkpoint
        # that lost it would fail only when it is read.
        before = set(vars(self))
        if self.uses_censored and data.site.target.is_level:
            notes = self._learn_powers(power_rows(data, rows))
        else:
            remarks = self._learn(data.moving[rows], training_targets(data, rows))
            notes = (*remarks, *unheard_note(data, all_rows, self.name))
        names = sorted(set(vars(self)) - before - set(self.stored))
        if names and type(self)._relearn is Method._relearn:
            raise ValueError(
                f"{self.name}: its checkpoint loses {', '.join(names)}: name it in `stored` "
                "(tensor, number, "
                "string) or make it again in `_relearn(state)`"
            )
        return FitReport(start.seconds, (*notes, *_runs_note(data, all_rows)))

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        return self._predict_at(query.places(self.fitted_site), query.tx.dtype)

    def _predict_at(self, queries: Tensor, dtype: torch.dtype) -> Prediction:
        """Predict at (B, 3) float64 [m], or (B, 6); see `Differentiable`."""
        # NumPy has no autograd: methods with gradients are `Differentiable`.
        return self._look_up(queries.detach().numpy())

    def state(self) -> dict[str, Any]:
        """Return the target shape, the number of rows, and what the subclass learned."""
        return {"shape": list(self.shape), "seen": self.seen, **super().state()}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.shape, self.seen = tuple(state["shape"]), int(state["seen"])
        super().restore(site, state)

    def count_components(self) -> int:
        """Return the number of stored training samples."""
        return self.seen

    @property
    def kind(self) -> Kind:
        """Kind of the targets that were learned."""
        return self.target.kind

    @property
    def target(self) -> Target:
        """What the targets are that were learned."""
        return self.fitted_site.target

    def _to_targets(self, rows: Tensor) -> Tensor:
        return self.target.to_targets(rows, self.shape)

    @abstractmethod
    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        """Learn positions (n, 3) float64 [m] and stored targets (n, ...);
        return notes for the report.
        """

    def _learn_powers(self, rows: PowerRows) -> tuple[str, ...]:
        """The same of powers, where it learns from rows of
        which a level is known too (`uses_censored`).
        """
        raise NotImplementedError(f"{self.name}: learns nothing from rows where nothing was heard")

    @abstractmethod
    def _look_up(self, queries: np.ndarray) -> Prediction:
        """Predict at (B, 3) float64 [m]."""


class Differentiable(Interpolator):
    """One whose `_answered` is followed by autograd, in the precision that it is given."""

    no_gradient: str | None = None

    @abstractmethod
    def _predict_at(self, queries: Tensor, dtype: torch.dtype) -> Prediction:
        """Predict at (B, 3) float64 [m], or (B, 6), as float32 or float64."""

    def _look_up(self, queries: np.ndarray) -> Prediction:
        return self._predict_at(torch.from_numpy(queries), torch.float32)
