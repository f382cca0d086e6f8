"""Files of `gsparc simulate` with spectra, channels and paths, read as spectra,
channels or powers.
"""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError
from gsparc.data.schema import Measurements
from gsparc.datasets.datamodule import DataModule
from gsparc.physics.decibels import to_decibels
from gsparc.tables.arrays import Raw, rename_arrays
from gsparc.tables.own import interpret_and_log
from gsparc.tables.raw import read_raw

TARGETS = ("spectrum", "csi", "rssi")
# Array that a target is read from
STORED = {"spectrum": "spectrum", "csi": "csi", "rssi": "received_power"}


def load_sionna(
    path: str | Path, target: str | None = None, truth: str | Path | None = None
) -> Measurements:
    """Load a simulated dataset as spectra, as channels or as powers, the sums of path powers.

    Args:
        path: file that the simulator wrote.
        target: one of `TARGETS`; None for the one the file was mainly made for.
        truth: another simulation of the same receivers, whose targets replace those of the test
            rows: the loss by training on a simulation with fewer effects.

    Raises:
        DataError: not such a file, no such target, other receivers, or anything that `load_own`
            refuses.
    """
    data = _load(path, target)
    if truth is None or Path(truth).resolve() == Path(path).resolve():
        return data
    return with_true_targets(data, _load(truth, target or data.site.kind), f"dataset.truth={truth}")


def with_true_targets(data: Measurements, truth: Measurements, named: str) -> Measurements:
    """Return `data` with the targets of `truth` in its test rows; training rows keep their own.

    Raises:
        DataError: `truth` is not of the same receivers, kind and split.
    """
    splits = (data.release_split, truth.release_split)
    same = data.target.shape == truth.target.shape and data.target.dtype == truth.target.dtype
    if not same or not np.allclose(data.rx_position, truth.rx_position, atol=1e-6):
        other = "not the receivers or targets of dataset.file"
        raise DataError(f"{named}: {other}; simulate both with one scene")
    if splits[0] is None or splits[1] is None or not np.array_equal(splits[0][1], splits[1][1]):
        raise DataError(f"{named}: both files must name the same test rows (scene.test_share)")
    test, target = splits[0][1], data.target.copy()
    ratio = truth.site.target_scale / data.site.target_scale
    target[test] = (
        truth.target[test] if ratio == 1 else truth.target[test] * target.dtype.type(ratio)
    )
    mask = _tested(data.mask, truth.mask, test, True)
    censored = _tested(data.censored, truth.censored, test, False)
    mixed = sha256(f"{data.site.sha256} {truth.site.sha256}".encode()).hexdigest()
    site = replace(data.site, sha256=mixed)
    return replace(data, site=site, target=target, mask=mask, censored=censored)


def _tested(
    train: np.ndarray | None, truth: np.ndarray | None, test: np.ndarray, plain: bool
) -> np.ndarray | None:
    """Flags (S, ...) of `train` with those of `truth` in test rows; None is `plain` everywhere."""
    template = truth if train is None else train
    if template is None:
        return None
    flags = np.full(template.shape, plain) if train is None else train.copy()
    flags[test] = plain if truth is None else truth[test]
    return flags


def _load(path: str | Path, target: str | None) -> Measurements:
    raw = read_raw(path)
    if "simulator" not in raw.attributes:
        raise DataError(f"{path}: not written by gsparc simulate; read it with dataset=own")
    target = str(target or raw.attributes.get("measurement"))
    present = [name for name in TARGETS if STORED[name] in raw.arrays]
    if target not in present:
        raise DataError(f"dataset.target={target}: {path} holds {' and '.join(present)}")
    return interpret_and_log(select_measurement(raw, target), path)


def select_measurement(raw: Raw, target: str) -> Raw:
    """Return the same file with one measurement, its array, noise and solver error."""
    other = [name for name in ("spectrum", "csi") if name != target]
    arrays = {
        k: v for k, v in raw.arrays.items() if k not in (*other, "array_position", "noise_variance")
    }
    names = {
        f"{target}_array_position": "array_position",
        f"{target}_noise_variance": "noise_variance",
    }
    attributes = {**raw.attributes, "measurement": target}
    if target == "rssi":
        arrays |= _in_decibels(np.asarray(arrays.pop("received_power"), dtype=np.float64))
        attributes["measurement"] = "rssi_db"
        attributes.pop("convergence_error", None)  # it is of channels
    if target == "spectrum" and "convergence_spectrum_nmse" in attributes:
        attributes["convergence_error"] = attributes["convergence_spectrum_nmse"]
    if target != "spectrum":
        attributes["normalisation"] = "none"
    return rename_arrays(Raw(arrays, attributes, raw.units), names)


def _in_decibels(power: np.ndarray) -> dict[str, np.ndarray]:
    """Powers (S,) in decibels; where no path arrives,
    they lie below the weakest that is no outlier.

    One path through five walls may be 70 dB below the next power: no receiver hears it, and a place
    without any path is not weaker for it. Outliers are those of J. W. Tukey,
    "Exploratory Data Analysis" (1977).
    """
    with np.errstate(divide="ignore"):
        decibels = to_decibels(power)
    arrived = decibels[np.isfinite(decibels)]
    if len(arrived) == len(decibels):
        return {"rssi_db": decibels}
    level = np.inf
    if len(arrived):
        lower, upper = np.quantile(arrived, (0.25, 0.75))
        level = arrived[arrived >= lower - 1.5 * (upper - lower)].min()
    return {
        "rssi_db": np.where(decibels < level, np.nan, decibels),
        "sensitivity_db": np.array(level),
    }


class Sionna(DataModule):
    """One transmitter, many receivers, read as spectra or as channels.

    Args:
        file: *.h5.
        name, batch_size: see `DataModule`.
        **settings: see `load_sionna`.
    """

    reader = staticmethod(load_sionna)

    def __init__(
        self, file: str | Path, name: str = "sionna", batch_size: int = 16, **settings: Any
    ) -> None:
        super().__init__(name, batch_size)
        self.file, self.settings = Path(file), settings

    def load(self) -> Measurements:
        """Load spectra (S, H, W), channels (S, A, K) or powers (S, 1)."""
        return load_sionna(self.file, **self.settings)
