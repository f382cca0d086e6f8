"""Processes of arrays at fixed settings: vectors, bearings, spectra, snapshots."""

from __future__ import annotations

from unittest import mock

import numpy as np
import torch
from small_worlds import smooth, spread

from gsparc.models.array_vectors import vector_gp
from gsparc.models.moving_array import power_gp, residual
from gsparc.models.uplink.search import SearchSettings, SourceSearch
from gsparc.physics.plane_waves import Aperture, delays, steering
from gsparc.processes.kernel import Kernel, SmoothRough

PLACES, QUERIES = spread(40, 0, (2.0, 2.0, 0.2)), spread(9, 1, (2.0, 2.0, 0.2))
Arrays = dict[str, np.ndarray]


def _vectors() -> tuple[np.ndarray, np.ndarray]:
    smooth_ones = smooth(PLACES, 32, 2)
    true = smooth_ones[:, :16] + 1j * smooth_ones[:, 16:]
    rng = np.random.default_rng(3)
    turned = true * np.exp(1j * rng.uniform(0, 6, (40, 1)))
    partner = np.arange(16)[::-1].copy()
    swapped = rng.uniform(0, 1, 40) < 0.4
    turned[swapped] = vector_gp.twin(turned[swapped], partner)
    return turned, partner


def array_vectors() -> Arrays:
    """Phases and twins of vectors under a process."""
    turned, partner = _vectors()
    kernel = SmoothRough.of_one(0.8, 0.02)
    aligned = vector_gp.aligned_by(turned, PLACES, partner, kernel)
    more = vector_gp.aligned_to(turned[30:], PLACES[30:], aligned[:30], PLACES[:30], partner, kernel)
    return {"aligned": aligned, "more": more, "gram": kernel.gram(torch.from_numpy(PLACES)).numpy()}


def powers_of_bearings() -> Arrays:
    """Powers of triangulated sources over place, and images that they leave."""
    kernel = Kernel.of_one(0.7, 0.3)
    power, images = smooth(PLACES, 5, 4), torch.from_numpy(smooth(PLACES, 60, 5)).float()
    trend, left = power_gp.fit_trend(torch.zeros(5, 3), kernel, PLACES, power)
    far = torch.from_numpy(np.linalg.norm(QUERIES[:, None] - PLACES, axis=-1)).float()
    rest, rest_left = residual.fit_residual(kernel, PLACES, images, 30)
    with mock.patch.object(residual, "choose_kernel", lambda *unused: kernel):
        error, _ = residual.left_out_error(PLACES, images)
    return {
        "power": trend.powers(far).numpy(), "left_out": left, "images": rest.coefficients(far).numpy(),
        "images_left_out": rest_left.numpy(), "error": np.array(error, np.float32),
    }  # fmt: skip


def snapshots() -> Arrays:
    """Plane waves of snapshots of an array, with their posterior."""
    places = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0)) / 2
    aperture = Aperture(places, torch.arange(8.0))
    rng = np.random.default_rng(8)
    cosine = torch.from_numpy(rng.uniform(-0.7, 0.7, (3, 4, 2))).float()
    delay = torch.from_numpy(rng.uniform(0, 0.2, (3, 4))).float()
    gain = torch.from_numpy(rng.standard_normal((3, 4, 2)) @ [1, 1j]).to(torch.complex64)
    clean = (steering(cosine, aperture) * gain[..., None]).transpose(1, 2) @ delays(delay, aperture)
    noise = torch.from_numpy(rng.standard_normal((*clean.shape, 2)) @ [1, 1j]).to(torch.complex64)
    search = SourceSearch(aperture, SearchSettings(rounds=3, picks=2))
    found, rest = search(clean + 0.05 * noise, torch.full((3,), 0.005))
    return {
        "response": found.response(aperture).numpy(), "rest": rest.numpy(),
        "variance": found.error_variance(aperture).numpy(),
    }  # fmt: skip
