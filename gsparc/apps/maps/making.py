"""A map of a model: every cell of an area is asked about, in chunks of bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from scipy.ndimage import maximum_filter

from gsparc.apps.maps import field_map, strongest
from gsparc.apps.maps.area import FloorPlan, Grid, lay_grid
from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.intervals import IntervalScales
from gsparc.apps.maps.promise import Promise, read_promise
from gsparc.apps.maps.refining import FIRST, sample_adaptively
from gsparc.base import limits
from gsparc.base.errors import DataError
from gsparc.base.executor import run_all
from gsparc.base.instantiate import suggest_or_list
from gsparc.base.limits import finite_array
from gsparc.data.schema import Site
from gsparc.data.spacing import neighbour_distance
from gsparc.data.station_names import all_names, find_station
from gsparc.data.units import PowerUnit
from gsparc.models.powers.together.network import number_sites
from gsparc.prediction.answers import in_blocks
from gsparc.prediction.levels import joint_levels, predict_levels
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import to_local
from gsparc.processes.uncertainty import half_width

MOST_DB = 1000.0  # of a level
FEW_CELLS = 3_000  # of a map that are all asked about
SLACK, ALIKE = 0.1, 0.1  # of the model's own deviation, and of a correlation: interpolated
NEAR = 2  # cells around what was measured that are all asked about
# What follows is cheap, but float64 arrays (T, n) of all cells of a city take gigabytes.
BANDS = 1 << 16  # cells at a time of what follows from predictions


def predict_map(
    predictor: Predictor,
    area: Any = None,
    *,
    height_m: float | None = None,
    step_m: float | None = None,
    threshold_db: float = -100.0,
    stations: Sequence[str | int] | None = None,
    load: float | Sequence[float] | Mapping[str, float] = 1.0,
    noise_db: float | None = None,
    other_end: Sequence[float] | None = None,
    plan: FloorPlan | None = None,
    promise: Promise | Literal["stored"] | None = "stored",
    share: float = 0.9,
    tolerance_db: float = 0.1,
    unit: str | None = None,
    dry: bool = False,
    buildings: Any = None,
    indoor_db: Sequence[float] | None = None,
) -> FieldMap:
    """Predict every cell of an area.

    >>> field = predict_map(gsparc.load("model.ckpt"), step_m=0.5)
    >>> len(field.power_db), bool(0 <= field.outage.mean() <= 1)
    (1, True)

    Args:
        predictor: of powers or channels.
        area, height_m, step_m: see `lay_grid`.
        threshold_db: of outage.
        stations: names or numbers; None: all that the model can answer for.
        load, noise_db: see `sinr`.
        other_end: (3,) world place of the end that the map is not of, where both moved [m].
        plan: beneath the map.
        promise: evidence of held-out blocks, or what the checkpoint holds of it; None: intervals
            are the model's own deviations, and nothing is refused.
        share: of measurements that intervals are to hold.
        tolerance_db: error of cells that are interpolated, in maps of more than `FEW_CELLS`; 0 asks
            about every cell. Known places must be stored with the model.
        unit: of the map's levels, and of `threshold_db` and `noise_db`: dBm or dBW; None: as
            measured.
        dry: predict one cell of each station alone: whether everything asked for is possible.
        buildings: see `lay_grid`.
        indoor_db: (2,) loss of squares in buildings, which are mapped then, and its deviation [dB].

    Raises:
        DataError: anything wrong with what is asked for.
    """
    site = predictor.site
    if site.target.is_image:
        raise DataError(
            f"this model predicts spectra of {site.name}, which have no received power to map"
        )
    promise = read_promise(predictor.extra) if promise == "stored" else promise
    names, notes = choose_stations(predictor, stations, promise)
    loss = None if indoor_db is None else finite_array(indoor_db)
    if loss is not None and (loss.shape != (2,) or (loss < 0).any() or buildings is None):
        raise DataError(
            f"indoor_db={indoor_db}: a loss and its deviation, [15,6], beside buildings=FILE"
        )
    grid = lay_grid(site, area, height_m, step_m, plan, len(names), buildings, loss is not None)
    numbers = np.array([site.every_station.name.index(name) for name in names])
    about = station_facts(site, numbers)
    load_of = strongest.read_loads(load, names, about["stations"])
    level = PowerUnit.from_name(unit, site.level_unit, levels=True)
    # Inside, all is in the unit of the measurements: settings are converted once.
    threshold_db -= level.raised_db
    limits.or_null(limits.number(-MOST_DB, MOST_DB)).check("noise_db", noise_db)
    noise_db = None if noise_db is None else noise_db - level.raised_db
    if dry:
        first = np.zeros_like(grid.inside)
        first.reshape(-1)[np.flatnonzero(grid.inside)[0]] = True
        grid, promise = replace(grid, inside=first), None
    calibration = make_stated_scales(share) if promise is None else promise.calibration(share)
    notes += _notes_of_threshold(threshold_db, promise, level)
    values: dict[str, Any] = field_map.empty_layers(len(names), grid.inside.shape)
    inside = np.flatnonzero(grid.inside)
    # Where nothing is said nothing is asked.
    told = grid.inside
    if promise is not None:
        local = grid.places(np.arange(told.size)) - site.origin
        told = told & promise.within_reach(local).reshape(told.shape)
    sure = told
    if promise is not None and tolerance_db > 0 and len(inside) > FEW_CELLS:
        sure = told & _beside_rows(grid, promise, site)
    alike, computed = _fill_levels(
        values, predictor, grid, other_end, names, numbers, told, sure, tolerance_db
    )
    if computed < len(names) * told.sum():
        most = f"{computed} of {len(names) * told.sum()} levels were predicted"
        notes.append(
            f"{most}, the others interpolated to about {tolerance_db:g} dB (tolerance_db) or a "
            "tenth of their deviation"
        )
    bands = about["bands"]
    score = partial(
        strongest.compute_map_layers,
        calibration,
        numbers=numbers,
        load=load_of,
        carrier=np.unique(bands or ("",) * len(names), return_inverse=True)[1].reshape(-1),
        floor=_hearing_floors(promise, numbers, noise_db),
        threshold_db=threshold_db,
        noise_db=noise_db,
        loss=loss,
    )
    values["overlap"] = np.full(grid.inside.shape, np.nan, np.float32)
    flat = {name: array.reshape(*array.shape[:-2], -1) for name, array in values.items()}
    for cells in np.split(inside, range(BANDS, len(inside), BANDS)):
        mean, spread = (
            flat[name][:, cells].astype(np.float64) for name in ("power_db", "expected_error_db")
        )
        far = np.zeros(mean.shape)
        if promise is not None:
            local = to_local(site, grid.places(cells), other_end)
            far = np.stack([promise.distance(local, number) for number in numbers])
        indoors = None if grid.indoors is None else grid.indoors.reshape(-1)[cells]
        related = alike.reshape(len(names), -1)[:, cells]
        for name, layer in score(mean, spread, related, far, indoors).items():
            flat[name][..., cells] = layer
    if promise is not None and not np.isfinite(values["power_db"]).any():
        fault = f"every square lies more than {calibration.reach:.3g} m from what was measured"
        raise DataError(
            f"area: {fault}, where no error was tested; map nearer, or a larger promise.block_m"
        )
    overlap = values.pop("overlap")
    extra = {} if len(names) == 1 else {"overlap": overlap}
    places = np.zeros((0, 2)) if promise is None else promise.known[:, -3:-1] + site.origin[:2]
    return FieldMap(
        grid,
        **values,
        share=share,
        calibrated=promise is not None,
        threshold_db=threshold_db,
        extra=extra,
        places=np.unique(places, axis=0),
        notes=tuple(notes),
        unit=site.level_unit,
        **about,
    ).to_unit(level.raised_db, level.name)


def _notes_of_threshold(
    threshold_db: float, promise: Promise | None, level: PowerUnit
) -> list[str]:
    """Say where a threshold [dB] lies outside of what was measured;
    levels are named in the map's unit.
    """
    if promise is None:
        return []
    measured, threshold = (
        promise.evidence.level_db + level.raised_db,
        threshold_db + level.raised_db,
    )
    # Of what was not heard the level that it lies below; to whole decibels,
    # as next to nothing lies between.
    if threshold_db <= np.ceil(measured.min() - level.raised_db):
        at = (
            f"threshold_db={threshold:g} is at or below what was measured (lowest "
            f"{measured.min():.4g})"
        )
        return [f"{at}: it says nothing of weaker places"]
    if threshold > measured.max():
        at = (
            f"threshold_db={threshold:g} is above all that was measured (highest "
            f"{measured.max():.4g})"
        )
        return [f"{at}: hardly any place can reach it"]
    return []


def _beside_rows(grid: Grid, promise: Promise, site: Site) -> np.ndarray:
    """Cells (ny, nx) bool near rows, unless cells are finer than these: what a row tells of is
    narrower than a lattice."""
    known = promise.known[:, -3:-1] + site.origin[:2]
    place = ((known - [grid.x[0], grid.y[0]]) / grid.step).round().astype(int)
    inside = ((place >= 0) & (place < [len(grid.x), len(grid.y)])).all(1)
    sure = np.zeros_like(grid.inside)
    if neighbour_distance(known) < 2 * FIRST * grid.step:
        sure[place[inside, 1], place[inside, 0]] = True
    return maximum_filter(sure, 2 * NEAR + 1)


def _fill_levels(
    values: dict[str, np.ndarray],
    predictor: Predictor,
    grid: Grid,
    other_end: Sequence[float] | None,
    names: Sequence[str],
    numbers: np.ndarray,
    told: np.ndarray,
    sure: np.ndarray,
    tolerance_db: float,
) -> tuple[np.ndarray, int]:
    """Write levels and the model's own deviations to `values`.

    Return the correlation (T, ny, nx) of errors with the strongest's,
    and how many levels were predicted.
    """
    first, computed = grid.places(np.flatnonzero(grid.inside)[:1]), 0
    joint = joint_levels(predictor, first, numbers) is not None
    alike = np.zeros_like(values["power_db"])
    size = len(names) if joint else 1  # stations that are asked about at once
    for row in range(0, len(names), size):
        chosen = slice(row, row + size)
        ask = _asker(predictor, joint, grid, other_end, names[chosen], numbers[chosen])

        def allowed(values: np.ndarray) -> np.ndarray:
            parts = values.reshape(len(values), -1, size)
            error = np.full(parts.shape, ALIKE)
            error[:, :2] = np.maximum(SLACK * parts[:, 1:2], tolerance_db)
            return error.reshape(values.shape)

        parts, count = sample_adaptively(ask, told, allowed, sure, 1 if sure is told else FIRST)
        parts = parts.reshape(-1, size, *grid.inside.shape)
        values["power_db"][chosen], values["expected_error_db"][chosen] = parts[:2]
        alike[chosen] = parts[2] if joint else 0.0
        computed += count * size
    return alike, computed


def make_stated_scales(share: float) -> IntervalScales:
    """Return intervals and errors as the model states them, everywhere."""
    return IntervalScales(
        share, np.zeros(1), np.array([half_width(share)]), np.ones(1), None, np.inf, np.zeros(0)
    )


def choose_stations(
    predictor: Predictor,
    wanted: Sequence[str | int] | None,
    promise: Promise | None = None,
    key: str = "stations",
) -> tuple[list[str], list[str]]:
    """Return names of the stations that are mapped, and notes on the others.

    Those are stations that the model does not answer for, and, where something is promised,
    stations that it never heard: what was held out tells nothing of them.
    `key` is the setting that `wanted` comes from.

    Raises:
        DataError: one of them was asked for, or none is left.
    """
    stations = predictor.site.stations
    if stations is None:
        if wanted is not None:
            raise DataError(
                f"{key}={list(wanted)}: {predictor.site.name} has one station; leave it out"
            )
        return [""], []
    names: list[str] = []
    for station in wanted if wanted is not None else stations.name:
        number = find_station(station, stations)
        if number is None:
            raise DataError(
                f"{key}: no station {station!r}{suggest_or_list(str(station), all_names(stations))}"
            )
        names.append(stations.name[number])
    if not names:
        raise DataError("stations=[]: name one at least, or all")
    notes = []
    # Names may be given twice, by name and by number.
    for name in dict.fromkeys(names):
        try:
            predictor.select_station(name)
            if promise is not None and not (promise.station == stations.name.index(name)).any():
                raise DataError(
                    f"station {name} was never heard, so that nothing can be promised of its map"
                )
        except ValueError as error:
            if wanted is not None:
                raise DataError(str(error)) from None
            notes.append(f"left out: {error}")
            names.remove(name)
    if not names:
        raise DataError(notes[0])
    return list(dict.fromkeys(names)), notes


def _asker(
    predictor: Predictor,
    joint: bool,
    grid: Grid,
    other_end: Sequence[float] | None,
    names: Sequence[str],
    numbers: np.ndarray,
) -> Callable[[np.ndarray], np.ndarray]:
    """Levels and deviations [dB] of cells (n,), in chunks, as many at once as torch has threads.

    Of one station (n, 2), or of those that are known together (n, 3 T), with the correlation of
    their errors with the strongest's.
    """
    model = predictor if joint else predictor.ask_station(int(numbers[0]))
    what = f"blocks of cells of {names[0]}" if len(names) == 1 and names[0] else "blocks of cells"
    how: dict[str, Any] = {"what": what, "threads": torch.get_num_threads()}

    def ask(cells: np.ndarray) -> np.ndarray:
        places = grid.places(cells)
        if not len(cells):
            return np.zeros((0, 3 * len(numbers) if joint else 2))
        if not joint:
            return np.column_stack(predict_levels(model, places, other_end, **how))
        parts = run_all(lambda part: joint_levels(model, part, numbers), in_blocks(places), **how)
        return np.concatenate([part for part in parts if part is not None]).reshape(len(cells), -1)

    return ask


def _hearing_floors(
    promise: Promise | None, numbers: np.ndarray, noise_db: float | None
) -> np.ndarray:
    """Levels (T,) below which stations are not heard,
    else the weakest but for 1 % measured [dB].
    """
    floor = np.full(len(numbers), -np.inf if noise_db is None else noise_db)
    if promise is None:
        return floor
    for row, number in enumerate(numbers):
        levels = promise.evidence.subset(promise.evidence.station == number)
        if len(levels):
            quiet = levels.level_db[levels.side > 0]
            # The least level: those of lists are of their weakest cells, far above what is heard.
            # 1 %, not the least: one faulty row would place the floor anywhere.
            floor[row] = max(
                floor[row], quiet.min() if len(quiet) else np.quantile(levels.level_db, 0.01)
            )
    return floor


def station_facts(site: Site, numbers: np.ndarray) -> dict[str, Any]:
    """Return what a `FieldMap` says of stations (T,): names, as in a list of cells, places,
    carriers, ...
    """
    stations = site.every_station
    carrier = np.zeros(1) if stations.carrier_hz is None else stations.carrier_hz[numbers]
    several = len(np.unique(carrier)) > 1
    return {
        "stations": tuple((stations.label or stations.name)[number] for number in numbers),
        "station_place": (stations.position + site.origin)[numbers, :2],
        "azimuth": np.zeros(0) if stations.sector is None else stations.sector[numbers, 0],
        "bands": tuple(f"{hertz / 1e6:g} MHz" for hertz in carrier) if several else (),
        "site": number_sites(stations, stations.position)[numbers],
        "number": numbers,
    }
