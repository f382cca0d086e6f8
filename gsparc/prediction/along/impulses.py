"""Impulse responses along a trajectory as files: the arrays, and what emulators read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.raw import Raw, write_raw
from gsparc.prediction.along import emulators
from gsparc.prediction.along.taps import Trajectory, fitted
from gsparc.prediction.predictor import Predictor

SLOT_S = 1e-3  # of 15 kHz between subcarriers


def write_impulses(
    predictor: Predictor, way: Trajectory, settings: Mapping[str, Any], folder: Path, emulated: bool
) -> dict[str, Any]:
    """Write `cir.npz` or `cir.h5`, and where they are `emulated` the files of sionna-rk and vrtsim.

    Args:
        predictor: of channels with one end that stands still.
        way: of the other end.
        settings: see conf/export.yaml.
        folder: where files go.
        emulated: whether emulators read them.

    Returns:
        Facts: `cir/*`; decibels of what taps leave of the channels.
    """
    site, taps, antennas = predictor.site, settings["taps"], settings["antennas"]
    line = fitted(predictor, way, taps, settings["rate_hz"], antennas)
    units = {"time_s": "s", f"{site.moving_end}_position": "m", "delay_s": "s", "doppler_hz": "Hz"}
    delay_s = (line.first + np.arange(line.gain.shape[2])) / line.rate_hz
    known = (line.time_s, way.at(line.time_s), delay_s, line.doppler_hz())
    arrays = dict(zip(units, known, strict=True)) | {"gain": line.gain}
    if line.paths is not None:
        arrays |= {"path_gain": line.paths.gain, "path_delay_s": line.paths.delay_s}
        arrays["path_doppler_hz"] = line.path_doppler_hz()
    about = {"rate_hz": line.rate_hz, "carrier_hz": line.carrier_hz, "residual": line.residual}
    write_raw(folder / f"cir.{settings['file']}", Raw(arrays, about, units))
    facts = {
        "cir/taps": line.gain.shape[2], "cir/rate_hz": line.rate_hz, "cir/residual_db": _db(line.residual),
        "cir/worst_db": _db(line.worst), "cir/early_s": delay_s[0],
    }  # fmt: skip
    if emulated:
        short = fitted(predictor, way, min(taps, emulators.PUBLISHED), line.rate_hz, antennas)
        symbols, step_s = settings["symbols"], float(settings["snapshot_s"])
        symbol_s = SLOT_S * 15 / settings["spacing_khz"] / symbols
        facts["cir/symbols"] = emulators.write_sionna_rk(folder / "sionna-rk", line, symbol_s, symbols)
        scale = emulators.write_vrtsim(folder / "vrtsim", short, step_s, site.moving_end, way.fastest)
        facts |= {"cir/vrtsim_scale": scale, "cir/vrtsim_db": _db(short.residual)}
    return facts


def _db(ratio: float) -> float:
    return float(10 * np.log10(max(ratio, 1e-30)))
