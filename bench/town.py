"""A town for measuring what grows with the rows: the same shadows whatever is measured of it."""

from __future__ import annotations

import numpy as np

from gsparc.data.own import from_arrays
from gsparc.data.schema import Measurements

SIDE_M = 3_000.0
SCALES = ((6.0, 250.0), (3.0, 40.0), (1.5, 8.0))  # deviation [dB] and wavelength / 2 pi [m] of shadowing
WAVES = 60  # of each
NOISE_DB = 1.0
STATION = (1_400.0, 1_600.0, 25.0)
TESTED = 2_000


def town(count: int, seed: int = 0) -> Measurements:
    """Powers of `count` rows to learn from, and, behind them, of `TESTED` places that no number changes.

    Args:
        count: rows.
        seed: of places and noise.
    """
    shadows, rng = np.random.default_rng(1), np.random.default_rng([seed, count])
    drawn = [np.random.default_rng(2).uniform(0, SIDE_M, (TESTED, 2)), rng.uniform(0, SIDE_M, (count, 2))]
    places = np.concatenate(drawn[::-1])
    distance = np.hypot(np.linalg.norm(places - STATION[:2], axis=1), STATION[2] - 1.5)
    decibels = -20 - 35 * np.log10(distance)
    for deviation, length in SCALES:
        waves, phase = shadows.normal(size=(WAVES, 2)) / length, shadows.uniform(0, 2 * np.pi, WAVES)
        for wave, turn in zip(waves, phase, strict=True):  # one at a time: a million rows stay in memory
            decibels += deviation * np.sqrt(2 / WAVES) * np.cos(places @ wave + turn)
    decibels += NOISE_DB * rng.standard_normal(len(places))
    arrays = {
        "rx_position": np.c_[places, np.full(len(places), 1.5)], "tx_position": np.array(STATION),
        "rssi_db": decibels,
    }  # fmt: skip
    return from_arrays(arrays, {"name": "town"})
