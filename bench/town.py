"""A town for measuring what grows with the rows: the same shadows whatever is measured of it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import torch

from gsparc.data.own import from_arrays
from gsparc.data.schema import LIGHT, Measurements
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import Values, given
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Trend

SIDE_M = 3_000.0
SCALES = ((6.0, 250.0), (3.0, 40.0), (1.5, 8.0))  # deviation [dB] and wavelength / 2 pi [m] of shadowing
WAVES = 60  # of each
NOISE_DB = 1.0
STATION = (1_400.0, 1_600.0, 25.0)
HEIGHT_M = 1.5  # of what moves
TESTED = 2_000
SCATTERERS, ANTENNAS, TONES = 10, 16, 64  # of the hall; antennas in a row, half a wavelength apart
CITY = Path(__file__).parents[2] / "shared" / "data" / "real" / "powder-rss-462mhz.npz"
STATION_USED, JITTER_M, CITY_NOISE_DB = 11, 15.0, 3.0  # the station most heard of; noise as gp finds it


def town(count: int) -> Measurements:
    """Powers of `count` rows to learn from, and, behind them, of `TESTED` places that no number changes."""
    rng = np.random.default_rng([0, count])
    parts = [np.random.default_rng(2).uniform(0, SIDE_M, (TESTED, 2)), rng.uniform(0, SIDE_M, (count, 2))]
    places = np.concatenate(parts[::-1])
    decibels = shadowed(places, np.array(STATION), np.random.default_rng(1))
    decibels += NOISE_DB * rng.standard_normal(len(places))
    arrays = {
        "rx_position": np.c_[places, np.full(len(places), HEIGHT_M)], "tx_position": np.array(STATION),
        "rssi_db": decibels,
    }  # fmt: skip
    return from_arrays(arrays, {"name": "town"})


def shadowed(places: np.ndarray, station: np.ndarray, shadows: np.random.Generator) -> np.ndarray:
    """Powers (n,) [dB] without noise at places (n, 2) [m]: a distance law and shadowing."""
    distance = np.hypot(np.linalg.norm(places - station[:2], axis=1), station[2] - HEIGHT_M)
    decibels = -20 - 35 * np.log10(distance)
    for deviation, length in SCALES:
        waves, phase = shadows.normal(size=(WAVES, 2)) / length, shadows.uniform(0, 2 * np.pi, WAVES)
        for wave, turn in zip(waves, phase, strict=True):  # one at a time: a million rows stay in memory
            decibels += deviation * np.sqrt(2 / WAVES) * np.cos(places @ wave + turn)
    return decibels


def city(count: int) -> Measurements:
    """Return the same of a measured city: places about measured ones, powers by a process of them.

    Its noise is drawn anew. Measured powers drawn again and again would share the noise they were measured
    with, and no number of rows would take that away.
    """
    with np.load(CITY) as stored:
        heard = np.flatnonzero(np.isfinite(stored["rssi_db"][:, STATION_USED]))
        known = np.pad(stored["mobile_position"][heard].astype(float), ((0, 0), (0, 1)))
        powers = stored["rssi_db"][heard, STATION_USED].astype(float)
        station = np.append(stored["station_position"][STATION_USED], 0.0)
    rng, parts = np.random.default_rng([0, count]), []
    for part, number in ((rng, count), (np.random.default_rng(2), TESTED)):
        place = known[part.integers(len(known), size=number)]
        place[:, :2] += JITTER_M * part.normal(size=(number, 2))
        parts.append(place)
    places = np.concatenate(parts)
    prior = Prior(Kernel.matern((80.0, 500.0), (0.3, 0.7), 0.2, 60.0), Trend(float(powers.mean())))
    posterior = given(prior, Values.of(known, torch.from_numpy(powers)[:, None]), 0)
    with torch.no_grad():
        decibels = posterior.mean_at(torch.from_numpy(places))[:, 0].numpy()
    decibels += CITY_NOISE_DB * rng.standard_normal(len(places))
    arrays = {"tx_position": places, "rx_position": station, "rssi_db": decibels}
    return from_arrays(arrays, {"name": "city"})


def hall(path: Path, count: int) -> None:
    """Write channels of places in a hall of 10 m by 10 m, of which the last `TESTED` are for the test.

    A direct wave and `SCATTERERS` others at 3.5 GHz and 100 MHz, noise of a thousandth of their power.

    Args:
        path: *.h5, written block by block.
        count: rows to learn from.
    """
    world, rng = np.random.default_rng(3), np.random.default_rng([0, count])
    sources = np.concatenate([[[12.0, 5.0, 3.0]], world.uniform([-8, -8, 0], [18, 18, 5], (SCATTERERS, 3))])
    gain = np.concatenate([[1.0], 0.3 * world.normal(size=SCATTERERS)])
    places = np.c_[rng.uniform(0, 10, (count + TESTED, 2)), np.full(count + TESTED, 1.5)]
    frequency = 3.5e9 + 1e8 * (np.arange(TONES) / TONES - 0.5)
    apart = np.arange(ANTENNAS) * 0.5 * LIGHT / 3.5e9
    with h5py.File(path, "w") as file:
        file["rx_position"], file["tx_position"] = places, sources[0]
        file["frequency_hz"], file["carrier_hz"] = frequency, 3.5e9
        stored = file.create_dataset("csi", (len(places), ANTENNAS, TONES), np.complex64)
        for start in range(0, len(places), 2_000):
            towards = sources - places[start : start + 2_000, None]
            far = np.linalg.norm(towards, axis=2)
            steer = np.exp(2j * np.pi * 3.5e9 / LIGHT * (towards[..., :1] / far[..., None]) * apart)
            turn = np.exp(-2j * np.pi / LIGHT * far[..., None] * frequency)
            clean = np.einsum("npa,npk->nak", (gain / far)[..., None] * steer, turn, optimize=True)
            noise = rng.standard_normal((2, *clean.shape), np.float32) * np.float32(
                np.abs(clean).std() * 0.03
            )
            stored[start : start + 2_000] = (clean + noise[0] + 1j * noise[1]).astype(np.complex64)
