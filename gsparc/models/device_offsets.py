"""Offsets of the devices that measured: estimated from training rows,
taken off before any method learns.

Two phones at one place read levels that differ by a constant: one for each device over all stations
is estimated beside a field of levels at each. Antennas and filters differ from carrier to carrier:
at a station whose own rows say so it is another, shrunk to the common one. Offsets belong to the
site: what methods learn and answer is the mean device's level, to which that of a named device is
added.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from gsparc.base.errors import list_first
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.processes.few_rows import first_rows
from gsparc.processes.level_field import fit_level_field

log = logging.getLogger(__name__)

# That tell; the cost is a station's cube
MOST_ROWS, MOST_OF_STATION, LEAST_OF_STATION = 6000, 1000, 60
SAID, TINY = 12, 1e-12  # stations, whose offsets are listed


def remove_device_offsets(data: Measurements, fold: Fold) -> Measurements:
    """Return levels as the mean device would read them,
    and a site that knows the offset of each device.

    Only training rows tell. A device that has none there is taken for the mean one. Measurements
    whose rows name no devices are returned as they are.
    """
    if data.device is None or data.site.device_names is None:
        return data
    names, rows = data.site.device_names, fold.train[data.censored_side(fold.train) == 0]
    level = to_decibels(
        np.maximum(data.target[rows, 0].astype(np.float64), np.finfo(np.float32).tiny)
    )
    station = data.stations_of(rows)
    most = int(np.clip(MOST_ROWS / len(np.unique(station)), LEAST_OF_STATION, MOST_OF_STATION))
    order = np.random.default_rng(0).permutation(len(rows))
    some = first_rows(order, most, station, np.zeros(len(rows), bool))
    device, heard = data.device[rows][some], np.unique(data.device[rows][some])
    each = [(device == number).astype(float) for number in heard[1:]]
    field = fit_level_field(data.moving[rows][some], level[some], station[some], each)
    # As many columns as devices, of which the first has none
    offset = np.r_[0.0, field.slope]
    own = _offsets_of_stations(data.moving[rows][some], level[some], station[some], each, offset)
    offsets = np.tile(offset, (len(data.site.every_station), 1))
    offsets[[*own]] = np.array([*own.values()]).reshape(-1, len(offset))
    offsets -= offsets.mean(1, keepdims=True)
    # The last row is of the mean device, and of those that nothing is known of.
    spread = offsets.var(1, ddof=1) if len(offset) > 1 else np.zeros(len(offsets))
    levels = np.zeros((len(offsets), len(names) + 1, 2))
    levels[:, :, 1] = spread[:, None]
    levels[:, heard] = np.stack([offsets, 0 * offsets], -1)
    shown = data.site.every_station.shown
    for number in np.unique(station)[:SAID] if len(offset) > 1 else ():
        notes = [f"{names[k]} {v:+.1f} dB" for k, v in zip(heard, offsets[number], strict=True)]
        log.info("devices%s: %s", f" at {shown[number]}" * data.site.several, list_first(notes, 6))
    return subtract_known_device_offsets(data, replace(data.site, device_levels=levels))


def _offsets_of_stations(
    place: np.ndarray,
    level: np.ndarray,
    station: np.ndarray,
    each: list[np.ndarray],
    common: np.ndarray,
) -> dict[int, np.ndarray]:
    """Offsets (D,) [dB] by station, the common ones (D,) before its rows: shrunk to these by how
    much stations differ beside how unsure each is.
    """
    numbers = [n for n in np.unique(station).tolist() if (station == n).sum() >= LEAST_OF_STATION]
    own, unsure = list[np.ndarray](), list[np.ndarray]()
    for number in numbers:
        rows = np.flatnonzero(station == number)
        columns = [column[rows] for column in each]
        field = fit_level_field(place[rows], level[rows], 0 * rows, columns)
        precision = field.precision(place[rows])
        ones = np.column_stack([np.ones(len(rows)), field.columns])
        variance = np.linalg.pinv(ones.T @ precision @ ones).diagonal()[1:]
        seen = np.array([0 < column.sum() < len(rows) for column in columns])
        own.append(np.where(seen, field.slope, common[1:]))
        unsure.append(np.where(seen, variance, np.inf))
    if not each or not numbers:
        return {}
    away, known = np.array(own) - common[1:], 1 / np.array(unsure)
    between = np.maximum((known * away**2).sum() - (known > 0).sum(), 0) / max(known.sum(), TINY)
    share = between / (between + np.array(unsure))
    moved = common + np.c_[np.zeros(len(numbers)), share * away]
    return dict(zip(numbers, moved, strict=True))


def subtract_known_device_offsets(data: Measurements, site: Site) -> Measurements:
    """Return rows less the offsets that a site knows, and as its;
    as they are where they name no devices.
    """
    if data.device is None or site.device_levels is None:
        return data
    factor = from_decibels(-site.device_levels[data.stations_of(), data.device, 0])
    target = (data.target * factor[:, None]).astype(data.target.dtype)
    noise = (
        None
        if data.noise_variance is None
        else data.noise_variance * (factor**2).astype(np.float32)
    )
    levels = replace(data.site, device_levels=site.device_levels)
    return replace(data, target=target, noise_variance=noise, device=None, site=levels)


def find_device(name: str, site: Site) -> int:
    """Return the number of a device by its name; `ValueError` where there is none."""
    names = site.device_names or ()
    if name not in names:
        hint = f"there are {list_first(names)}" if names else f"{site.name} tells no devices apart"
        raise ValueError(f"no device {name!r}; {hint}")
    return names.index(name)
