"""Powers under sources that interfere."""

import numpy as np

from gsparc.data.schema import LIGHT, Measurements
from gsparc.tables.own import from_arrays

WAVELENGTH = 0.3


def plane(count: int, seed: int = 0) -> Measurements:
    """Half a metre square under twelve sources that interfere, with 0.5 dB of noise."""
    rng = np.random.default_rng(seed)
    places = np.c_[rng.uniform(0, 0.6, (count, 2)), np.zeros(count)]
    sources = np.c_[rng.uniform(-3, 3, (12, 2)), rng.uniform(1, 2, 12)]
    far = np.linalg.norm(places[:, None] - sources, axis=-1)
    field = np.exp(-2j * np.pi * far / WAVELENGTH) / far @ np.exp(2j * np.pi * rng.uniform(size=12))
    decibels = 10 * np.log10(np.abs(field) ** 2 + 1e-3) + 0.5 * rng.standard_normal(count)
    return from_arrays(
        {"rx_position": places, "rssi_db": decibels, "frequency_hz": LIGHT / WAVELENGTH},
        {"name": "plane"},
    )
