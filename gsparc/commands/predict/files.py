"""Predictions as a CSV or npz file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.commands.predict.answers import Answers
from gsparc.data.errors import DataError
from gsparc.data.files import whole_file
from gsparc.data.query_places import QueryPlaces
from gsparc.data.schema import Kind
from gsparc.evaluation.intervals import in_decibels
from gsparc.evaluation.summary import write_samples

MOST_ENTRIES = 16  # of a channel, as columns of a table
ENDINGS = (".csv", ".npz")


def target(out: str | None, places: Path, overwrite: bool) -> Path:
    """Where predictions go: `out`, or beside the places.

    Raises:
        DataError: another ending, the places themselves, or a file that is there already.
    """
    path = places.with_name(f"{places.stem}.predicted.csv") if out is None else Path(out)
    if path.suffix.lower() not in ENDINGS:
        raise DataError(f"out={path}: expected a name ending in {' or '.join(ENDINGS)}")
    if path.exists() and path.samefile(places):
        raise DataError(f"out={path}: these are the places themselves; give another out=FILE")
    if path.exists() and not overwrite:
        raise DataError(f"out={path}: is there already; say overwrite=true, or another out=FILE")
    return path


def check_fits(path: Path, kind: Kind, shape: tuple[int, ...]) -> None:
    """Refuse what is no table: spectra, and channels of many entries."""
    if path.suffix.lower() == ".npz":
        return
    count = int(np.prod(shape))
    if kind == "spectrum":
        size = " x ".join(map(str, shape))
        raise DataError(f"out={path}: spectra of {size} directions are no columns; say out=FILE.npz")
    if kind == "csi" and count > MOST_ENTRIES:
        size = f"{shape[0]} antennas x {shape[1]} subcarriers"
        raise DataError(f"out={path}: {size} are more than {MOST_ENTRIES} pairs of columns; say out=FILE.npz")


def write(path: Path, queries: QueryPlaces, found: Answers, kind: Kind) -> None:
    """Write all predictions, whole or not at all."""
    columns = {**_places(queries, found), **_levels(found, kind)}
    if path.suffix.lower() == ".npz":
        arrays = columns if kind == "rssi" else {**columns, kind: found.mean}
        with whole_file(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        return
    if kind == "csi":
        columns |= _parts(found.mean)
    confidence = columns.pop("confidence", None)
    columns |= {} if confidence is None else {"confidence": confidence}
    write_samples(path, {name: _cells(values) for name, values in columns.items()})


def decibels(found: Answers) -> tuple[np.ndarray, np.ndarray | None]:
    """Level and standard deviation (N,) [dB] of powers, NaN where the power is 0; None without a variance."""
    power = found.mean[:, 0].astype(np.float64)
    good = power > 0
    level, spread = (np.full(len(power), np.nan) for _ in range(2))
    variance = np.zeros(len(power)) if found.variance is None else found.variance
    level[good], spread[good] = in_decibels(power[good], variance[good])
    return level, None if found.variance is None else spread


def _places(queries: QueryPlaces, found: Answers) -> dict[str, np.ndarray]:
    """Coordinates as they were given, and the station."""
    columns = {} if queries.name is None else {"row_name": queries.name[found.place]}
    for end, where in queries.ends.items():
        before = "" if len(queries.ends) == 1 else f"{end}_"
        axes = ("latitude", "longitude", "height") if where.degrees else ("x", "y", "z")
        for axis, values in zip(axes, where.all().T, strict=True):
            columns[before + axis] = values[found.place]
    return columns if found.station is None else {**columns, "station": found.station}


def _levels(found: Answers, kind: Kind) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    if kind == "rssi":
        level, spread = decibels(found)
        columns = {"rssi_db": level} | ({} if spread is None else {"rssi_db_std": spread})
    elif found.variance is not None:
        columns = {f"{kind}_std": np.sqrt(found.variance)}
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    return columns if found.confidence is None else {**columns, "confidence": found.confidence}


def _parts(channels: np.ndarray) -> dict[str, np.ndarray]:
    """Real and imaginary parts; numbers of antenna and subcarrier where there are several."""
    _, antennas, tones = channels.shape
    columns = {}
    for a in range(antennas):
        for k in range(tones):
            number = (f"_{a}" if antennas > 1 else "") + (f"_{k}" if tones > 1 else "")
            columns[f"csi_re{number}"] = channels[:, a, k].real
            columns[f"csi_im{number}"] = channels[:, a, k].imag
    return columns


def _cells(values: np.ndarray) -> list[object]:
    """Text of numbers with as many digits as tell them from their neighbours; NaN stays a number."""
    if values.dtype.kind != "f":
        return values.tolist()
    return [value if np.isnan(value) else str(value) for value in values]
