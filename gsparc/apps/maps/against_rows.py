"""A map's file, or a model, beside rows measured later."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.apps.maps.promise import Promise
from gsparc.base.errors import DataError, explain_error
from gsparc.data.georeference import Georeference
from gsparc.data.schema import Measurements
from gsparc.data.units import power_in_decibels
from gsparc.evaluation.by_part import Drive
from gsparc.prediction.levels import measured_levels
from gsparc.processes.uncertainty import half_width

SHARE = 0.9  # of measurements that a model's intervals are to hold


def drive_beside_map(path: str | Path, data: Measurements) -> Drive:
    """Return rows beside the squares of a `map.npz` that they lie in, cell by cell by name.

    Raises:
        DataError: no map, metres of another origin, or none of its cells was measured.
    """
    try:
        with np.load(path) as archive:
            stored = dict(archive)
    except (OSError, ValueError) as error:
        raise DataError(f"ckpt={path}: {explain_error(error)}") from None
    if missing := {"x", "y", "power_db", "stations", "origin"} - stored.keys():
        raise DataError(f"ckpt={path}: no map of gsparc map (lacks {', '.join(sorted(missing))})")
    x, y = stored["x"], stored["y"]
    rows = np.arange(len(data))
    level, side = measured_levels(data, rows)
    place = data.moving[:, -3:-1] + data.site.origin[:2]
    at, about = place, data.site.georeference
    if (about is None) == bool(len(stored["origin"])):
        raise DataError(f"ckpt={path}: one of map and rows has degrees, the other metres alone")
    if about is not None:
        at = Georeference(*stored["origin"].tolist()).from_degrees(*about.to_degrees(place))
    names = list(data.site.every_station.shown) or [""]
    number = np.array([_find(name, stored["stations"].tolist()) for name in names])
    if (number < 0).all():
        raise DataError(f"ckpt={path}: has none of the rows' cells {', '.join(names[:5])}")
    cell, column, row = number[data.stations_of(rows)], _nearest(x, at[:, 0]), _nearest(y, at[:, 1])
    known = (cell >= 0) & (column >= 0) & (row >= 0) & (side == 0)
    power, low, high = (
        np.where(known, stored[name][cell, row, column], np.nan)
        for name in ("power_db", "lower_db", "upper_db")
    )
    return drive_of(data, rows, power - level, (high - low) / 2, float(stored["share"]))


def _find(name: str, names: list[str]) -> int:
    return names.index(name) if name in names else -1 if len(names) > 1 else 0


def _nearest(centres: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Number of the square (n,) whose centre is nearest; -1 outside of all."""
    step = centres[1] - centres[0] if len(centres) > 1 else np.inf
    number = np.rint((at - centres[0]) / step).astype(int)
    return np.where((number >= 0) & (number < len(centres)), number, -1)


def drive_beside_model(
    columns: dict[str, np.ndarray], data: Measurements, promise: Promise | None
) -> Drive:
    """Return scored rows of powers, `columns` of `per_sample.csv`; intervals are tested ones where
    the model has some.
    """
    rows = np.asarray(columns["row"])
    spread = power_in_decibels(
        np.asarray(columns["prediction"], float), np.asarray(columns["variance"], float)
    )[1]
    half, station = half_width(SHARE) * spread, data.stations_of(rows)
    if promise is not None:
        far = promise.distances(data.moving[rows], station)
        half = promise.calibration(SHARE).half_and_error(spread, far, station)[0]
    return drive_of(data, rows, np.asarray(columns["error_db"]), half, SHARE)


def drive_of(
    data: Measurements, rows: np.ndarray, error: np.ndarray, half: np.ndarray, share: float
) -> Drive:
    """Return errors (n,) and half intervals (n,) [dB] of rows (n,) with their places."""
    station, local = data.stations_of(rows), data.moving[rows][:, -3:-1]
    still = data.site.every_station.position[station, :2]
    place = local + data.site.origin[:2]
    names = list(data.site.every_station.shown) or [data.site.name]
    distance = np.linalg.norm(local - still, axis=1)
    return Drive(error, half, place, distance, station, names, share)
