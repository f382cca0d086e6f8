"""Evidence for a promise: the model's method fitted anew without whole blocks, and asked about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.apps.maps import intervals
from gsparc.apps.maps.intervals import HeldOutLevels, IntervalScales, calibrate
from gsparc.apps.maps.levels import measured_levels, predicted_levels
from gsparc.data.errors import DataError
from gsparc.data.executor import run_all
from gsparc.data.limits import POSITIVE, SHARE, Checked, or_null, setting, whole
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, SplitSettings
from gsparc.models.method import Method, predict_in_batches
from gsparc.prediction.predictor import update_extra
from gsparc.prediction.refit import Learned

KEY = "map"
CHUNK = 512  # rows predicted at a time
SIDES = (1.0, 2.0)  # of blocks, by turns: near and far rows alike
SHARE_OUT, ROWS_OUT = 0.2, 100  # of the rows, held out by each fit, and by all together at least


@dataclass(frozen=True)
class PromiseSettings(Checked):
    """How evidence is gathered.

    Attributes:
        share: of measurements that intervals hold.
        folds: fits, each without other blocks; more of few rows, until `ROWS_OUT` are held out.
        rows: of each fold that are asked about, at most, drawn evenly.
        block_m: side of the blocks, every second fold's twice that [m]; None: a tenth of the longer side.
        effort: of each refit; None: as the model was trained.
        seed: of the blocks.
    """

    share: float = setting(0.9, SHARE)
    folds: int = setting(4, whole(1))
    rows: int = setting(4000, whole(1))
    block_m: float | None = setting(None, or_null(POSITIVE))
    effort: float | None = setting(None, or_null(POSITIVE))
    seed: int = setting(0, whole(0))


@dataclass(frozen=True)
class Promise:
    """Evidence, and where was measured; stored with a model.

    Attributes:
        evidence: of held-out rows.
        known: (n, 3) or (n, 6) local places that the model learned from [m].
        station: (n,) int64, which each is of.
        block_m: side of the smaller blocks [m].
    """

    evidence: HeldOutLevels
    known: np.ndarray
    station: np.ndarray
    block_m: float

    def calibration(self, share: float = 0.9) -> IntervalScales:
        """See `calibrate`."""
        return calibrate(self.evidence, share)

    def stations_of_place(self) -> int:
        """Return how many stations have a level at a place that was learned from, in the mean."""
        links = np.column_stack([self.known, self.station])
        each = len(np.unique(links, axis=0)) / len(np.unique(self.known, axis=0))
        return max(round(each * float((self.evidence.side <= 0).mean())), 1)

    def distance(self, places: np.ndarray, station: int) -> np.ndarray:
        """Return how far local places (n, D) are from the nearest that was learned from (n,) [m]."""
        return intervals.nearest_distances(self.known, self.station, places, np.full(len(places), station))

    def expected_errors(self, places: np.ndarray, station: np.ndarray, spread_db: np.ndarray) -> np.ndarray:
        """Return root mean square errors (n,) [dB] of levels at local places (n, D) of stations (n,).

        NaN where they are refused: farther from what was learned than any error was tested.
        """
        far = intervals.nearest_distances(self.known, self.station, places, station)
        return self.calibration().half_and_error(spread_db, far, station)[1]

    def store(self, path: str | Path) -> None:
        """Store in a checkpoint; the file is rewritten whole or not at all."""
        update_extra(path, {KEY: asdict(self)})


def read_promise(extra: Mapping[str, Any]) -> Promise | None:
    """Return what a checkpoint's `extra` holds; None where its map was never calibrated."""
    state = extra.get(KEY)
    if state is None:
        return None
    evidence = HeldOutLevels(**{name: np.asarray(value) for name, value in state["evidence"].items()})
    return Promise(evidence, np.asarray(state["known"]), np.asarray(state["station"]), state["block_m"])


def gather_promise(learned: Learned, settings: PromiseSettings) -> Promise:
    """Learn `settings.folds` times without blocks of the training rows, and ask about these.

    Args:
        learned: the model, with its data.
        settings: see there.

    Raises:
        DataError: too few places for any block.
        ValueError: the method serves no part of the data.
    """
    data = learned.data
    places = data.moving[learned.rows]
    if settings.effort is not None:
        learned = replace(learned, context=replace(learned.context, effort=settings.effort))
    longest = float(np.ptp(places[:, -3:-1], axis=0).max())
    # A tenth of the site: blocks large against the distance between rows, and some hundred of them.
    side = settings.block_m or longest / 10
    if not side > 0:
        raise DataError("all rows are at one place: tested intervals need several; or promised=false")

    def evidence_without(number: int) -> HeldOutLevels:
        # Every second fold with sides twice as long, for evidence at larger distances.
        wide = side * SIDES[number % len(SIDES)]
        split = SplitSettings("blocks", side_m=wide, share=SHARE_OUT, val_fraction=0.1)
        cut = learned.cut_folds(1, settings.seed + number // len(SIDES), split)
        inner = learned.drop_unlearned(cut.folds[0])
        less = learned.unlearn(inner, split)
        rng = np.random.default_rng([settings.seed, number])
        tried = np.sort(rng.permutation(inner.test)[: settings.rows])
        # Blocks of two folds are never one, though they may hold the same rows.
        unit = cut.unit[tried] + number * (len(data) + 1)
        return held_out_evidence(less, data, replace(inner, test=tried), unit)

    folds = range(max(settings.folds, int(np.ceil(ROWS_OUT / SHARE_OUT / len(learned.rows)))))
    parts = run_all(evidence_without, folds, "fits without blocks of places")
    evidence = HeldOutLevels(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(HeldOutLevels))
    )
    return Promise(evidence, places, data.stations_of(learned.rows), side)


def held_out_evidence(method: Method, data: Measurements, fold: Fold, block: np.ndarray) -> HeldOutLevels:
    """Return evidence of a fold's test rows, by the `method` fitted to it; a `block` (n,) goes together."""
    rows, known = fold.test, np.concatenate([fold.train, fold.val])
    mean, spread = predict_rows(method, data, rows)
    level, side = measured_levels(data, rows)
    station = data.stations_of(rows)
    before = data.moving[known], data.stations_of(known)
    far = intervals.nearest_distances(*before, data.moving[rows], station)
    evidence = HeldOutLevels(level, mean, spread, far, block, station, side)
    return evidence.subset(np.flatnonzero(np.isfinite(level) & np.isfinite(mean) & np.isfinite(spread)))


def predict_rows(method: Method, data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level and deviation (n,) [dB] that `method` predicts for rows (n,).

    NaN where it has no answer.
    """
    mean, spread = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    for chosen, _, said in predict_in_batches(method, data, rows, CHUNK):
        mean[chosen], spread[chosen] = predicted_levels(said, data.site.kind, data.site.target_scale)
    return mean, spread
