"""Files of channel emulators, written and read back: sionna-rk's `cirs.bin` and vrtsim's `cir_db.bin`.

Layouts: sionna-rk's `cir_file.c`, OpenAirInterface's `cirdb_provider.c`, `cirdb_yaml.cpp` (docs/export.md).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from gsparc.data.errors import DataError
from gsparc.data.files import read_text, read_yaml
from gsparc.prediction.along.taps import Line

LATEST = 256  # samples, the delay from which sionna-rk takes no tap
PUBLISHED = 8  # taps per link that vrtsim plays
ANTENNAS = 8  # that it has at an end
SLOTS = 1000  # that are written at once
KEYS = ("num_taps", "num_cirs", "sigma_scaling", "sigma_max")
WHOLE = ("n_tx", "n_rx", "L", "S")


@dataclass(frozen=True)
class Reading:
    """What a file holds, in words, and what its reader would refuse or ignore, one line each."""

    holds: str
    refused: tuple[str, ...]


def entry(taps: int) -> np.dtype:
    """One OFDM symbol of `cirs.bin`, padded to 4 bytes."""
    packed = [("norm", "<f4"), ("taps", "<f4", (taps, 2)), ("index", "<u2", (taps,))]
    return np.dtype([*packed, ("pad", "u1", (2 * (taps % 2),))])


def write_sionna_rk(folder: Path, line: Line, symbol_s: float, symbols: int) -> int:
    """`cirs.bin` and `config.json` of the first antenna, without noise; returns the number of OFDM symbols.

    A symbol is `symbol_s` long with its cyclic prefix [s]; whole slots of `symbols` are written.

    Raises:
        ValueError: more than 256 taps, or a trajectory shorter than a slot.
    """
    taps, time_s = line.gain.shape[2], line.times(symbol_s)
    time_s = time_s[: len(time_s) // symbols * symbols]
    if taps > LATEST:
        raise ValueError(f"taps={taps}: sionna-rk takes delays below {LATEST} samples")
    if not len(time_s):
        raise ValueError(f"the trajectory is shorter than a slot of {symbols} symbols")
    folder.mkdir()
    with (folder / "cirs.bin").open("wb") as file:
        for start in range(0, len(time_s), SLOTS * symbols):
            gain = line.at(time_s[start : start + SLOTS * symbols])[:, 0]
            rows = np.zeros(len(gain), entry(taps))
            rows["norm"] = np.linalg.norm(gain, axis=1)
            unit = gain / np.maximum(rows["norm"], 1e-30)[:, None]
            rows["taps"], rows["index"] = np.stack([unit.real, unit.imag], -1), np.arange(taps)
            rows.tofile(file)
    about = {"num_taps": taps, "num_cirs": len(time_s), "sigma_scaling": 0.0, "sigma_max": 0.0}
    (folder / "config.json").write_text(json.dumps({"channel_emulation": about}, indent=1))
    return len(time_s)


def write_vrtsim(folder: Path, line: Line, step_s: float, moving_end: str, speed: float) -> float:
    """`cir_db.bin` and `vrtsim.yaml`; returns what taps were divided by, their root mean power per link.

    Both directions are entries about the same bytes: one of the two ends has one antenna.

    Args:
        folder, line: made; of at most 8 taps.
        step_s: between snapshots [s].
        moving_end: `rx` or `tx`, which has one antenna.
        speed: [m/s], that a reader may choose an entry by.
    """
    gain = line.at(line.times(step_s))
    scale = float(np.sqrt(np.mean(np.sum(np.abs(gain) ** 2, 2)))) or 1.0
    power = np.mean(np.abs(gain.astype(np.complex128)) ** 2, (0, 1))
    delay = np.arange(len(power)) / line.rate_hz
    mean = (power * delay).sum() / max(power.sum(), 1e-300)
    spread = np.sqrt((power * (delay - mean) ** 2).sum() / max(power.sum(), 1e-300))
    many, one = gain.shape[1], 1
    shapes = [(many, one), (one, many)] if moving_end == "rx" else [(one, many), (many, one)]
    entries = [
        {
            "model_id": 0, "n_tx": n_tx, "n_rx": n_rx, "L": gain.shape[2], "S": len(gain),
            "fs_hz": float(line.rate_hz), "snapshot_dt_s": float(step_s), "ds_ns": float(spread * 1e9),
            "speed_mps": float(speed), "offset_bytes": 0, "nbytes": gain.nbytes,
        }
        for n_tx, n_rx in dict.fromkeys(shapes)
    ]  # fmt: skip
    folder.mkdir()
    (gain / scale).astype("<c8").tofile(folder / "cir_db.bin")
    (folder / "vrtsim.yaml").write_text(yaml.safe_dump({"entries": entries}, sort_keys=False))
    return scale


def check(path: Path, symbols: int) -> Reading:
    """Read an emulator's files back, from their folder or one of them; `symbols` are a slot.

    Raises:
        DataError: no such files.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / "cirs.bin").exists():
        return _sionna_rk(folder, symbols)
    if (folder / "cir_db.bin").exists():
        return _vrtsim(folder)
    raise DataError(f"{path}: no cirs.bin (sionna-rk) and no cir_db.bin (vrtsim) here")


def _sionna_rk(folder: Path, symbols: int) -> Reading:
    text = read_text(folder / "config.json", "missing; sionna-rk reads it beside cirs.bin", "JSON")
    try:
        about = json.loads(text)["channel_emulation"]
        taps, count, *_ = (int(about[key] + 0) for key in KEYS)
        form = entry(taps)
    except (ValueError, KeyError, TypeError):
        expected = f"expected channel_emulation with numbers {', '.join(KEYS)}"
        raise DataError(f"{folder}/config.json: {expected}") from None
    raw = (folder / "cirs.bin").read_bytes()
    rows = np.frombuffer(raw, form, len(raw) // form.itemsize)[:count]
    off = np.abs(np.linalg.norm(rows["taps"].reshape(len(rows), 2 * taps), axis=1) - 1) > 1e-3
    faults = (
        (len(raw) != count * form.itemsize,
         f"cirs.bin has {len(raw)} bytes, not {count} entries of {form.itemsize}"),
        (count % symbols, f"no whole slots of {symbols}: the last {count % symbols} entries are not played"),
        ((rows["index"] >= LATEST).any(), f"delays of {LATEST} samples or more"),
        (not all(np.isfinite(rows[name]).all() for name in ("norm", "taps")), "a value that is no number"),
        ((off & (rows["norm"] > 0)).any(), "taps whose norm is not 1, which are played as they are"),
    )  # fmt: skip
    refused = tuple(message for fault, message in faults if fault)
    return Reading(f"{count} OFDM symbols of {taps} taps, {count // symbols} slots", refused)


def _vrtsim(folder: Path) -> Reading:
    text = read_yaml(folder / "vrtsim.yaml", "vrtsim reads it beside cir_db.bin", "a list called entries")
    raw, refused, summary = (folder / "cir_db.bin").read_bytes(), list[str](), list[str]()
    entries = text.get("entries")
    for number, one in enumerate(entries if isinstance(entries, list) else []):
        try:
            n_tx, n_rx, taps, count = (int(one[key] + 0) for key in WHOLE)
            start, dt, rate = one.get("offset_bytes", 0), one["snapshot_dt_s"], one["fs_hz"]
            stored = 8 * n_tx * n_rx * taps * count
            values = np.frombuffer(raw, "<f4", min(stored, max(len(raw) - start, 0)) // 4, start)
        except (ValueError, KeyError, TypeError, AttributeError):
            refused.append(f"entry {number}: expected numbers {', '.join(WHOLE)}, fs_hz, snapshot_dt_s")
            continue
        summary.append(f"{count} snapshots of {n_tx} x {n_rx} x {taps} taps")
        faults = (
            (
                values.nbytes < stored or stored <= 0,
                f"{stored} bytes from {start} of {len(raw)} in cir_db.bin",
            ),
            (one.get("nbytes", stored) != stored, f"nbytes is {one.get('nbytes')}, snapshots take {stored}"),
            (not np.isfinite(values).all(), "a tap that is no number"),
            (min(dt, rate) <= 0, "fs_hz and snapshot_dt_s must be above 0"),
            (taps > PUBLISHED, f"{taps} taps, the first {PUBLISHED} are played"),
            (max(n_tx, n_rx) > ANTENNAS, f"{n_tx} x {n_rx} antennas, at most {ANTENNAS} an end"),
        )
        refused += [f"entry {number}: {message}" for fault, message in faults if fault]
    if not summary and not refused:
        raise DataError(f"{folder}/vrtsim.yaml: expected a list called entries")
    return Reading("; ".join(summary), tuple(refused))
