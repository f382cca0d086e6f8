"""Whether spectra can be of the declared array on the declared grid.

A Bartlett spectrum is a sum of few waves over directions, the lags of its array: what is outside
them tells an array in another plane, or rows that are zenith angles, without any path being known.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from gsparc.data.schema import LIGHT, Measurements
from gsparc.physics.lags import SpectrumLags, pixel_exponent
from gsparc.tables.conventions import CONVENTIONS, convert_conventions

ROWS = 16  # looked at
UNEXPLAINED = 0.01  # share of the energy outside the lags, that measured spectra need not reach
RIVAL = 0.2  # of that of what is declared: a rival that leaves less is named
# Axes of the declared array, in each plane
PLANES = {"xy": (0, 1, 2), "yz": (2, 0, 1), "xz": (0, 2, 1)}


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
