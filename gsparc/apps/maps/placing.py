"""Where one more station serves an area best,
as the model predicts stations that were never there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist
from scipy.stats import t

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.covered import (
    DRAWS,
    SHARE,
    sample_errors,
    sample_strongest_levels,
    share_between,
)
from gsparc.apps.maps.geojson import draws_shapes
from gsparc.apps.maps.joint_errors import shadowing
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.planning import coarse_grid, walkable_places
from gsparc.apps.maps.promise import Promise
from gsparc.base.errors import DataError
from gsparc.base.executor import run_all
from gsparc.base.limits import (
    POSITIVE,
    Checked,
    check_arguments,
    finite_array,
    number,
    or_null,
    setting,
    whole,
)
from gsparc.data.schema import Site, Stations
from gsparc.data.splits import Fold
from gsparc.models.powers.together.network import ONE_BAND, number_sites
from gsparc.prediction.left_out import HeldOutLevels, Learned, unlearn_and_predict
from gsparc.prediction.levels import predict_levels
from gsparc.prediction.placing import to_world
from gsparc.prediction.predictor import Predictor
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.uncertainty import central_interval
from gsparc.tables.query_places import read_query_places

LEAST_STATIONS = 3  # for leaving one out
NO_PATTERN = -1.0  # in place of an azimuth


@dataclass(frozen=True)
class NewAntenna(Checked):
    """What a station that is not there yet transmits with.

    >>> str(NewAntenna())
    'one antenna alike in all directions, 0 dB over the mean power of those that stand'

    Attributes:
        azimuth: of its sectors from north [deg], one or a list; None: alike in all directions.
        tilt: below the horizon [deg], as widths of beams across and in `height`; of sectors alone.
        power_db: over the mean of the stations that stand [dB].
        carrier_hz: of one of the bands of stations that stand; None: the lowest.
    """

    azimuth: float | Sequence[float] | None = None
    tilt: float = setting(6.0, number(-90, 90))
    width: float = setting(65.0, number(0, 360, open_low=True))
    height: float = setting(10.0, number(0, 180, open_low=True))
    power_db: float = setting(0.0, number(-100, 100))
    carrier_hz: float | None = setting(None, or_null(POSITIVE))

    def find_alike(self, stations: Stations) -> int | None:
        """Return a station of its band; None: of the only one, or the lowest.

        Raises:
            DataError: no station that stands is of its band.
        """
        if self.carrier_hz is None:
            return None
        carriers = np.zeros(0) if stations.carrier_hz is None else stations.carrier_hz
        away = np.abs(np.log(carriers / self.carrier_hz))
        if not len(carriers) or away.min() > np.log(ONE_BAND):
            bands = (
                ", ".join(f"{carrier / 1e6:g}" for carrier in np.unique(carriers)) or "unknown ones"
            )
            raise DataError(
                f"antenna.carrier_hz={self.carrier_hz:g}: no station's band; there are {bands} MHz"
            )
        return int(away.argmin()) if np.ptp(carriers) else None

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
            towards = ", ".join(f"{sector:g}" for sector in self.sectors()[:, 0])
            beams = (
                f"sectors towards {towards} deg, tilt {self.tilt:g}, {self.width:g} x "
                f"{self.height:g}"
            )
        return f"{beams}, {self.power_db:g} dB over the mean power of those that stand"


@dataclass(frozen=True)
class NewStationError:
    """How wrong the model is about a station that it never heard.

    Attributes:
        offset_db: deviation of the mean error of a whole site [dB].
        within: deviation of errors about that mean, in deviations that the model states.
        stations: sites left out, one at a time; 0: none was, and the model's own deviations are
            taken.
    """

    offset_db: float = 0.0
    within: float = 1.0
    stations: int = 0

    @classmethod
    def from_evidence(cls, parts: Sequence[HeldOutLevels]) -> NewStationError:
        """Return what rows of sites tell, each of which was left out as a whole."""
        # With silent rows: of lists those alone that were heard are the strong ones.
        errors = (part.distribution() for part in parts)
        mean, square = np.array([[mass @ e, mass @ e**2] for e, mass in errors]).T
        stated = [np.square(part.spread_db).mean() for part in parts]
        within = np.average(square - mean**2, weights=[part.heard.sum() for part in parts])
        return cls(float(np.sqrt(np.mean(mean**2 * stated))), float(np.sqrt(within)), len(parts))


@dataclass(frozen=True)
class Placement:
    """Candidates for one more station, the best first.

    Attributes:
        places: (n, 3) world [m].
        coverage: (n,) expected share of the area that is not refused with the threshold or more,
            with a station there.
        gain: (n,) what a station there adds to the share as it is.
        between: (n, 4) ends of 90 % intervals of both, old and new share drawn together; NaN where
            no site was left out, or nothing is promised.
        nearest_m: (n,) to the next station that stands [m].
        before: the share as it is.
        refused: share of the area where the promise says nothing.
        grid: the area.
        stations: (T, 2) that stand already [m].
        given: other columns (n,) of a table of candidates, by head.
    """

    places: np.ndarray
    coverage: np.ndarray
    gain: np.ndarray
    between: np.ndarray
    nearest_m: np.ndarray
    before: float
    refused: float
    grid: Grid
    stations: np.ndarray
    given: Mapping[str, np.ndarray]


def place_station(
    predictor: Predictor,
    area: Any = None,
    *,
    threshold_db: float = -100.0,
    promise: Promise | None = None,
    error: NewStationError = NewStationError(),
    antenna: NewAntenna = NewAntenna(),
    **where: Any,
) -> Placement:
    """Try one more station at every candidate.

    Args:
        predictor: of powers at several stations, learned together.
        area, threshold_db: see `predict_map`.
        promise: see `predict_map`, of the stations that stand.
        error: see `new_station_error`; without stations the model's own deviations.
        antenna: of the new station.
        where: see `lay_candidates`.

    Raises:
        DataError: as there; or all of the area is too far from what was measured.
    """
    grid, candidates, columns = lay_candidates(predictor, area, antenna=antenna, **where)
    west, east, south, north = grid.extent
    now = predict_map(
        predictor,
        [west, south, east, north],
        height_m=grid.height,
        step_m=grid.step,
        threshold_db=threshold_db,
        promise=promise,
    )
    # Refused squares are left out: as unserved they would count against the stations that stand,
    # and draw a new one to where nothing was tested.
    mask = grid.inside & ~now.refused
    if not mask.any():
        raise DataError(
            "area: all of it is too far from what was measured; map nearer, or promised=false"
        )
    now = replace(now, power_db=np.where(mask, now.power_db, np.nan))
    square, best = sample_strongest_levels(now, predictor, promise)
    old, cells, before = (
        best >= threshold_db,
        grid.places(square),
        1 - float(now.outage[mask].mean()),
    )
    alike = shadowing(cells, 1.0 if promise is None else promise.block_m)
    errors = error.within * sample_errors(alike, seed=1)  # errors of a new station are its own
    # Student's t, as few stations tell the deviation: the normal's ends held too little.
    offset = error.offset_db * t.rvs(max(error.stations, 1), size=DRAWS, random_state=2)

    def tried(place: np.ndarray) -> np.ndarray:
        level, spread = _new(predictor, place, cells, antenna)
        new = ~old & (level[:, None] + spread[:, None] * errors + offset >= threshold_db)
        share = share_between((old | new).mean(0), before + new.mean())
        return np.array([new.mean(), *share, *central_interval(new.mean(0), SHARE)])

    scores = np.array(run_all(tried, list(candidates), "candidates"))
    if promise is None or not error.stations:
        scores[:, 1:] = np.nan
    order = np.argsort(-scores[:, 0], kind="stable")
    columns, places = {head: words[order] for head, words in columns.items()}, candidates[order]
    gain, still = scores[order, 0], now.station_place
    nearest = np.fmin.reduce(cdist(places[:, :2], still), axis=1)
    return Placement(
        places,
        before + gain,
        gain,
        scores[order, 1:],
        nearest,
        before,
        1 - float(mask.sum() / grid.inside.sum()),
        grid,
        still,
        columns,
    )


def lay_candidates(
    predictor: Predictor,
    area: Any = None,
    *,
    height_m: float | None = None,
    sites: Any = None,
    station_height_m: float | None = None,
    count: int = 100,
    antenna: NewAntenna = NewAntenna(),
) -> tuple[Grid, np.ndarray, dict[str, np.ndarray]]:
    """Return the area, places (n, 3) [m] where a station is tried, and other columns (n,)
    of their table.

    Args:
        predictor, antenna: see `place_station`, which can be asked about all that is returned.
        area, height_m: see `predict_map`.
        sites: where a station may stand: GeoJSON of polygons or lines, or a table of places (see
            `read_query_places`), all of which are tried; None: the whole area.
        station_height_m: world; None: the middle height of the stations that stand.
        count: candidates, about.

    Raises:
        DataError: the model cannot predict a station that was never there, or anything else that is
            wrong.
    """
    site = predictor.site
    check_arguments(locals(), count=whole(1))
    if site.stations is None or site.paired:
        raise DataError(
            f"place: {site.name} has no stations; several that were trained together are needed"
        )
    grid = coarse_grid(predictor, area, height_m)
    heights = site.stations.position[:, 2] + site.origin[2]
    if station_height_m is None and np.isnan(heights).all():
        raise DataError(
            "station_height_m: no station's height is known; say station_height_m=METRES"
        )
    height = float(np.nanmedian(heights) if station_height_m is None else station_height_m)
    lattice = grid if sites is not None else coarse_grid(predictor, area, height_m, count=count)
    candidates, columns = _candidates(lattice, sites, predictor, height, count)
    try:
        _new(predictor, candidates[0], grid.places()[:1], antenna)
    except ValueError as refused:
        error = unheard_stations_error(f"{predictor.method.name} ({refused})")
        raise refused if isinstance(refused, DataError) else error from None
    return grid, candidates, columns


def new_station_error(learned: Learned, most: int = 4) -> NewStationError:
    """Leave out whole sites, up to `most`, and predict their stations from the others.

    A sector alone would be left to its site's others, which share its shadowing.
    """
    data, rows, stations = learned.data, learned.rows, learned.data.site.every_station
    site = number_sites(stations, stations.position)[data.stations_of(rows)]
    heard = np.unique(site)
    if len(heard) < LEAST_STATIONS:
        return NewStationError()
    # By the seed of the training: the same sites are left out whenever it is asked again.
    chosen = np.random.default_rng(learned.context.seed).permutation(heard)[:most]
    parts: list[HeldOutLevels] = []
    # Without validation rows: the site left out is the test, all else is learned from.
    for site_number in chosen:
        at_site = site == site_number
        inner = Fold(rows[~at_site], rows[:0], rows[at_site])
        parts.append(unlearn_and_predict(learned, inner, np.full(int(at_site.sum()), site_number)))
    parts = [part for part in parts if part.heard.any()]  # of silent rows alone no error is known
    return NewStationError.from_evidence(parts) if parts else NewStationError()


def _candidates(grid: Grid, sites: Any, predictor: Predictor, height: float, count: int) -> Any:
    """Places (n, 3) and, of a table of them, its other columns (n,)."""
    if sites is not None and not draws_shapes(sites):
        site, end = predictor.site, predictor.site.still_end
        queries = read_query_places(sites, (end,))
        where = queries.ends[end]
        above = np.full(len(queries), height) if where.height is None else where.height
        columns = {head: words for head, role, words in queries.table if role in (None, "row_name")}
        return to_world(replace(queries, ends={end: replace(where, height=above)}), site)[
            end
        ], columns
    if sites is not None:
        places, _ = walkable_places(sites, grid, "sites")
    else:
        # So many more lie in an area that the lattice missed
        places, count = grid.places(), 2 * count
    few = places[evenly_spaced(len(places), count)]
    return np.column_stack([few[:, :2], np.full(len(few), height)]), {}


def _new(predictor: Predictor, place: np.ndarray, cells: np.ndarray, antenna: NewAntenna) -> Any:
    """Level and deviation (n,) [dB] of the strongest sector at `place` (3,), in cells (n, 3)."""
    like = antenna.find_alike(predictor.site.every_station)
    prediction = predictor.predict_new(cells, place, antenna.sectors(), like)
    if prediction is None and (antenna.azimuth is not None or like is not None):
        lacks = (
            "carrier_hz: {} knows no bands"
            if antenna.azimuth is None
            else "azimuth: {} knows no patterns"
        )
        raise DataError(f"antenna.{lacks.format(predictor.method.name)}; model=gsparc does")
    if prediction is None:
        level, spread = predict_levels(predictor, cells, station=place)
    else:
        strongest = prediction[0].argmax(1)[:, None]
        level, spread = (np.take_along_axis(part, strongest, 1)[:, 0] for part in prediction)
    return np.nan_to_num(level + antenna.power_db, nan=-np.inf), np.nan_to_num(spread, nan=1.0)


def describe_new_station(site: Site, height: float, antenna: NewAntenna) -> str:
    """Return in words what a new station is taken to be, `height` [m] high."""
    carrier = site.every_station.carrier_hz
    # The first band is the lowest: see `gsparc.processes.sectors.Sectors.add_sectors`.
    band = ""
    if carrier is not None and np.ptp(carrier) > 0:
        band = f" in the band of {(antenna.carrier_hz or carrier.min()) / 1e6:g} MHz"
    return f"assumed: {height:.4g} m high{band}, {antenna} (see station_height_m, antenna)"


def unheard_stations_error(what: str) -> DataError:
    """Return the error for models that know no station but those they learned from."""
    advice = "train with stations=together, for example model=gp or distance_law"
    return DataError(f"{what}: answers only for the stations that it heard; {advice}")
