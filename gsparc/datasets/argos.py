"""The Argos release's layout: `csidata.npy` [N, 8, 52] and `base-station.yml`, uplink in,
downlink out.

The first 26 tones are the uplink, the last 26 the downlink of the same snapshot. Users' positions
were not recorded: they come from an encoder of the uplink (`gsparc.data.position_encoder`), or from
the stand-in's truth. Every prediction therefore uses a fresh uplink of the same snapshot,
if only to locate the user.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError, Problems, readable
from gsparc.base.files import read_yaml
from gsparc.base.limits import choice, finite_array, or_word, whole
from gsparc.data.assemble import centre_and_hash
from gsparc.data.position_encoder import encode_positions
from gsparc.data.scale import rounded_rms
from gsparc.data.schema import Measurements, Site, TrainTest
from gsparc.datasets.campaign import Release, StandIn, load_stand_in, read_split
from gsparc.tables.own_checks import Checker
from gsparc.tables.raw import Raw

UPLINK = 26  # tones
CARRIER_HZ = 2.4e9
# OFDM of IEEE 802.11a/g in 20 MHz: 52 tones, 312.5 kHz apart, none at the carrier.
SPACING_HZ = 312.5e3
TONES = (*range(-26, 0), *range(1, 27))
STAND_IN = "argos-sim"
FACTS = ("count", "seed", "scatterers")  # of a stand-in, from which its streets are rebuilt


def load_argos(
    root: str | Path,
    *,
    antenna: int | str = 0,
    tone: int | str = "all",
    positions: str | bool = "encoder",
    align: bool = True,
) -> Measurements:
    """Read a folder in the release's layout: kind csi, static transmitter, targets (S, A, K)
    complex64.

    Args:
        root: the folder; `csidata-64.npy` is preferred where a folder has it.
        antenna: number of the antenna to predict, or `all`.
        tone: number of the downlink's tone to predict, or `all` 26.
        positions: `encoder`, those of `encode_positions` by the training rows, or `true` where the
            folder has `positions.npy` (the stand-in).
        align: turn every snapshot by the phase and the mean delay of its own uplink. These are
            offsets of the snapshot; a factor of modulus 1 changes no error.

    Raises:
        DataError: anything is missing or wrong.
    """
    # `true` in YAML is no text
    root, positions, align = Path(root), str(positions).lower(), bool(align)
    choice("encoder", "true").check("dataset.positions", positions)
    expected = "`base_station:` with a list of antenna positions [m]"
    description = read_yaml(root / "base-station.yml", "the antennas' positions", expected)
    csi = _channels(root)
    places = _antennas(root, description, csi.shape[1])
    count = csi.shape[1]
    or_word(whole(0, count - 1), "all").check("dataset.antenna", antenna)
    or_word(whole(0, UPLINK - 1), "all").check("dataset.tone", tone)
    downlink = np.arange(UPLINK, 2 * UPLINK) if tone == "all" else np.array([UPLINK + int(tone)])
    chosen = np.arange(count) if antenna == "all" else np.array([antenna])
    tones = np.array(description.get("tones", TONES), dtype=np.float64)
    spacing = float(description.get("spacing_hz", SPACING_HZ))
    carrier = float(description.get("carrier_hz", CARRIER_HZ))
    if align:
        csi = remove_uplink_offsets(csi, tones)
    scale = rounded_rms(csi)
    # In complex128, as the reciprocal of a small scale overflows in complex64.
    csi = (csi.astype(np.complex128) / scale).astype(np.complex64)
    uplink, target = csi[..., :UPLINK], np.ascontiguousarray(csi[:, chosen][..., downlink])
    problems = Problems(root)
    split = read_split(root, len(csi), problems)
    problems.raise_if_any()
    where = _places(root, positions, uplink, split)
    simulated = description.get("dataset_name") == STAND_IN
    noise = description.get("noise_power")
    facts = {name: str(description[name]) for name in FACTS if name in description}
    base, frequency = places.mean(axis=0), carrier + tones * spacing
    site = Site(
        STAND_IN if simulated else "argos",
        "csi",
        "tx",
        None,
        None,
        carrier,
        frequency[downlink],
        stand_in="argos" if simulated else None,
        target_scale=scale,
        uplink_array=places - base,
        uplink_hz=frequency[:UPLINK],
        antennas=chosen,
    )
    return centre_and_hash(
        Measurements(
            site,
            np.tile(base, (len(csi), 1)),
            where,
            np.tile(np.eye(3), (len(csi), 1, 1)),
            target,
            noise_variance=None if noise is None else np.full(len(csi), float(noise) / scale**2),
            row_names=[f"snapshot {i}" for i in range(len(csi))],
            release_split=split,
            provenance={"layout": "argos", "positions": positions, "aligned": str(align), **facts},
            uplink=np.ascontiguousarray(uplink),
        )
    )


def remove_uplink_offsets(csi: np.ndarray, tones: np.ndarray) -> np.ndarray:
    """Return snapshots (S, A, K) without mean delay and phase
    of their uplink (its tones come first).
    """
    uplink, numbers = csi[..., :UPLINK], tones[:UPLINK]
    step = np.diff(numbers)[0]
    # Mean phase step between neighbouring tones, weighted by their power:
    # a delay without unwrapping.
    turn = np.angle((uplink[..., 1:] * uplink[..., :-1].conj()).sum((1, 2))) / step
    middle = numbers.mean()
    # The downlink too: timing and phase offsets belong to the snapshot, not to a band.
    straight = csi * np.exp(-1j * turn[:, None] * (tones - middle))[:, None]
    # The phase of the sum over all antennas and tones.
    phase = np.angle(straight[..., :UPLINK].sum((1, 2)))
    return straight * np.exp(-1j * phase)[:, None, None]


def _channels(root: Path) -> np.ndarray:
    path = root / "csidata-64.npy"
    path = path if path.exists() else root / "csidata.npy"
    csi = _loaded(path, "expected complex channels [N, antennas, 52]")
    if csi.ndim != 3 or csi.shape[2] != 2 * UPLINK or csi.dtype.kind != "c":
        expected = f"complex [N, antennas, {2 * UPLINK}]"
        raise DataError(f"{path}: expected {expected}, found {csi.dtype} {csi.shape}")
    for good, fault in (
        (np.isfinite(csi).all((1, 2)), "NaN or Inf; expected finite channels"),
        # A silent uplink has no phase to align to, and no place to be encoded.
        (np.abs(csi[..., :UPLINK]).any((1, 2)), "its uplink is silent; expected a received packet"),
    ):
        if not good.all():
            raise DataError(f"{path}, snapshot {good.argmin()}: {fault}")
    return csi


def _loaded(path: Path, expected: str) -> np.ndarray:
    with readable(path, "not readable", (ValueError, OSError), f"missing; {expected}"):
        return np.asarray(np.load(path, allow_pickle=False))


def _antennas(root: Path, description: Mapping[str, Any], count: int) -> np.ndarray:
    # One description may hold the antennas of the files of 8 and of 64.
    key = f"base_station_{count}" if f"base_station_{count}" in description else "base_station"
    places = finite_array(description.get(key))
    if places.shape != (count, 3):
        fault = f"{key} has shape {places.shape}; expected {count} x 3 metres, one antenna per line"
        raise DataError(f"{root / 'base-station.yml'}: {fault}")
    return places


def _places(root: Path, of: str, up: np.ndarray, split: TrainTest | None) -> np.ndarray:
    if of == "true":
        path = root / "positions.npy"
        stored = _loaded(path, "true positions exist in the stand-in only")
        check = Checker(Raw({"rx_position": np.atleast_2d(stored)}), str(path))
        places = check.read_positions("rx_position", len(up))
        check.problems.raise_if_any()
        return np.asarray(places)
    # The encoder sees training rows alone: uplinks of test rows must not shape its codes.
    rows = np.arange(len(up)) if split is None else split[0]
    return encode_positions(up, rows)


class Argos(Release):
    """The Argos release or any folder in its layout; settings of `load_argos` and `Release`."""

    called, reader = "Argos", staticmethod(load_argos)
    hint = (
        "It comes with the code of FIRE and NeRF2: put csidata.npy and base-station.yml into "
        "a folder"
    )


class ArgosSim(Argos):
    """The simulated stand-in in the Argos layout: `dataset=argos_sim`; arguments as of `Argos`."""

    def __init__(
        self, stand_in: StandIn, root: None = None, name: str = "argos_sim", **rest: Any
    ) -> None:
        if root is not None:
            raise DataError(
                f"dataset.root={root}: the stand-in has none; say dataset=argos for a release"
            )
        super().__init__(None, name=name, stand_in=stand_in, **rest)

    def load(self) -> Measurements:
        """Load as `Argos.load` does, without a word about the release."""
        assert self.stand_in is not None
        return load_stand_in(self.stand_in, self.called, self.read)
