"""`argos-sim`: a stand-in for the Argos release, in its layout, from rays among city blocks.

Not real data. 4,000 users walk in open and blocked streets before an 8 x 8 array at 2.4 GHz; each
snapshot carries a phase, a timing and a frequency offset of its own, as measured ones do. Besides
the release's files (`csidata.npy` of 8 antennas, `base-station.yml`) there are all 64 antennas
(`csidata-64.npy`) and what no release tells: where the users were (`positions.npy`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from gsparc.base.files import whole_folder
from gsparc.base.limits import Checked, setting, whole
from gsparc.data.schema import LIGHT
from gsparc.datasets import argos
from gsparc.datasets.argos import CARRIER_HZ, SPACING_HZ, STAND_IN
from gsparc.datasets.campaign import make_once, write_split
from gsparc.physics.decibels import from_decibels
from gsparc.simulate.streets import StreetPaths, Streets, trace_streets

TONES = np.array(argos.TONES)
FFT = 64  # 20 MHz in 64 tones, of which 52 are used
SIDE = 8
LOWER, UPPER = np.array([-140.0, -105.0]), np.array([140.0, 105.0])  # [m] where users walk
HEIGHT_M = (1.0, 1.9)
MEDIAN_SNR_DB = 25.0
DECODED_DB = 5.0  # a weaker packet is not decoded, so no snapshot of it exists
SCATTERERS = 60
CHUNK = 250  # users whose responses are in memory at once


@dataclass(frozen=True)
class Offsets:
    """Random offsets of each snapshot; 0 switches one off.

    Attributes:
        phase: 1 for a phase drawn from the whole circle.
        timing_s: largest timing error to either side [s]; one sample of 20 MHz is 50 ns.
        frequency: largest residual frequency offset to either side, in tone spacings.
    """

    phase: float = 1.0
    timing_s: float = 100e-9
    frequency: float = 0.01


def build_streets(seed: int = 0, scatterers: int = SCATTERERS) -> Streets:
    """Build nine blocks, a base station in the middle street,
    `scatterers` lamp posts and parked cars.
    """
    rng = np.random.default_rng([seed, 1])
    centres = np.array([(x, y) for x in (-100.0, 0.0, 100.0) for y in (-75.0, 0.0, 75.0)])
    half = np.array([36.0, 25.0]) + rng.uniform(-4.0, 4.0, (9, 2))
    buildings, none = np.stack([centres - half, centres + half], 1), np.zeros(0)
    base = np.array([-50.0, 37, 9])
    streets = Streets(buildings, -rng.uniform(0.7, 0.9, 9), np.zeros((0, 3)), none, none, base)
    places = rng.uniform(1.5 * LOWER, 1.5 * UPPER, (max(400, 6 * scatterers), 2))
    places = places[streets.are_outdoors(places)][:scatterers]
    return replace(
        streets,
        scatterers=np.column_stack([places, rng.uniform(1, 6, len(places))]),
        cross_section=10 ** rng.uniform(2.5, 4.5, len(places)),
        scatterer_phase=rng.uniform(0, 2 * np.pi, len(places)),
    )


def antenna_array() -> np.ndarray:
    """Return element positions (64, 3) [m] about the base: an upright half-wavelength square,
    row by row.

    >>> antenna_array().shape
    (64, 3)
    """
    step = LIGHT / CARRIER_HZ / 2 * (np.arange(SIDE) - (SIDE - 1) / 2)
    across = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)  # it faces both streets of the crossing
    z, x = np.meshgrid(step, step, indexing="ij")
    return x.reshape(-1, 1) * across + z.reshape(-1, 1) * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class World:
    """Users, their rays and the noise: what makes the snapshots, without their offsets.

    Attributes:
        users: (S, 3) [m].
        rays: their paths.
        noise_power: per antenna and tone.
    """

    users: np.ndarray
    rays: StreetPaths
    noise_power: float

    def response(self, frequency_hz: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Return true channels (S, 64, K) complex64 at absolute frequencies (K,) [Hz];
        some `rows` only.
        """
        rows = np.arange(len(self.users)) if rows is None else rows
        parts = []
        for some in np.array_split(rows, max(1, len(rows) // CHUNK)):
            response = self.rays.select_users(some).response(
                antenna_array(), CARRIER_HZ, frequency_hz
            )
            parts.append(response.astype(np.complex64))
        return np.concatenate(parts)


def simulate_world(count: int, seed: int = 0, scatterers: int = SCATTERERS) -> World:
    """Draw `count` users whose packets the base station decodes, in open and in blocked streets.

    Raises:
        ValueError: fewer than `count` users are decoded.
    """
    streets, rng = build_streets(seed, scatterers), np.random.default_rng([seed, 2])
    # Many more than wanted: some are in buildings, some too weak to be decoded.
    across = rng.uniform(LOWER, UPPER, (8 * count, 2))
    across = across[streets.are_outdoors(across)][: 2 * count]
    users = np.column_stack([across, rng.uniform(*HEIGHT_M, len(across))])
    rays = trace_streets(streets, users, LIGHT / CARRIER_HZ)
    power = (np.abs(rays.gain) ** 2).sum(axis=1)
    # Half of the users are heard better than MEDIAN_SNR_DB.
    noise = float(np.median(power)) / from_decibels(MEDIAN_SNR_DB)
    decoded = np.flatnonzero(power > noise * from_decibels(DECODED_DB))[:count]
    if len(decoded) < count:
        raise ValueError(f"argos-sim: only {len(decoded)} of {count} users are decoded")
    return World(users[decoded], rays.select_users(decoded), noise)


def simulate_snapshots(truth: World, offsets: Offsets, seed: int = 0) -> np.ndarray:
    """Draw measured channels (S, 64, 52) complex64: truth, offsets, noise."""
    rng = np.random.default_rng([seed, 3])
    count = len(truth.users)
    clean = truth.response(CARRIER_HZ + TONES * SPACING_HZ)
    phase = offsets.phase * rng.uniform(0, 2 * np.pi, count)
    timing = offsets.timing_s * rng.uniform(-1, 1, count)
    drift = offsets.frequency * rng.uniform(-1, 1, count)
    # The training symbol: what leaks from tone to tone carries its signs.
    pilot = rng.choice([-1.0, 1.0], len(TONES))
    measured = np.empty_like(clean)
    for some in np.array_split(np.arange(count), max(1, count // CHUNK)):
        turn = phase[some, None] - 2 * np.pi * timing[some, None] * TONES * SPACING_HZ
        signal = clean[some] * np.exp(1j * turn)[:, None]
        # A frequency offset turns the samples of a symbol, which leaks tones into one another.
        grid = np.zeros((*signal.shape[:2], FFT), complex)
        # Tones below the carrier stand in the upper half of the transform.
        grid[..., TONES % FFT] = signal * pilot
        turning = np.exp(2j * np.pi * np.outer(drift[some], np.arange(FFT)) / FFT)
        samples = np.fft.ifft(grid) * turning[:, None]
        received = np.fft.fft(samples)[..., TONES % FFT] * pilot
        noise = (
            rng.normal(size=(*received.shape, 2))
            @ np.array([1, 1j])
            * np.sqrt(truth.noise_power / 2)
        )
        measured[some] = received + noise
    return measured


def write_argos_sim(folder: Path, count: int, seed: int, offsets: Offsets, scatterers: int) -> None:
    """Write `count` snapshots in the release's layout; the folder must not exist."""
    truth = simulate_world(count, seed, scatterers)
    measured = simulate_snapshots(truth, offsets, seed)
    with whole_folder(folder) as partial:
        np.save(partial / "csidata.npy", measured[:, :SIDE])
        np.save(partial / "csidata-64.npy", measured)
        np.save(partial / "positions.npy", truth.users)
        places = (build_streets(seed).base + antenna_array()).round(6)
        description = {
            "dataset_name": STAND_IN,
            "carrier_hz": CARRIER_HZ,
            "spacing_hz": SPACING_HZ,
            "tones": TONES.tolist(),
            "noise_power": truth.noise_power,
            "base_station": places[:SIDE].tolist(),
            "base_station_64": places.tolist(),
            "count": count,
            "seed": seed,
            "scatterers": scatterers,
        }
        text = yaml.safe_dump(description, sort_keys=False)
        (partial / "base-station.yml").write_text(text, encoding="utf-8")
        write_split(partial, count, seed)


@dataclass(frozen=True)
class ArgosStandIn(Checked):
    """What `dataset=argos` falls back on; a `gsparc.datasets.campaign.StandIn`.

    Attributes:
        count: users, at least 10.
        seed: of streets, users and noise.
        offsets: whether snapshots have phase, timing and frequency offsets of their own.
        scatterers: lamp posts and cars, at least 1.
        root: folder that holds stand-ins.
    """

    count: int = setting(4000, whole(10))
    seed: int = setting(0, whole(0))
    offsets: bool = True
    scatterers: int = setting(SCATTERERS, whole(1))
    root: str | Path = "outputs/stand-ins"

    def folder(self) -> Path:
        """See `StandIn.folder`."""
        name = f"{STAND_IN}-{self.count}-{self.seed}{'' if self.offsets else '-aligned'}"
        name += "" if self.scatterers == SCATTERERS else f"-{self.scatterers}"
        offsets = Offsets() if self.offsets else Offsets(0.0, 0.0, 0.0)
        return make_once(
            Path(self.root) / name,
            lambda folder: write_argos_sim(folder, self.count, self.seed, offsets, self.scatterers),
        )
