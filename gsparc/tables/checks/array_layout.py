"""Whether spectra can be of the declared array on the declared grid, and carriers of their places.

A Bartlett spectrum is a sum of few waves over directions, the lags of its array: what is outside
them tells an array in another plane, or rows that are zenith angles, without any path being known.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch

from gsparc.data.schema import LIGHT, Measurements
from gsparc.physics.lags import SpectrumLags, pixel_exponent
from gsparc.processes.uncertainty import is_surely_above
from gsparc.tables.conventions import CONVENTIONS, convert_conventions

ROWS = 16  # looked at
UNEXPLAINED = 0.01  # share of the energy outside the lags, that measured spectra need not reach
RIVAL = 0.2  # of that of what is declared: a rival that leaves less is named
# Axes of the declared array, in each plane
PLANES = {"xy": (0, 1, 2), "yz": (2, 0, 1), "xz": (0, 2, 1)}
PIXELS = 400  # of an image, compared over carriers
CLEAR, LEAST_GAIN = 4.0, 0.1  # standard errors, and at least of a correlation or pixel
NEAR = 0.9  # cosine of an angle to the nearest pixel: of places a little below the horizon, too


def layout_warnings(data: Measurements) -> list[str]:
    """Name the grid or plane that spectra seem to be of instead of the declared ones."""
    site = data.site
    first = np.flatnonzero(data.stations_of() == 0)
    if not site.target.is_image or site.grid is None or site.array is None or not len(first):
        return []
    carrier = site.carrier_hz if data.carrier_hz is None else float(data.carrier_hz[first[0]])
    if carrier is None or np.linalg.matrix_rank(site.array - site.array[0]) < 2:
        return []
    few = data.subset(first[:: max(1, len(first) // ROWS)], replace(site, carrier_hz=carrier))
    declared = _unexplained(few, site.array)
    if declared < UNEXPLAINED:
        return []
    rivals = {words: residual for words, residual in _rivals(few) if residual < RIVAL * declared}
    best = min(rivals, key=lambda words: rivals[words], default=None)
    if best is None:
        return []
    residual = (
        f"{declared:.1%} of these spectra cannot be of the declared array, {rivals[best]:.2%}"
    )
    return [f"{residual} with {best}: is it that?"]


def _rivals(data: Measurements) -> Iterator[tuple[str, float]]:
    """What may be instead, in words, and the share that it leaves."""
    array = np.asarray(data.site.array)
    flat = int(np.ptp(array, axis=0).argmin())
    upright = array[:, [(flat + 1) % 3, (flat + 2) % 3, flat]]  # as of the plane xy
    zenith = CONVENTIONS["zenith"].words + " (dataset.zenith=true)"
    for rows, names in (("", ()), (zenith, ("zenith",))):
        with suppress(ValueError):  # a grid beyond a pole
            placed = convert_conventions(data, names)
            for plane, axes in PLANES.items():
                turned = upright[:, list(axes)]
                same = int(np.ptp(turned, axis=0).argmin()) == flat
                words = [rows, "" if same else f"its antennas in the plane {plane}"]
                if any(words):
                    yield " and ".join(filter(None, words)), _unexplained(placed, turned)


def _unexplained(data: Measurements, array: np.ndarray) -> float:
    """Share of the images' energy outside the lags of an array (M, 3) [m]."""
    grid, carrier = data.site.grid, data.site.carrier_hz
    assert grid is not None and carrier is not None
    images = data.targets(np.arange(len(data))).reshape(-1, grid.height, grid.width)
    return pixel_exponent(SpectrumLags(array, grid, LIGHT / carrier), images)[1]


def carrier_warnings(data: Measurements) -> list[str]:
    """Name what several carriers at the same places tell: shifted rows, a mirrored azimuth."""
    if not data.site.target.is_image or data.carrier_hz is None or data.place is None:
        return []
    stations, places = data.site.every_station, int(data.place.max()) + 1
    step = max(1, data.target[0].size // PIXELS)
    seen = data.site.target.to_real(data.target.reshape(len(data), -1)[:, ::step])
    table = np.full((len(stations), places, seen.shape[1]), np.nan)
    table[data.stations_of(), data.place] = seen - seen.mean(0)
    shifted = []
    for station, name in enumerate(stations.shown):
        others = np.nansum(np.delete(table, station, axis=0), axis=0)
        fit = {
            by: _likeness(table[station], np.roll(others, by, axis=0))[1:-1] for by in (-1, 0, 1)
        }
        ways = [where for by, where in ((1, "before"), (-1, "after")) if _clear(fit[by] - fit[0])]
        shifted += [f"{name} ({where})" for where in ways]
    faults = []
    if shifted:
        symptom = (
            "spectra are more like those of other carriers at the place before or after theirs"
        )
        faults.append(f"{symptom} at {', '.join(shifted)}: are their rows shifted by one?")
    mirrored = convert_conventions(data, ["clockwise"])
    gain = _along_direct_path(mirrored) - _along_direct_path(data)
    if _clear(np.bincount(data.place, gain) / np.bincount(data.place)):
        symptom = "direct paths are where azimuths that run the other way would have them"
        faults.append(f"{symptom}: is an axis mirrored? dataset.clockwise=true mends azimuths")
    return faults


def _clear(gain: np.ndarray) -> bool:
    """Whether a gain (n,), NaN where unknown, is above 0 by more than chance."""
    gain = gain[np.isfinite(gain)]
    return len(gain) > 2 and is_surely_above(gain, CLEAR, LEAST_GAIN)


def _along_direct_path(data: Measurements) -> np.ndarray:
    """Values (S,) of the pixels nearest to the direction of the other end; 0 where no pixel is."""
    grid = data.site.grid
    assert grid is not None
    away = np.einsum("sji,sj->si", data.rx_rotation, data.tx - data.rx_position)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    cosine = away @ grid.directions().numpy().reshape(-1, 3).T
    pixel = cosine.argmax(1)
    values = data.site.target.to_real(
        data.target.reshape(len(data), -1)[np.arange(len(data)), pixel]
    )
    return np.where(cosine.max(1) > NEAR, values[:, 0], 0.0)


def _likeness(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Correlations (n,) of rows (n, D)."""
    size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.asarray((first * second).sum(1) / np.maximum(size, torch.finfo(torch.float32).tiny))
