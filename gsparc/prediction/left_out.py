"""A method without some of its rows, and what it says of these: what tells how sure it may be."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.inner_folds import InnerFolds, cut_folds
from gsparc.data.schema import Measurements
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold
from gsparc.models import fitting
from gsparc.models.device_offsets import subtract_known_device_offsets
from gsparc.models.method import Method, MethodFactory, Prediction, Reconditions
from gsparc.models.per_station import PerStation, wrap_per_station
from gsparc.models.predicting import predict_in_batches
from gsparc.models.station_sites import stations_of_fold
from gsparc.prediction.confidence import KINDS, score_prediction
from gsparc.prediction.levels import measured_levels, predicted_levels
from gsparc.processes.uncertainty import censored_distribution
from gsparc.training.context import FitContext


def recondition_on_rows(method: Method, data: Measurements, rows: np.ndarray) -> Method | None:
    """Return a method as it is but for its rows, which are these (n,) alone; None if it cannot."""
    if not isinstance(method, Reconditions):
        return None
    return method.copy_conditioned(subtract_known_device_offsets(data, method.fitted_site), rows)


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
            less = recondition_on_rows(self.method, self.data, np.sort(fold.learned()))
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


CHUNK = 512  # rows whose levels are predicted at a time


@dataclass(frozen=True)
class Evidence:
    """Positions a method did not learn from.

    Attributes:
        row: (n,) rows of the dataset.
        position: (n, 3) [m].
        error: (n,) |e|^2 / |h|^2; for powers, of the linear power.
        scores: by kind, (n,) each, larger is surer.
    """

    row: np.ndarray
    position: np.ndarray
    error: np.ndarray
    scores: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.row)

    @staticmethod
    def join(parts: Sequence[Evidence]) -> Evidence:
        """Join folds, a row of several of them by the first;
        scores that not every part has are dropped.
        """
        first = np.sort(
            np.unique(np.concatenate([part.row for part in parts]), return_index=True)[1]
        )
        kinds = [kind for kind in KINDS if all(kind in part.scores for part in parts)]
        scores = {
            kind: np.concatenate([part.scores[kind] for part in parts])[first] for kind in kinds
        }
        facts = zip(*((part.row, part.position, part.error) for part in parts), strict=True)
        row, position, error = (np.concatenate(values)[first] for values in facts)
        return Evidence(row, position, error, scores)


def predict_rows(method: Method, data: Measurements, rows: np.ndarray) -> Prediction:
    """Return what a method says of rows (n,), in their order; see `predict_in_batches`."""
    order, _, answers = zip(*predict_in_batches(method, data, rows), strict=True)
    return Prediction.joined(answers, torch.from_numpy(np.argsort(np.concatenate(order))))


def gather_evidence(method: Method, data: Measurements, rows: np.ndarray) -> Evidence:
    """Return the errors of what `method` predicts of rows (n,), and its confidences."""
    return score_answers(
        predict_rows(method, data, rows), data.targets(rows), rows, data.moving[rows]
    )


def score_answers(
    prediction: Prediction, true: Tensor, rows: np.ndarray, places: np.ndarray
) -> Evidence:
    """Return relative errors of predictions of `true` (n, ...) at local places (n, D) [m],
    and their scores.

    A method that does not state a kind of score has none of it.
    """
    miss, power = ((x.abs().square().flatten(1).sum(1)) for x in (prediction.mean - true, true))
    # A silent row has no relative error: any miss of it counts as huge.
    error = (miss / power.clamp_min(1e-30)).double().numpy()
    score_of = {kind: score_prediction(kind, prediction) for kind in KINDS}
    # Scores with a NaN rank nothing.
    scores = {
        kind: score
        for kind, score in score_of.items()
        if score is not None and not np.isnan(score).any()
    }
    return Evidence(rows, places, error, scores)


@dataclass(frozen=True)
class HeldOutLevels:
    """Rows predicted by models that did not learn from the block of places around them.

    Attributes:
        level_db: (n,) measured [dB]; of censored rows, the level they lie below or above.
        mean_db, spread_db: (n,) predicted, and its deviation [dB].
        distance: (n,) to the nearest place that was learned from [m].
        block: (n,) int64, rows of one were held out together.
        station: (n,) int64; 0 where there is one.
        side: (n,) int8, 1 where the power lies below its level, -1 where above, 0 where it was
            measured.
    """

    level_db: np.ndarray
    mean_db: np.ndarray
    spread_db: np.ndarray
    distance: np.ndarray
    block: np.ndarray
    station: np.ndarray
    side: np.ndarray

    def __len__(self) -> int:
        return len(self.level_db)

    def subset(self, rows: np.ndarray) -> HeldOutLevels:
        """Return some of them, by their numbers or a mask (n,)."""
        return HeldOutLevels(*(getattr(self, field.name)[rows] for field in fields(self)))

    @staticmethod
    def join(parts: Sequence[HeldOutLevels]) -> HeldOutLevels:
        """Return the rows of all."""
        names = [field.name for field in fields(HeldOutLevels)]
        return HeldOutLevels(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
        )

    @property
    def heard(self) -> np.ndarray:
        """Whether a level was measured (n,)."""
        return self.side == 0

    @property
    def error(self) -> np.ndarray:
        """Measured less predicted (n,), in deviations; of censored rows what bounds it."""
        return (self.level_db - self.mean_db) / self.spread_db

    def distribution(self) -> tuple[np.ndarray, np.ndarray]:
        """Return errors (m,) in deviations and their masses, see `censored_distribution`."""
        return censored_distribution(self.error, self.side)


def unlearn_and_predict(
    learned: Learned,
    fold: Fold,
    block: np.ndarray,
    split: SplitSettings | None = None,
    anew: bool = False,
) -> HeldOutLevels:
    """Return the test rows of a fold cut by `split` as its other rows predict them,
    see `held_out_levels` and, of `anew`, `Learned.unlearn`.
    """
    return held_out_levels(learned.unlearn(fold, split, anew), learned.data, fold, block)


def held_out_levels(
    method: Method, data: Measurements, fold: Fold, block: np.ndarray
) -> HeldOutLevels:
    """Return evidence of a fold's test rows, by the `method` fitted to it; a `block` (n,)
    goes together.

    Without rows that have no level, or of which the method predicts none.
    """
    rows, train_rows = fold.test, fold.learned()
    mean, spread = np.full((2, len(rows)), np.nan)
    for chosen, _, prediction in predict_in_batches(method, data, rows, CHUNK):
        mean[chosen], spread[chosen] = predicted_levels(
            prediction, data.site.kind, data.site.target_scale
        )
    level, side = measured_levels(data, rows)
    station = data.stations_of(rows)
    far = nearest_distances(
        data.moving[train_rows], data.stations_of(train_rows), data.moving[rows], station
    )
    levels = HeldOutLevels(level, mean, spread, far, block, station, side)
    return levels.subset(np.isfinite(level) & np.isfinite(mean) & np.isfinite(spread))


def nearest_distances(
    known: np.ndarray, known_station: np.ndarray, places: np.ndarray, station: np.ndarray
) -> np.ndarray:
    """Return how far places (n, D) are from the nearest `known` one (m, D) of their station,
    else any [m].
    """
    distance = np.full(len(places), np.inf)
    for number in np.unique(station):
        candidates = known[known_station == number]
        chosen = station == number
        distance[chosen] = cKDTree(candidates if len(candidates) else known).query(places[chosen])[
            0
        ]
    return distance
