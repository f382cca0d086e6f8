"""Whether a moving array can have measured what a dataset holds; asked before anything is fitted."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.physics.lags import Lags

MAX_UNEXPLAINED = 0.02  # share of energy outside the array's lags, above which it measured no such spectrum


def unexplained_energy(space: Lags, images: Tensor) -> tuple[int, float]:
    """Whether images (n, H, W) are amplitude (2) or power (1), and the share of energy outside the lags."""
    residual = {}
    for exponent in (2, 1):
        power = images**exponent
        again = space.spectrum(space.of(power))
        residual[exponent] = float((again - power).square().sum() / power.square().sum().clamp_min(1e-12))
    exponent = min(residual, key=lambda e: residual[e])
    return exponent, residual[exponent]


def site_problem(data: Measurements) -> str | None:
    """Why sources cannot be triangulated from these measurements; None when they can."""
    site = data.site
    if site.kind != "spectrum":
        return f"bearings need spectra, these are {site.kind}"
    if site.static_end != "tx":
        return "bearings need a moving receiver, here the transmitter moves (model=array is for that)"
    if site.array is None or site.grid is None or site.wavelength is None:
        return "the dataset does not say which array (array_position) and carrier its spectra are of"
    if not np.allclose(data.rx_rotation, data.rx_rotation[0], atol=1e-6):
        return "the receiver turns as it moves; bearings need one orientation"
    return None
