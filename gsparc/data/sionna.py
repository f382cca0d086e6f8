"""What `python -m gsparc.simulate` writes: one file with spectra, channels and paths, read as either."""

from __future__ import annotations

import logging
from pathlib import Path

from gsparc.data.errors import DataError
from gsparc.data.own import interpret
from gsparc.data.raw import Raw, read_raw, renamed
from gsparc.data.schema import Measurements

log = logging.getLogger(__name__)

TARGETS = ("spectrum", "csi")


def load_sionna(path: str | Path, target: str | None = None) -> Measurements:
    """A simulated dataset as spectra or as channels.

    Args:
        path: file that the simulator wrote.
        target: `spectrum` or `csi`; None for the one the file was mainly made for.

    Raises:
        DataError: not such a file, no such target, or anything that `load_own` refuses.
    """
    raw = read_raw(path)
    if "simulator" not in raw.attributes:
        raise DataError(f"{path}: not written by python -m gsparc.simulate; read it with dataset=own")
    target = str(target or raw.attributes.get("measurement"))
    if target not in TARGETS or target not in raw.arrays:
        raise DataError(
            f"dataset.target={target}: {path} holds {' and '.join(t for t in TARGETS if t in raw.arrays)}"
        )
    reading = interpret(read_as(raw, target), path)
    for note in reading.notes:
        log.warning("%s: %s", path, note)
    return reading.data


def read_as(raw: Raw, target: str) -> Raw:
    """The same file with one measurement, the array it was seen through, its noise and its solver's error."""
    other = [name for name in TARGETS if name != target]
    arrays = {k: v for k, v in raw.arrays.items() if k not in (*other, "array_position", "noise_variance")}
    names = {f"{target}_array_position": "array_position", f"{target}_noise_variance": "noise_variance"}
    attributes = {**raw.attributes, "measurement": target}
    if target == "spectrum" and "convergence_spectrum_nmse" in attributes:
        attributes["convergence_error"] = attributes["convergence_spectrum_nmse"]
    if target == "csi":
        attributes["normalisation"] = "none"
    return renamed(Raw(arrays, attributes, raw.units), names)
