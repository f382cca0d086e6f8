"""Small invented data of the parity fixtures; the same numbers on every machine."""

from __future__ import annotations

import numpy as np
import torch

from gsparc.data.own import from_arrays
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.processes.powers import Rows, trend_of_rows
from gsparc.processes.trend import Law, Trend

CARRIER = 2.4e9
WAVENUMBER = 2 * np.pi * CARRIER / 299_792_458.0
LAW = Law(-35.0, 2.4, 1.5, 3.0, (1.0, -2.0, 3.0))


def spread(count: int, seed: int, size: tuple[float, float, float] = (10.0, 8.0, 1.0)) -> np.ndarray:
    """Places (count, 3) float64 in a box [m]."""
    return np.random.default_rng(seed).uniform(0, 1, (count, 3)) * size


def smooth(places: np.ndarray, outputs: int, seed: int, length: float = 2.0) -> np.ndarray:
    """Values (n, outputs) that vary over `length` [m], with a little noise."""
    rng = np.random.default_rng(seed)
    waves = rng.standard_normal((places.shape[1], 40)) / length
    field = np.cos(places @ waves + rng.uniform(0, 6, 40)) @ rng.standard_normal((40, outputs)) / 5
    return field + 0.05 * rng.standard_normal(field.shape)


def trend(places: np.ndarray, law: Law | None = LAW) -> Trend:
    """A mean law as if it were fitted to places."""
    return trend_of_rows(rows(places), law)


def rows(places: np.ndarray, quiet: int = 0, seed: int = 1) -> Rows:
    """Powers [dB] about `LAW`; nothing was heard in the `quiet` weakest rows, nor above their level."""
    decibels = LAW.mean(torch.from_numpy(places)).numpy() + 4 * smooth(places, 1, seed)[:, 0]
    silent = np.zeros(len(places), bool)
    weakest = np.argsort(decibels)[:quiet]
    silent[weakest] = True
    decibels[weakest] = decibels[weakest].max() if quiet else 0.0
    return Rows(places, decibels, silent)


def fold(count: int, held: int) -> Fold:
    """The last rows are those of the test."""
    every = np.arange(count)
    return Fold(every[: count - held], every[:0], every[count - held :])


def channel(count: int = 60, tones: int = 1, antennas: int = 1, runs: int = 1) -> Measurements:
    """Receivers in a flat patch: direct wave, leakage, plane waves and noise."""
    rng = np.random.default_rng(3)
    place = np.c_[rng.uniform(0, 0.6, (count, 2)), np.full(count, 0.2)]
    end = np.array([0.4, -0.3, 1.5])
    tone = CARRIER + 2e7 * np.arange(tones)
    array = np.c_[0.06 * np.arange(antennas), np.zeros((antennas, 2))]
    at = place[:, None] + array
    away = np.linalg.norm(at - end, axis=-1)[..., None]
    k = 2 * np.pi * tone / 299_792_458.0
    h = np.exp(-1j * k * away) / away + 0.4 * np.exp(0.7j)
    direction = rng.standard_normal((30, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    gain = rng.standard_normal((30, 2)) @ [1, 1j] / 12
    h = h + np.exp(1j * k[:, None] * (at @ direction.T)[..., None, :]) @ gain
    h = h + 0.05 * rng.standard_normal((*h.shape, 2)) @ [1, 1j]
    run = np.arange(count) * runs // count
    h = h * np.array([1.0, 0.8 * np.exp(1.1j), 1.3 * np.exp(-2j)])[run][:, None, None]
    arrays = {"rx_position": place, "tx_position": end, "csi": h, "carrier_hz": np.array(CARRIER)}
    more = {"run": run} if runs > 1 else {}
    if antennas > 1:
        more |= {"array": array, "rx_orientation": np.broadcast_to([0.0, 0, 0, 1], (count, 4))}
    return from_arrays({**arrays, **more, "frequency_hz": tone})


def ceiling(count: int = 40, ends: int = 3) -> Measurements:
    """A transmitter in a flat patch, antennas above it."""
    rng = np.random.default_rng(5)
    place = np.c_[rng.uniform(0, 0.7, (count, 2)), np.full(count, 0.2)]
    end = np.c_[rng.uniform(-1, 2, (ends, 2)), np.full(ends, 1.8)]
    away = np.linalg.norm(place[:, None] - end, axis=-1)
    h = np.exp(-1j * WAVENUMBER * away) / away + 0.1 * rng.standard_normal((count, ends, 2)) @ [1, 1j]
    arrays = {"tx_position": place, "station_position": end, "csi": h, "carrier_hz": np.array(CARRIER)}
    return from_arrays({**arrays, "frequency_hz": np.array([CARRIER])})
