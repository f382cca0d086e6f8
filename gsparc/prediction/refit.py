"""A method with what it learned from, to be fitted again without some of it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsparc.data.inner_folds import InnerFolds, cut_folds
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, SplitSettings
from gsparc.models import fitting
from gsparc.models.abilities import Reconditions
from gsparc.models.device_offsets import without_devices
from gsparc.models.method import Method, MethodFactory
from gsparc.models.per_station import PerStation, stations_of_fold, wrap_per_station
from gsparc.training.context import FitContext


def forget(method: Method, data: Measurements, rows: np.ndarray) -> Method | None:
    """Return a method as it is but for its rows, which are these (n,) alone; None if it cannot."""
    if not isinstance(method, Reconditions):
        return None
    return method.copy_conditioned(without_devices(data, method.fitted_site), rows)


@dataclass(frozen=True)
class Learned:
    """A fitted method with what it learned from.

    Attributes:
        method: fitted on `fold`.
        factory: made it.
        data, fold: measurements and their rows.
        context: of the fit.
    """

    method: Method
    factory: MethodFactory
    data: Measurements
    fold: Fold
    context: FitContext

    @property
    def rows(self) -> np.ndarray:
        """Return those (n,) that were learned from, sorted."""
        return np.sort(self.fold.learned())

    def cut_folds(self, count: int, seed: int, split: SplitSettings | None = None) -> InnerFolds:
        """Return `count` folds of these rows, cut by `split`; None: as the test rows were."""
        return cut_folds(self.data, self.fold, split or self.context.split, count, seed)

    def refit(self, fold: Fold, context: FitContext) -> Method:
        """Return the method fitted anew on a fold."""
        return fitting.fit_or_resume(
            wrap_per_station(self.factory, self.data), self.data, fold, context
        )[0]

    def unlearn(self, fold: Fold, split: SplitSettings | None = None, anew: bool = False) -> Method:
        """Return a method that knows nothing of the test rows of a fold, which was cut by `split`.

        One that can forget rows does so, with its settings as they are; another one is fitted anew,
        as all are where `anew`.
        """
        if not anew:
            less = forget(self.method, self.data, np.sort(fold.learned()))
            if less is not None:
                return less
        # Nobody goes on from this fit: its checkpoints and curves go with the folder.
        with tempfile.TemporaryDirectory() as folder:
            context = replace(self.context, run_dir=Path(folder), split=split or self.context.split)
            return self.refit(fold, context)

    def drop_unlearned(self, fold: Fold) -> Fold:
        """Return a fold without test rows of stations that too few training rows are left of."""
        if not isinstance(self.method, PerStation):
            return fold
        # A station that was fitted on all rows may have too few of them in a fold.
        learnable = stations_of_fold(self.method.factory, self.data, fold).learnable
        return replace(fold, test=fold.test[learnable[self.data.stations_of(fold.test)]])
