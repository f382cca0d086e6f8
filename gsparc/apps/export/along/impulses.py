"""Impulse responses along a trajectory as a file of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.apps.export.along.taps import Trajectory, fitted
from gsparc.data.raw import Raw, write_raw
from gsparc.prediction.predictor import Predictor


def write_impulses(
    predictor: Predictor, way: Trajectory, settings: Mapping[str, Any], file: Path
) -> dict[str, Any]:
    """Write taps, delays and Doppler to `file`, an npz.

    Args:
        predictor: of channels with one end that stands still.
        way: of the other end.
        settings: see conf/export.yaml.
        file: path of the npz.

    Returns:
        Facts: `taps/*`; decibels of what taps leave of the channels.
    """
    site = predictor.site
    line = fitted(predictor, way, settings["taps"], settings["rate_hz"], settings["antennas"])
    units = {"time_s": "s", f"{site.moving_end}_position": "m", "delay_s": "s", "doppler_hz": "Hz"}
    delay_s = (line.first + np.arange(line.gain.shape[2])) / line.rate_hz
    known = (line.time_s, way.at(line.time_s), delay_s, line.doppler_hz())
    arrays = dict(zip(units, known, strict=True)) | {"gain": line.gain}
    if line.paths is not None:
        arrays |= {"path_gain": line.paths.gain, "path_delay_s": line.paths.delay_s}
        arrays["path_doppler_hz"] = line.path_doppler_hz()
    about = {"rate_hz": line.rate_hz, "carrier_hz": line.carrier_hz, "residual": line.residual}
    write_raw(file, Raw(arrays, about, units))
    return {
        "taps/count": line.gain.shape[2],
        "taps/rate_hz": line.rate_hz,
        "taps/residual_db": _db(line.residual),
        "taps/worst_db": _db(line.worst),
        "taps/early_s": delay_s[0],
    }


def _db(ratio: float) -> float:
    return float(10 * np.log10(max(ratio, 1e-30)))
