"""Offsets of the devices that measured: estimated from training rows,
taken off before any method learns.

Two phones at one place read levels that differ by a constant. One number for each device over all
stations is estimated beside a field of levels at each, and belongs to the site: what methods learn
and answer is the mean device's level, to which that of a named device is added.
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


def take_off_devices(data: Measurements, fold: Fold) -> Measurements:
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
    offset = np.r_[0.0, field.slope]
    offset -= offset.mean()
    # The last row is of the mean device, and of those that nothing is known of.
    spread = float(offset.var(ddof=1)) if len(offset) > 1 else 0.0
    levels = np.tile([0.0, spread], (len(names) + 1, 1))
    levels[heard] = np.c_[offset, np.zeros(len(heard))]
    notes = [
        f"{names[number]} {value:+.1f} dB" for number, value in zip(heard, offset, strict=True)
    ]
    log.info("devices: %s, beside their mean", list_first(notes, 6))
    return without_devices(data, replace(data.site, device_levels=levels))


def without_devices(data: Measurements, site: Site) -> Measurements:
    """Return rows less the offsets that a site knows, and as its;
    as they are where they name no devices.
    """
    if data.device is None or site.device_levels is None:
        return data
    factor = from_decibels(-site.device_levels[data.device, 0])
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
