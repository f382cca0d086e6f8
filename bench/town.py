"""A town for measuring what grows with the rows: the same shadows whatever is measured of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gsparc.data.schema import Measurements
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import PlaceValues, condition_on_nearest
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Trend
from gsparc.tables.own import from_arrays

SIDE_M = 3_000.0
# Deviation [dB] and wavelength / 2 pi [m] of shadowing
SCALES = ((6.0, 250.0), (3.0, 40.0), (1.5, 8.0))
WAVES = 60  # of each
NOISE_DB = 1.0
STATION = (1_400.0, 1_600.0, 25.0)
HEIGHT_M = 1.5  # of what moves
TESTED = 2_000
CITY = Path(__file__).parents[2] / "shared" / "data" / "real" / "powder-rss-462mhz.npz"
# The station most heard of; noise as gp finds it
STATION_USED, JITTER_M, CITY_NOISE_DB = 11, 15.0, 3.0


def town(count: int) -> Measurements:
    """Powers of `count` rows to learn from, and, behind them,
    of `TESTED` places that no number changes.
    """
    rng = np.random.default_rng([0, count])
    parts = [
        np.random.default_rng(2).uniform(0, SIDE_M, (TESTED, 2)),
        rng.uniform(0, SIDE_M, (count, 2)),
    ]
    places = np.concatenate(parts[::-1])
    decibels = shadowed(places, np.array(STATION), np.random.default_rng(1))
    decibels += NOISE_DB * rng.standard_normal(len(places))
    arrays = {
        "rx_position": np.c_[places, np.full(len(places), HEIGHT_M)],
        "tx_position": np.array(STATION),
        "rssi_db": decibels,
    }
    return from_arrays(arrays, {"name": "town"})


def shadowed(places: np.ndarray, station: np.ndarray, shadows: np.random.Generator) -> np.ndarray:
    """Powers (n,) [dB] without noise at places (n, 2) [m]: a distance law and shadowing."""
    distance = np.hypot(np.linalg.norm(places - station[:2], axis=1), station[2] - HEIGHT_M)
    decibels = -20 - 35 * np.log10(distance)
    for deviation, length in SCALES:
        waves, phase = (
            shadows.normal(size=(WAVES, 2)) / length,
            shadows.uniform(0, 2 * np.pi, WAVES),
        )
        # One at a time: a million rows stay in memory
        for wave, turn in zip(waves, phase, strict=True):
            decibels += deviation * np.sqrt(2 / WAVES) * np.cos(places @ wave + turn)
    return decibels


def city(count: int) -> Measurements:
    """Return the same of a measured city: places about measured ones, powers by a process of them.

    Its noise is drawn anew. Measured powers drawn again and again would share the noise they were
    measured with, and no number of rows would take that away.
    """
    with np.load(CITY) as stored:
        heard = np.flatnonzero(np.isfinite(stored["rssi_db"][:, STATION_USED]))
        points = np.pad(stored["mobile_position"][heard].astype(float), ((0, 0), (0, 1)))
        powers = stored["rssi_db"][heard, STATION_USED].astype(float)
        station = np.append(stored["station_position"][STATION_USED], 0.0)
    rng, parts = np.random.default_rng([0, count]), []
    for part, number in ((rng, count), (np.random.default_rng(2), TESTED)):
        place = points[part.integers(len(points), size=number)]
        place[:, :2] += JITTER_M * part.normal(size=(number, 2))
        parts.append(place)
    places = np.concatenate(parts)
    prior = Prior(
        Kernel.from_lengths((80.0, 500.0), (0.3, 0.7), 0.2, 60.0), Trend(float(powers.mean()))
    )
    process = condition_on_nearest(
        prior, PlaceValues.from_rows(points, torch.from_numpy(powers)[:, None]), 0
    )
    with torch.no_grad():
        decibels = process.mean_at(torch.from_numpy(places))[:, 0].numpy()
    decibels += CITY_NOISE_DB * rng.standard_normal(len(places))
    arrays = {"tx_position": places, "rx_position": station, "rssi_db": decibels}
    return from_arrays(arrays, {"name": "city"})
