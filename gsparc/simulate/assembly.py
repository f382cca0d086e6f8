"""Shards of a simulation on disk, and the one file in the schema of one's own measurements.

HDF5 does not survive a kill, so nothing is appended to: each shard is a file of its own that
appears by renaming, whole, and the dataset is written from all of them at the end.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsparc.base.files import whole_file, write_whole
from gsparc.data.blocks import allocate, row_blocks
from gsparc.data.schema import Measurements
from gsparc.physics.decibels import from_decibels
from gsparc.simulate.auto import Choice
from gsparc.simulate.paths import ARRAYS, TracedPaths, group_offsets
from gsparc.simulate.settings import CampaignSettings
from gsparc.simulate.spectrum import render_spectra
from gsparc.simulate.survey import Survey, TracingEngine
from gsparc.tables.own import write_own

ROWS = "rows"  # of a shard: which rows of the dataset it holds
NOTE = "choice.json"


class Shards:
    """The folder `FILE.parts` beside a dataset that is being made.

    Args:
        out: the dataset's file.
        plan: everything that decides what the shards hold.

    Raises:
        ValueError: the folder belongs to another simulation.
    """

    def __init__(self, out: Path, plan: Mapping[str, Any]) -> None:
        self.out, self.plan = out, json.dumps(plan, sort_keys=True, indent=1, default=str)
        self.folder = out.with_name(out.name + ".parts")
        self._removed = out.with_name(out.name + ".gone")
        self._sweep()
        stored = self.folder / "plan.json"
        if stored.exists() and stored.read_text(encoding="utf-8") != self.plan:
            raise ValueError(
                f"{self.folder} holds parts of a different simulation; remove it, or choose "
                "another out="
            )
        if not stored.exists():
            write_whole(stored, self.plan)

    def write_note(self, content: Mapping[str, Any]) -> None:
        """Store a decision, so that a resumed run does not decide again."""
        write_whole(self.folder / NOTE, json.dumps(content, indent=1, default=np.ndarray.tolist))

    def read_note(self) -> dict[str, Any] | None:
        """Return the stored decision, or None."""
        path = self.folder / NOTE
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    @property
    def signature(self) -> dict[str, str]:
        """Attribute of the dataset that says which plan it was made by."""
        return {"plan_sha256": hashlib.sha256(self.plan.encode()).hexdigest()}

    def path(self, number: int) -> Path:
        """Return the file of a shard; it is there once the shard is finished."""
        return self.folder / f"shard_{number:04d}.npz"

    def write(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a shard, whole or not at all."""
        with whole_file(self.path(number)) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    def list_shards(self) -> list[int]:
        """Return numbers of the shards that are there."""
        return sorted(
            int(path.stem.removeprefix("shard_")) for path in self.folder.glob("shard_*.npz")
        )

    def read(self, number: int, *names: str) -> dict[str, np.ndarray]:
        """Return the arrays of a finished shard; `names` alone where given."""
        with np.load(self.path(number), allow_pickle=False) as file:
            return {name: file[name] for name in names or file.files}

    def remove(self) -> None:
        """Remove everything, after the dataset is written."""
        # Renamed first: a kill amid the removal would leave shards without the plan
        # that they belong to.
        self._sweep()
        os.replace(self.folder, self._removed)
        self._sweep()

    def _sweep(self) -> None:
        if self._removed.exists():
            shutil.rmtree(self._removed)


# Arrays of paths in the file
STORED = ("offsets", "direction", "gain", "delay", "order", "mechanisms")
# Of the power of a receiver's strongest path: weaker ones are not listed in the file
WEAKEST = 1e-6
SECONDS = "seconds"  # entry of a shard: time of tracing it, kept across interruptions


def shard_arrays(
    paths: TracedPaths, campaign: CampaignSettings, wavelength: float
) -> dict[str, np.ndarray]:
    """Return what a shard keeps of some receivers."""
    frequency = campaign.scene.frequency_hz
    images, peak = render_spectra(paths, campaign.spectrum, frequency, wavelength)
    strongest = np.zeros(len(paths))
    # Unbuffered, as a receiver owns many paths.
    np.maximum.at(strongest, paths.receiver_index, paths.power)
    stored = paths.select_paths(paths.power >= strongest[paths.receiver_index] * WEAKEST)
    return {
        "spectrum": np.round(images * 255).astype(np.uint8),
        "spectrum_peak": peak,
        "csi": paths.responses(frequency, campaign.csi.elements(wavelength), wavelength),
        "received_power": paths.received_power(),
        "delay_spread": paths.delay_spread(),
        "power_below": paths.receiver_sums(paths.power * (paths.direction[:, 2] < 0)),
        "offsets": stored.offsets,
        **{name: getattr(stored, name) for name in ARRAYS},
    }


def assemble_dataset(
    campaign: CampaignSettings,
    survey: Survey,
    choice: Choice | None,
    convergence: Mapping[str, float],
    seconds: float,
    shards: Shards,
    rows: ShardRows,
) -> tuple[Measurements, dict[str, float]]:
    """Write the file from what the shards hold (`join_shards`), drop the shards;
    as `load_own` reads it.

    Facts beside it decide what the data can be used for, as `below_horizon`, the share of power
    that an upper hemisphere cannot show.

    `seconds` [s] were spent on anything but the shards, which know their own; both are the file's
    `simulate_s`.

    Raises:
        ValueError: nothing reaches any receiver.
    """
    seconds += sum(float(shards.read(n, SECONDS)[SECONDS]) for n in shards.list_shards())
    whole, paths, engine = rows.arrays, rows.paths, survey.engine
    power = whole["received_power"]
    reached = power > 0
    if not reached.any():
        raise ValueError("nothing reaches any receiver; is the transmitter inside a building?")
    spread_s = float(np.median(whole["delay_spread"][reached]))
    facts = {
        "below_horizon": float((whole["power_below"][reached] / power[reached]).mean()),
        "delay_spread_ns": spread_s * 1e9,
        "silent_receivers": float((~reached).sum()),
        "paths_per_receiver": len(paths.order) / len(survey),
    }
    arrays = _arrays(campaign, survey, rows)
    about = {**_provenance(campaign, engine), **facts}
    if survey.georeference is not None:
        about |= {f"origin_{name}": value for name, value in asdict(survey.georeference).items()}
    about["antennas"] = json.dumps(
        [str(getattr(engine, "antenna", "isotropic")) for engine in survey.engines]
    )
    if choice is not None:
        about["auto"] = json.dumps(asdict(choice))
    data = write_own(
        shards.out, arrays, {**about, **convergence, **shards.signature, "simulate_s": seconds}
    )
    # Not before: until the file is there, the shards are all that there is.
    shards.remove()
    return data, facts


class ShardRows(NamedTuple):
    """What all shards hold: arrays with a row for each of the survey's, by name,
    and their paths.
    """

    arrays: dict[str, np.ndarray]
    paths: TracedPaths


def join_shards(shards: Shards, rows: int) -> ShardRows:
    """Return what the shards, all of them there, hold of so many rows, in their order.

    One shard is in memory at a time; what is large is put together on disk.
    """
    counts = np.zeros(rows, dtype=np.int64)
    for number in shards.list_shards():
        part = shards.read(number, ROWS, "offsets")
        counts[part[ROWS]] = np.diff(part["offsets"])
    offsets = group_offsets(counts)
    whole: dict[str, np.ndarray] = {}
    for number in shards.list_shards():
        part = shards.read(number)
        index, mine, _ = part.pop(ROWS), part.pop("offsets"), part.pop(SECONDS)
        # Of its paths
        place = np.repeat(offsets[index] - mine[:-1], np.diff(mine)) + np.arange(mine[-1])
        for name, values in part.items():
            at, length = (place, offsets[-1]) if name in ARRAYS else (index, rows)
            if name not in whole:
                whole[name] = allocate((int(length), *values.shape[1:]), values.dtype)
            whole[name][at] = values
    return ShardRows(whole, TracedPaths(offsets, *(whole.pop(name) for name in ARRAYS)))


def _arrays(campaign: CampaignSettings, survey: Survey, rows: ShardRows) -> dict[str, np.ndarray]:
    scene, wavelength, snr_db = (
        campaign.scene,
        survey.engine.wavelength,
        campaign.decided.noise_snr_db,
    )
    (whole, paths), csi = rows, rows.arrays["csi"]
    order = np.random.default_rng(scene.seed).permutation(len(survey.places))
    tests = max(1, round(scene.test_share * len(order)))
    # A place is held out with all transmitters
    each = np.arange(len(survey.engines))[:, None] * len(order)
    arrays = {
        **_ends(survey),
        "frequency_hz": scene.frequency_hz,
        "carrier_hz": np.array(scene.carrier_hz),
        **{
            name: whole[name]
            for name in ("spectrum", "spectrum_peak", "received_power", "delay_spread")
        },
        **{f"path_{name}": getattr(paths, name) for name in STORED},
        "path_gain": paths.gain[:, 0] if paths.gain.shape[1] == 1 else paths.gain,
        "line_of_sight": paths.receiver_sums((paths.order == 0).astype(float)) > 0,
        "split_train": np.sort((order[tests:] + each).ravel()),
        "split_test": np.sort((order[:tests] + each).ravel()),
    }
    if snr_db is not None:
        power = sum(float((np.abs(csi[part]) ** 2).sum()) for part in row_blocks(csi)) / csi.size
        variance = power / from_decibels(snr_db)
        # Another stream than the split's, so that noise does not follow what is held out.
        rng = np.random.default_rng(scene.seed + 1)
        for component in (csi.real, csi.imag):  # all of the one, then all of the other
            for part in row_blocks(csi):
                component[part] += np.sqrt(variance / 2) * rng.normal(size=csi[part].shape)
        arrays["csi_noise_variance"] = np.array(variance)
    arrays["csi"] = allocate(csi.shape, np.complex64)
    for part in row_blocks(csi):
        arrays["csi"][part] = csi[part]
    arrays["spectrum_array_position"] = campaign.spectrum.elements(wavelength)
    if csi.shape[1] > 1:
        elements = campaign.csi.elements(wavelength)
        # one row per channel: with two polarisations every place is there twice
        arrays["csi_array_position"] = np.tile(elements, (csi.shape[1] // len(elements), 1))
    return arrays


def _ends(survey: Survey) -> dict[str, np.ndarray]:
    """Positions in the schema of one transmitter, or of several stations."""
    single = len(survey.engines) == 1
    arrays = {"rx_position": survey.receivers}
    if single:
        arrays["tx_position"] = survey.engine.transmitter
    else:
        arrays |= {"station_position": survey.transmitters, "station": survey.station}
        arrays["station_name"] = np.array(survey.names)
    if survey.time_s is not None:
        arrays["time_s"] = np.tile(survey.time_s, len(survey.engines))
    return arrays


def _provenance(campaign: CampaignSettings, engine: TracingEngine) -> dict[str, Any]:
    """Attributes of the file: what it is and how it was made."""
    return {
        "name": campaign.scene.name,
        "measurement": campaign.measurement,
        "simulator": engine.name,
        "simulator_versions": json.dumps(engine.package_versions()),
        "scene": json.dumps(asdict(campaign.scene)),
        "materials": json.dumps(engine.materials()),
        "effects": str(campaign.decided),
        "effects_json": json.dumps(asdict(campaign.decided)),
        "sampling": json.dumps(asdict(campaign.sampling)),
        "path_gain_convention": "without carrier phase: multiply by exp(-j 2 pi f path_delay)",
        "path_mechanisms_bits": "0 sight, 1 specular, 2 diffuse, 4 refraction, 8 diffraction, 16 "
        "edge",
        "frames": "receiver axes are world axes, z up",
        **campaign.spectrum.attributes(),
    }
