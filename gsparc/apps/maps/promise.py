"""What a map promises: by the model's method fitted anew without whole blocks,
and asked about them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.intervals import Coverage, IntervalScales, calibrate, cross_validate
from gsparc.base.errors import DataError
from gsparc.base.executor import run_all
from gsparc.base.limits import POSITIVE, SHARE, Checked, or_null, setting, whole
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.prediction.left_out import (
    HeldOutLevels,
    Learned,
    nearest_distances,
    unlearn_and_predict,
)
from gsparc.processes.uncertainty import coverage_and_width
from gsparc.runs.open_runs import OpenRun

log = logging.getLogger(__name__)

KEY = "map"
SIDES = (1.0, 2.0)  # of blocks, by turns: near and far rows alike
QUARTERS, TURNS = 4, 2  # of the places, as they lie and turned
SHARE_OUT, ROWS_OUT = 0.2, 100  # of the rows, held out by each fit, and by all together at least


@dataclass(frozen=True)
class PromiseSettings(Checked):
    """How evidence is gathered.

    Attributes:
        share: of measurements that intervals hold.
        folds: fits, each without other blocks; more of few rows, until `ROWS_OUT` are held out.
        rows: of each fold that are asked about, at most, drawn evenly.
        block_m: side of the blocks, every second fold's twice that [m]; None: a tenth of the longer
            side.
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
        quarters: evidence of whole quarters held out, which tell of places that blocks are not as
            far from rows as; None: such places are refused.
    """

    evidence: HeldOutLevels
    known: np.ndarray
    station: np.ndarray
    block_m: float
    quarters: HeldOutLevels | None = None

    def calibration(self, share: float = 0.9) -> IntervalScales:
        """See `calibrate`."""
        return calibrate(self.evidence, share, self.quarters)

    def stations_of_place(self) -> int:
        """Return how many stations have a level at a place that was learned from, in the mean."""
        links = np.column_stack([self.known, self.station])
        each = len(np.unique(links, axis=0)) / len(np.unique(self.known, axis=0))
        return max(round(each * float((self.evidence.side <= 0).mean())), 1)

    def distances(self, places: np.ndarray, station: np.ndarray) -> np.ndarray:
        """Return how far local places (n, D) of stations (n,) are from the nearest that was learned
        from (n,) [m].
        """
        return nearest_distances(self.known, self.station, places, station)

    def distance(self, places: np.ndarray, station: int) -> np.ndarray:
        """Return `distances` of one station."""
        return self.distances(places, np.full(len(places), station))

    def within_reach(self, places: np.ndarray) -> np.ndarray:
        """Return which of local places (n, 3) may be near enough to a row for a promise (n,)."""
        if self.known.shape[1] > 3:  # of two ends that moved, one place alone tells nothing
            return np.ones(len(places), bool)
        return cKDTree(self.known).query(places)[0] <= self.calibration().reach

    def expected_errors(
        self, places: np.ndarray, station: np.ndarray, spread_db: np.ndarray
    ) -> np.ndarray:
        """Return root mean square errors (n,) [dB] of levels at local places (n, D)
        of stations (n,).

        NaN where they are refused: farther from what was learned than any error was tested.
        """
        far = self.distances(places, station)
        return self.calibration().half_and_error(spread_db, far, station)[1]

    def store(self, path: str | Path) -> None:
        """Store in a checkpoint; the file is rewritten whole or not at all."""
        checkpoint.update_extra(path, {KEY: asdict(self)})


def read_promise(extra: Mapping[str, Any]) -> Promise | None:
    """Return what a checkpoint's `extra` holds; None where its map was never calibrated."""
    state = extra.get(KEY)
    if state is None:
        return None

    def levels(name: str) -> HeldOutLevels | None:
        stored = state.get(name)  # files of before hold no quarters
        return stored and HeldOutLevels(**{key: np.asarray(v) for key, v in stored.items()})

    evidence = levels("evidence")
    assert evidence is not None
    known, station = np.asarray(state["known"]), np.asarray(state["station"])
    return Promise(evidence, known, station, state["block_m"], levels("quarters"))


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
        raise DataError(
            "all rows are at one place: tested intervals need several; or promised=false"
        )

    def evidence_without(number: int) -> HeldOutLevels:
        # Every second fold with sides twice as long, for evidence at larger distances.
        wide = side * SIDES[number % len(SIDES)]
        split = SplitSettings("blocks", side_m=wide, share=SHARE_OUT, val_fraction=0.1)
        cut = learned.cut_folds(1, settings.seed + number // len(SIDES), split)
        inner = learned.drop_unlearned(cut.folds[0])
        rng = np.random.default_rng([settings.seed, number])
        rows = np.sort(rng.permutation(inner.test)[: settings.rows])
        # Blocks of two folds are never one, though they may hold the same rows.
        unit = cut.unit[rows] + number * (len(data) + 1)
        return unlearn_and_predict(learned, replace(inner, test=rows), unit, split)

    def evidence_of_quarter(number: int) -> HeldOutLevels:
        quarter = number_quarters(places, turned=number >= QUARTERS)
        out = learned.rows[quarter == number % QUARTERS]
        kept = learned.rows[quarter != number % QUARTERS]
        inner = learned.drop_unlearned(Fold(kept, kept[:0], out))
        rng = np.random.default_rng([settings.seed, number, 1])
        rows = np.sort(rng.permutation(inner.test)[: settings.rows])
        # Settings are learned anew: those of all rows would know the quarter's trend.
        return unlearn_and_predict(
            learned, replace(inner, test=rows), np.full(len(rows), number), anew=True
        )

    folds = range(max(settings.folds, int(np.ceil(ROWS_OUT / SHARE_OUT / len(learned.rows)))))
    parts = run_all(evidence_without, folds, "fits without blocks of places")
    turns = range(QUARTERS * TURNS)
    quarters = run_all(evidence_of_quarter, turns, "fits without a quarter of the places")
    return Promise(
        HeldOutLevels.join(parts),
        places,
        data.stations_of(learned.rows),
        side,
        HeldOutLevels.join(quarters),
    )


def number_quarters(places: np.ndarray, turned: bool = False) -> np.ndarray:
    """Number (n,), 0 to 3, the half of either half that places (n, D) lie in, as many in each;
    `turned` by 45 degrees.
    """
    flat = places[:, -3:-1]
    if turned:
        flat = np.column_stack([flat.sum(1), flat @ [1.0, -1.0]])
    east = flat[:, 0] > np.median(flat[:, 0])
    north = np.zeros(len(flat), bool)
    for side in (east, ~east):
        if side.any():
            north[side] = flat[side, 1] > np.median(flat[side, 1])
    return 2 * east + north


def read_or_gather(
    run: OpenRun, settings: Mapping[str, Any], renew: bool = False
) -> Promise | None:
    """Return the evidence stored with a model, or gathered from its training data and then stored.

    Rows that were held out for a test are warned of: to a map they are places where nobody
    measured.

    Args:
        run: the model.
        settings: `promised`, without which there is none; `promise` of conf/map.yaml.
        renew: whether what is stored is gathered anew.

    Raises:
        DataError: the training data are gone, or are others.
    """
    how = PromiseSettings(**settings["promise"])
    if count := run.stored[0].extra.get("tested"):
        log.warning(
            "%d rows of its file were held out for the test and count as not measured here: "
            "train the final model with split=none",
            count,
        )
    if not settings["promised"]:
        return None
    promise = None if renew else read_promise(run.stored[0].extra)
    # Blocks of another size are other evidence, and files of before hold no quarters.
    whole = promise is not None and promise.quarters is not None
    if promise is not None and whole and how.block_m in (None, promise.block_m):
        return promise
    learned = reopen_training(run)
    log.info("testing the intervals of maps: fits without blocks of places")
    promise = gather_promise(learned, how)
    # Too little evidence is said before anything is stored
    cross_validate(promise.evidence, how.share)
    promise.store(run.stored[0].path)
    return promise


def reopen_training(run: OpenRun) -> Learned:
    """Return a model with the very data and rows that it was trained on.

    Raises:
        DataError: they are gone, or are others.
    """
    try:
        opened = run.read()
        learned = opened.retraining()
    except (ValueError, OSError) as error:
        why = f"{error}; held-out blocks need the training data"
        raise DataError(f"{why}: dataset.file=..., or promised=false") from None
    # Rows of other data are no evidence of what this model has not seen.
    if opened.learned != 0 or opened.foreign is not None:
        was = f"{run.stored[0].path} was trained on {opened.foreign}"
        raise DataError(f"{was}; give its own data, or promised=false")
    return learned


def map_notes(
    field: FieldMap,
    coverage: Coverage | None,
    covered: tuple[float, float] | None = None,
    promise: Promise | None = None,
) -> list[str]:
    """Return what a reader of the map must know; `covered` is of `covered_share_interval`."""
    notes = [*field.notes]
    figures = field.summarise()
    if figures["map/server_unsure"] and len(field.stations) > 1:
        inside = field.grid.inside
        chance = np.nanmean(field.server_chance[inside])
        quiet, lead = (layer[inside] for layer in (field.quiet, field.other_leads))
        doubt = f"in {lead.mean():.1%} of squares another leads likelier (hatched)"
        silent = f"in {quiet.mean():.1%} none is heard likelier than not (dotted)"
        notes.append(
            f"best_server: the named cell is strongest and heard with chance {chance:.2f} in the "
            f"mean; {doubt}, {silent}"
        )
    if len(field.stations) > 1 and (blank := field.without_ratio).any():
        where = (
            f"in {blank.sum() / max((~field.refused & field.grid.inside).sum(), 1):.0%} of squares"
        )
        why = "no other cell is on the strongest's carrier, and noise_db= is not given"
        notes.append(f"sinr: none {where}: {why}")
    if (lone := field.lone_squares()) > 0:
        notes.append(
            f"{lone} single squares differ from all around them about {field.threshold_db:g} "
            f"{field.unit}: rows in them say so, and shadows change within a square"
        )
    if (outage := figures["map/outage"]) is not None:
        level = f"{field.threshold_db:g} {field.unit} or more of some station (mean of 1 - outage)"
        ends = "" if covered is None else "; 90 % interval {:.1%} to {:.1%}".format(*covered)
        refused_share = (field.grid.inside & field.refused).sum() / max(field.grid.inside.sum(), 1)
        only = (
            f"; {refused_share:.0%} of the area is refused and not counted" if refused_share else ""
        )
        notes.append(f"{1 - float(outage):.1%} of the predicted squares have {level}{ends}{only}")
    if field.unit == "dB":
        notes.append("levels are in dB, as the data name no unit: if they are dBm, say unit=dBm")
    if coverage is None:
        caveat = "they are the model's own deviations, and no place is refused as too far from data"
        return [*notes, f"intervals are not tested: {caveat}"]
    tested = (
        f"{coverage.share:.1%} of {coverage.rows} heard rows in {coverage.blocks} held-out blocks"
    )
    of_map = f"on the map {figures['map/width_db']:.1f} dB for the strongest station"
    width = f"mean width {coverage.width_db:.1f} dB, {of_map}"
    notes.append(f"{field.share:.0%} intervals held {tested}; {width}")
    if figures["map/refused"]:
        squares = f"{figures['map/refused']} of {int(field.grid.inside.sum())} squares"
        notes.append(f"{squares} are refused: too far from measurements to promise anything")
    if (quarters := describe_quarters(promise)) is not None:
        notes.append(quarters)
    return notes


def describe_quarters(promise: Promise | None) -> str | None:
    """Return how far off whole quarters were, and what share of them their intervals held."""
    if promise is None or promise.quarters is None:
        return None
    rows = promise.quarters.subset(promise.quarters.heard)
    half = promise.calibration().half_of(rows)
    held, _ = coverage_and_width(rows.level_db - rows.mean_db, half)
    errors = [rows.subset(rows.block == number) for number in np.unique(rows.block)]
    each = [float(np.sqrt(np.mean((part.level_db - part.mean_db) ** 2))) for part in errors]
    ends = f"{min(each):.1f} to {max(each):.1f} dB" if each else "nothing"
    return (
        f"places farther from rows than blocks are judged by {len(each)} quarters of the places, "
        f"each predicted from the others: rmse {ends}, {held:.0%} within 90% intervals"
    )
