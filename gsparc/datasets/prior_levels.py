"""Levels that a file states of a site before any row: a raster, places and powers, or what a
terrain lets through.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import Caution, DataError, list_first
from gsparc.base.files import Files
from gsparc.data.schema import Measurements
from gsparc.data.station_names import site_name
from gsparc.data.target import MOST_DB
from gsparc.datasets.own import read_own
from gsparc.datasets.rasters import BAND, GRIDS, OVERLAY, is_raster, read_raster
from gsparc.datasets.terrain import terrain_levels
from gsparc.tables import is_table
from gsparc.tables.checks.piles import find_sentinel_levels
from gsparc.tables.own import interpret
from gsparc.tables.read import parse_table

log = logging.getLogger(__name__)

Levels = tuple[np.ndarray, np.ndarray]  # places (M, 2) [m], world, and levels (M,) [dB] there
BESIDE = {"file": ("crs", "nodata", "legend"), "itm": ("crs", "nodata", "tx_m", "rx_m", "mhz")}
MOST = 4_000_000  # levels: they are kept with a model
ABOUT_M = 100.0  # least distance from the box of rows and stations that levels are kept within [m]


def read_prior_levels(path: Files, data: Measurements, station: str = "") -> Levels:
    """Return places (M, 2) [m] in the world coordinates of the measurements, and levels (M,)
    [dB] there.

    Args:
        path: a raster of `read_raster`, its name or `{file: NAME, crs: ...}` with its settings, or
            what `dataset=own` reads; several, or a folder of rasters: each named by its station.
            Of a terrain `itm:NAME`, or `{itm: NAME, ...}`, see `terrain_levels`.
        data: measurements, which the levels must overlap.
        station: whose levels are wanted, as it is shown; empty: the measurements are of one
            station.

    Raises:
        DataError: no such file, no levels, none of this station, or of another place.
    """
    return read_prior_maps(path, data, (station,))[0][2]


def read_prior_maps(
    path: Files, data: Measurements, stations: Sequence[str]
) -> list[tuple[int, bool, Levels]]:
    """Return number, whether it is of the station and not of its site, and levels,
    of stations with a map.

    Args:
        path, data: see `read_prior_levels`.
        stations: (T,) as they are shown; those without a map are warned of.

    Raises:
        DataError: as `read_prior_levels`, of none of them.
    """
    own = [names_of_station(shown) for shown in stations]
    known = {name for names in own for name in names if name}
    maps, faults = dict[str, Levels](), list[DataError]()
    several = not isinstance(path, str | Path | Mapping)
    several |= isinstance(path, str | Path) and Path(path).is_dir()
    listed: Sequence[Any] = [path] if isinstance(path, str | Path | Mapping) else path
    sources = [settings_of(source) for source in listed]
    if several and len(sources) == 1 and (folder := Path(sources[0].get("file", ""))).is_dir():
        kinds = (*GRIDS, OVERLAY)
        sources = [{"file": file} for file in sorted(folder.iterdir()) if file.suffix in kinds]
    for settings in sources:
        file = Path(settings.get("file") or settings["itm"])
        for name, points, level in _read_file(settings, data, known):
            try:
                named = name or file.stem * several
                maps[named] = _near_rows(file, data, points, level)
            except DataError as error:
                faults.append(error)
    if not maps:
        raise faults[0] if faults else DataError(f"model.prior={path}: no level is known in it")
    if stations == ("",) and len(maps) == 1:
        return [(0, True, next(iter(maps.values())))]
    matches = list[tuple[int, bool, Levels]]()
    for number, names in enumerate(own):
        sites = [site_name(name) for name in names]
        match = next(
            ((name, name in names) for name in (*names, *sites) if name in maps),
            None,
        )
        matches += [] if match is None else [(number, match[1], maps[match[0]])]
    if not matches:
        shown = list_first(stations) or "one station"
        advice = (
            f"call bands of a GeoTIFF `{BAND} NAME`, columns of a table NAME, as the "
            "measurements do"
        )
        if list(maps) == [""]:
            raise DataError(
                f"model.prior={path}: one map of no station's name, and there are several: as of "
                "a best "
                f"server it tells nothing of {shown}; {advice}"
            )
        raise DataError(
            f"model.prior={path}: of {list_first([*maps], 12)}, not of {shown}; {advice}"
        )
    with_map = {number for number, *_ in matches}
    if lacking := [shown for number, shown in enumerate(stations) if number not in with_map]:
        log.warning("model.prior=%s: no map of %s", path, list_first(lacking))
    return matches


def names_of_station(shown: str) -> tuple[str, ...]:
    """Return all names of a station as it is shown, of which a file may have any.

    >>> names_of_station("W03-2 (150)"), names_of_station("roof")
    (('W03-2 (150)', 'W03-2', '150'), ('roof',))
    """
    both = re.fullmatch(r"(.+) \((.+)\)", shown)
    return (shown, *both.groups()) if both else (shown,)


def settings_of(source: Any, setting: str = "model.prior") -> dict[str, Any]:
    """Return settings of one file, of which a name alone is short.

    Raises:
        DataError: others.
    """
    if isinstance(source, Mapping):
        key = "itm" if "itm" in source else "file"
        if key not in source or {*source} - {key, *BESIDE[key]}:
            raise DataError(f"{setting}={source}: takes {key}, {', '.join(BESIDE[key])}")
        return {name: value for name, value in source.items() if value is not None}
    terrain = str(source).removeprefix("itm:")
    return {"file" if terrain == str(source) else "itm": terrain}


def _read_file(
    settings: Mapping[str, Any], data: Measurements, stations: Collection[str]
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, places and levels of each map in one file."""
    path = Path(settings.get("file") or settings["itm"])
    if path.suffix == ".ckpt":
        raise DataError(
            f"model.prior={path}: draw it first, gsparc map ckpt={path}, and give its map.tif"
        )
    if not path.is_file():
        raise DataError(
            f"model.prior={path}: no such file; a raster, such as a GeoTIFF, is needed, or a table "
            "of places and powers"
        )
    beside = {name: value for name, value in settings.items() if name not in BESIDE}
    if "itm" in settings:
        yield from terrain_levels(path, data, **beside)
    elif is_raster(path, settings):
        yield from read_raster(path, **beside).levels(path, data.site.georeference, stations)
    else:
        yield from _read_rows(path, data, stations)


def _near_rows(path: Path, data: Measurements, points: np.ndarray, level: np.ndarray) -> Levels:
    """What is known about rows and stations; `DataError` where that is nothing, or too much."""
    finite = np.isfinite(level) & (np.abs(level) <= MOST_DB) & np.isfinite(points).all(1)
    _say_marks(
        path, int((np.isfinite(level) & (np.abs(level) > MOST_DB)).sum()), f"beyond {MOST_DB} dB"
    )
    if not finite.any():
        raise DataError(f"model.prior={path}: no level is known in it")
    points, level = points[finite], level[finite]
    at = data.moving[:, :2] + data.site.origin[:2]
    if not ((at >= points.min(0) - 1) & (at <= points.max(0) + 1)).all(1).any():
        box, rows = (
            f"x {a:.0f} to {b:.0f}, y {c:.0f} to {d:.0f} m"
            for (a, b), (c, d) in map(_extent, (points, at))
        )
        raise DataError(f"model.prior={path}: it is of {box}, and all rows lie elsewhere: {rows}")
    # Of a whole country only what lies about rows and stations is kept.
    margin, still = (
        max(float(np.ptp(at, axis=0).max()), ABOUT_M),
        data.site.every_station.position[:, :2],
    )
    ends = np.r_[at, still[np.isfinite(still).all(1)] + data.site.origin[:2]]
    near = ((points >= ends.min(0) - margin) & (points <= ends.max(0) + margin)).all(1)
    if near.sum() > MOST:
        raise DataError(
            f"model.prior={path}: {near.sum():,} levels about the rows; {MOST:,} at most are kept"
        )
    points, level = points[near], level[near]
    # A legend states all levels of an overlay, each of which repeats apart from the others.
    marks = [] if path.suffix.lower() == OVERLAY else find_sentinel_levels(level)
    marked = np.isin(level, marks)
    _say_marks(path, int(marked.sum()), f"exactly {list_first([f'{mark:g}' for mark in marks])}")
    return points[~marked], level[~marked]


def _say_marks(path: Path, count: int, what: str) -> None:
    if count:
        advice = "left out as no levels; tag them as nodata of the file"
        log.warning(
            "model.prior=%s: %d levels are %s, apart from all others: %s", path, count, what, advice
        )


def _extent(points: np.ndarray) -> np.ndarray:
    """Lowest and highest (2, 2) of each coordinate."""
    return np.stack([points.min(0), points.max(0)], 1)


def _read_rows(
    path: Path, data: Measurements, stations: Collection[str]
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, places and levels of each station of a table, whose heads may be their names,
    or an npz.
    """
    if is_table(path):
        raw = parse_table(path, stations=stations)
        for note in [
            note for note in raw.notes if isinstance(note, Caution) and "not used" in note
        ]:
            log.warning("model.prior=%s: %s", path, note)
    else:
        raw = read_own(path)
    rows = interpret(raw, path).data
    if not rows.site.maps_levels:
        raise DataError(f"model.prior={path}: no powers of one end that moves")
    theirs, ours = rows.site.georeference, data.site.georeference
    for number, name in enumerate(rows.site.every_station.name):
        of_station = rows.stations_of() == number
        points = (rows.moving + rows.site.origin)[of_station, :2]
        if theirs is not None and ours is not None:
            points = ours.from_degrees(*theirs.to_degrees(points))
        yield name, points, rows.site.target.to_real(rows.target[of_station])[:, 0].astype(float)
