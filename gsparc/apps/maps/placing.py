"""Where one more station serves an area best, as the model predicts stations that were never there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm, t

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.intervals import Evidence
from gsparc.apps.maps.making import predict_levels, predict_map
from gsparc.apps.maps.planning import coarse_grid, walkable_places
from gsparc.apps.maps.promise import Promise, held_out_evidence
from gsparc.data.blocks import evenly_spaced
from gsparc.data.errors import DataError
from gsparc.data.executor import run_each
from gsparc.data.limits import Checked, check_arguments, finite_array, number, setting, whole
from gsparc.data.query_places import read_query_places
from gsparc.data.schema import Site
from gsparc.data.splits import Fold
from gsparc.data.tables import is_table
from gsparc.prediction.placing import to_world
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.refit import Learned

LEAST_STATIONS = 3  # for leaving one out
NO_PATTERN = -1.0  # in place of an azimuth
Levels = tuple[np.ndarray, np.ndarray]
Candidates = tuple[np.ndarray, dict[str, np.ndarray]]


@dataclass(frozen=True)
class Antenna(Checked):
    """What a station that is not there yet transmits with.

    >>> str(Antenna())
    'one antenna alike in all directions, 0 dB over the mean power of those that stand'

    Attributes:
        azimuth: of its sectors from north [deg], one or a list; None: alike in all directions.
        tilt: below the horizon [deg], as widths of beams across and in `height`; of sectors alone.
        power_db: over the mean of the stations that stand [dB].
    """

    azimuth: float | Sequence[float] | None = None
    tilt: float = setting(6.0, number(-90, 90))
    width: float = setting(65.0, number(0, 360, open_low=True))
    height: float = setting(10.0, number(0, 180, open_low=True))
    power_db: float = setting(0.0, number(-100, 100))

    def sectors(self) -> np.ndarray:
        """Return (k, 5), see `gsparc.prediction.predictor.Predictor.elsewhere`.

        Raises:
            DataError: azimuths that are no numbers.
        """
        azimuth = np.atleast_1d(finite_array(NO_PATTERN if self.azimuth is None else self.azimuth))
        if azimuth.ndim > 1 or not len(azimuth):
            raise DataError(f"antenna.azimuth={self.azimuth}: degrees from north, like [0,120,240]")
        azimuth = azimuth if self.azimuth is None else azimuth % 360
        rest = (self.tilt, self.width, self.height, 0.0)
        return np.column_stack([azimuth, np.tile(rest, (len(azimuth), 1))])

    def __str__(self) -> str:
        beams = "one antenna alike in all directions"
        if self.azimuth is not None:
            towards = ", ".join(f"{one:g}" for one in self.sectors()[:, 0])
            beams = f"sectors towards {towards} deg, tilt {self.tilt:g}, {self.width:g} x {self.height:g}"
        return f"{beams}, {self.power_db:g} dB over the mean power of those that stand"


@dataclass(frozen=True)
class NewStationError:
    """How wrong the model is about a station that it never heard.

    Attributes:
        offset_db: deviation of the mean error of a whole station [dB].
        within: deviation of errors about that mean, in deviations that the model states.
        stations: left out, one at a time; 0: nobody was, and the model's own deviations are taken.
    """

    offset_db: float = 0.0
    within: float = 1.0
    stations: int = 0


@dataclass(frozen=True)
class Placement:
    """Candidates for one more station, the best first.

    Attributes:
        places: (n, 3) world [m].
        coverage: (n,) expected share of the area that is not refused with the threshold or more, with a
            station there.
        low, high: (n,) the ends of its 90 % interval.
        before: the share as it is.
        refused: share of the area where the promise says nothing.
        grid: the area.
        stations: (T, 2) that stand already [m].
        error: of stations left out.
        given: other columns (n,) of a table of candidates, by head.
    """

    places: np.ndarray
    coverage: np.ndarray
    low: np.ndarray
    high: np.ndarray
    before: float
    refused: float
    grid: Grid
    stations: np.ndarray
    error: NewStationError
    given: Mapping[str, np.ndarray]


def place_station(
    predictor: Predictor, area: Any = None, *, threshold_db: float = -100.0, height_m: float | None = None,
    sites: Any = None, station_height_m: float | None = None, count: int = 100,
    promise: Promise | None = None, error: NewStationError | None = None, antenna: Antenna | None = None,
    dry: bool = False,
) -> Placement:  # fmt: skip
    """Try one more station at every candidate.

    Args:
        predictor: of powers at several stations, learned together.
        area, height_m, threshold_db: see `predict_map`.
        sites: where a station may stand: GeoJSON of polygons or lines, or a table of places (see
            `read_query_places`), all of which are tried; None: the whole area.
        station_height_m: world; None: the middle height of the stations that stand.
        count: candidates, about.
        antenna: of the new station.
        promise: see `predict_map`, of the stations that stand.
        error: see `new_station_error`; None: the model's own deviations.
        dry: predict one square of each station that stands alone: whether everything asked for is possible.

    Raises:
        DataError: the model cannot predict a station that was never there, or anything else that is wrong.
    """
    site = predictor.site
    check_arguments(locals(), count=whole(1))
    if site.stations is None or site.static_end is None:
        raise DataError(f"place: {site.name} has no stations; several that were trained together are needed")
    grid = coarse_grid(predictor, area, height_m)
    antenna = antenna or Antenna()
    still = site.stations.position + site.origin
    known = still[np.isfinite(still[:, 2]), 2]
    if station_height_m is None and not len(known):
        raise DataError("station_height_m: no station's height is known; say station_height_m=METRES")
    height = float(np.median(known) if station_height_m is None else station_height_m)
    candidates, given = _candidates(grid, sites, predictor, height, count)
    cells = grid.places()
    try:
        _new(predictor, candidates[0], cells[:1], antenna)
    except DataError:
        raise
    except ValueError as refused:
        raise unheard_stations_error(f"{predictor.method.name} ({refused})") from None
    left, right, south, north = grid.extent
    now = predict_map(
        predictor, [left, south, right, north], height_m=grid.height, step_m=grid.step,
        threshold_db=threshold_db, promise=promise, dry=dry,
    )  # fmt: skip
    error = error or NewStationError()
    # Refused squares are left out: as unserved they would count against the stations that stand,
    # and draw a new one to where nothing was tested.
    known = np.isfinite(now.outage[grid.inside])
    if not known.any() and not dry:
        raise DataError("area: all of it is too far from what was measured; map nearer, or promised=false")
    old_outage, cells = now.outage[grid.inside][known], cells[known]
    # A 90 % interval of Student's t, as few stations tell the deviation: the normal's 1.645 held too little.
    reach = float(t.ppf(0.95, max(error.stations, 1))) * error.offset_db

    def tried(place: np.ndarray) -> np.ndarray:
        level, spread = _new(predictor, place, cells, antenna)
        goals = np.empty(3)
        # A station's mean error shifts all its cells alike: hence intervals by shifts, not per cell.
        for k, shift in enumerate((0.0, -reach, reach)):
            wide = np.hypot(spread * error.within, error.offset_db if k == 0 else 0.0)
            outage = norm.cdf((threshold_db - level - shift) / np.maximum(wide, 1e-9))
            goals[k] = np.mean(1 - old_outage * outage)  # its errors are its own
        return goals

    scores = np.full((len(candidates), 3), np.nan)
    for row, goals in run_each(tried, list(candidates), "candidates", wanted=lambda place: not dry):
        scores[row] = goals
    before = np.nan if dry else float(np.mean(1 - old_outage))
    order = np.argsort(-scores[:, 0], kind="stable")
    given = {head: words[order] for head, words in given.items()}
    value, low, high = scores[order].T
    lost = 1 - float(known.mean())
    return Placement(candidates[order], value, low, high, before, lost, grid, still[:, :2], error, given)


def new_station_error(learned: Learned, most: int = 4) -> NewStationError:
    """Leave out whole stations, up to `most`, and predict them from the others."""
    data, known = learned.data, learned.rows
    assert data.site.stations is not None and data.station is not None
    heard = np.unique(data.station[known])
    if len(heard) < LEAST_STATIONS:
        return NewStationError()
    # By the seed of the training: the same stations are left out whenever it is asked again.
    chosen = np.random.default_rng(learned.context.seed).permutation(heard)[:most]
    parts: list[Evidence] = []
    # Without validation rows: the station left out is the test, all else is learned from.
    for one in chosen:
        own = data.station[known] == one
        inner = Fold(known[~own], known[:0], known[own])
        parts.append(held_out_evidence(learned.unlearn(inner), data, inner, np.full(int(own.sum()), one)))
    parts = [one for one in parts if (one.side == 0).any()]  # of silent rows alone no error is known
    if not parts:
        return NewStationError()
    errors = [(one.level_db - one.mean_db)[one.side == 0] for one in parts]
    means = np.array([error.mean() for error in errors])
    pairs = zip(errors, means, parts, strict=True)
    inside = [(error - mean) / one.spread_db[one.side == 0] for error, mean, one in pairs]
    within = float(np.sqrt(np.mean(np.concatenate(inside) ** 2)))
    return NewStationError(float(np.sqrt(np.mean(means**2))), within, len(means))


def _candidates(grid: Grid, sites: Any, predictor: Predictor, height: float, count: int) -> Candidates:
    """Places (n, 3) and, of a table of them, its other columns (n,)."""
    if sites is not None and is_table(sites):
        site, end = predictor.site, predictor.site.static_end or "tx"
        asked = read_query_places(sites, (end,))
        where = asked.ends[end]
        above = np.full(len(asked), height) if where.height is None else where.height
        given = {head: words for head, role, words in asked.table if role in (None, "row_name")}
        return to_world(replace(asked, ends={end: replace(where, height=above)}), site)[end], given
    if sites is not None:
        every, _ = walkable_places(sites, grid, predictor.site.georeference, "sites")
    else:
        every = grid.places()
    few = every[evenly_spaced(len(every), count)]
    return np.column_stack([few[:, :2], np.full(len(few), height)]), {}


def _new(predictor: Predictor, place: np.ndarray, cells: np.ndarray, antenna: Antenna) -> Levels:
    """Level and deviation (n,) [dB] of the strongest sector at `place` (3,), in cells (n, 3)."""
    known = predictor.predict_new(cells, place, antenna.sectors())
    if known is None and antenna.azimuth is not None:
        raise DataError(f"antenna.azimuth: {predictor.method.name} knows no patterns; model=gsparc does")
    if known is None:
        level, spread = predict_levels(predictor, cells, station=place)
    else:
        strongest = known[0].argmax(1)[:, None]
        level, spread = (np.take_along_axis(part, strongest, 1)[:, 0] for part in known)
    return np.nan_to_num(level + antenna.power_db, nan=-np.inf), np.nan_to_num(spread, nan=1.0)


def assumption(site: Site, height: float, antenna: Antenna) -> str:
    """Return in words what a new station is taken to be, `height` [m] high."""
    carrier = None if site.stations is None else site.stations.carrier_hz
    # The first band is the lowest: see `gsparc.processes.sectors.Sectors.add_sectors`.
    band = "" if carrier is None or np.ptp(carrier) == 0 else f" in the band of {carrier.min() / 1e6:g} MHz"
    return f"assumed: {height:.4g} m high{band}, {antenna} (see station_height_m, antenna)"


def unheard_stations_error(what: str) -> DataError:
    """Return the error for models that know no station but those they learned from."""
    advice = "train with stations=together, for example model=gp or distance_law"
    return DataError(f"{what}: answers only for the stations that it heard; {advice}")
