"""Initialise a splatted field with an array response from the array's complex vectors, in closed form.

Footprints are fixed, so the vectors are linear in the emissions: h = s G with G = A times the frozen plan.
The minimum-norm emission of each vector is regressed on kernel features of the position.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from gsparc.array.cross_validation import tune
from gsparc.array.vector_cache import recovered, report
from gsparc.array.vector_gp import fit_vector_gp, mirror_elements
from gsparc.data.files import platform_cache
from gsparc.data.schema import Measurements
from gsparc.field.encoding import Prior
from gsparc.field.frozen import seen_by_array
from gsparc.field.initial import InitTask, Start
from gsparc.field.model import GaussianModel
from gsparc.methods.target_rows import to_real, training_targets
from gsparc.methods.time_budget import Spent, TimeBudget
from gsparc.ops import Pose
from gsparc.physics.array_response import steering

RIDGE = 1e-3  # of the largest singular value of G: bounds the norm of emissions
MIN_NOISE = 1e-3  # of the kernel's variance, for the ridge regression


@dataclass(frozen=True)
class Vectors:
    """Array vectors of training spectra, phases and twins aligned, and the kernel of their variation.

    Attributes:
        rows: (n,) of the dataset.
        vectors: (n, M) complex128.
        prior: features of the emission.
        elapsed, training: time of phase retrieval in this run, and when it was computed.
        time_limited: whether seconds ended it.
    """

    rows: np.ndarray
    vectors: np.ndarray
    prior: Prior
    elapsed: Spent
    training: Spent
    time_limited: bool


class ThroughArray:
    """Gaussians whose emissions through the array give the retrieved vectors; see `Initialiser`."""

    def __call__(self, task: InitTask) -> Start:
        """Retrieve the vectors of the training rows."""
        assert task.receiver is not None
        found = aligned_vectors(task.data, task.rows, task.anchors, task.seed, task.run_dir)
        solve = partial(start, data=task.data, found=found, receiver=task.receiver)
        return Start(
            found.prior, None, solve, astuple(found.training), astuple(found.elapsed), found.time_limited
        )  # fmt: skip


def aligned_vectors(data: Measurements, rows: np.ndarray, anchors: int, seed: int, run_dir: Path) -> Vectors:
    """Retrieve the vectors of the given rows (cached where known) and align phases and twins."""
    site = data.site
    assert site.array is not None and site.grid is not None and site.wavelength is not None
    watch = TimeBudget()
    found, training = recovered(data, rows, platform_cache(), seed)
    elapsed = watch.counted
    report(found, data, rows, run_dir / "array_recovery.csv")
    matrix = steering(site.array, site.grid, site.wavelength).numpy()
    images = to_real(training_targets(data, rows), "spectrum")
    partner, places = mirror_elements(site.array), data.tx[rows]
    kernel = tune(found.vectors, places, images, matrix, site.wavelength, partner, seed).kernel
    process = fit_vector_gp(found.vectors, places, partner, kernel)
    if len(rows) > anchors:
        places = places[np.sort(np.random.default_rng(seed).choice(len(rows), anchors, replace=False))]
    prior = Prior(torch.from_numpy(places.astype(np.float32)), kernel.length, max(kernel.noise, MIN_NOISE))
    return Vectors(rows, process.vectors, prior, elapsed, training, bool(found.time_limited.any()))


@torch.no_grad()
def start(model: GaussianModel, data: Measurements, found: Vectors, receiver: Pose) -> None:
    """Set the emission's read-out so that the model's array vectors are those of the training spectra.

    Raises:
        ValueError: the emission has hidden units, or depends on the transmitter's distance.
    """
    if model.settings.emission.hidden or model.settings.attenuation.inverse_distance:
        raise ValueError(
            "model.warm_start=true solves a linear read-out: set model.emission.hidden=0 and "
            "model.attenuation.inverse_distance=false"
        )
    view = seen_by_array(model, receiver)  # (N, M)
    left, size, right = torch.linalg.svd(view.to(torch.complex128), full_matrices=False)
    damped = size / (size.square() + (RIDGE * size[0]).square())
    shortest = (right.mH * damped) @ left.mH  # (M, N)
    places = torch.from_numpy(data.tx[found.rows].astype(np.float32))
    features = model.emission.encoding(places).to(torch.complex128)
    gram = features.mT @ features
    gram.diagonal().add_(found.prior.noise)
    vectors = torch.from_numpy(found.vectors)
    readout = torch.linalg.solve(gram, features.mT @ vectors) @ shortest  # (width, N)
    if data.site.normalisation != "none":  # spectra do not depend on the scale: unit emission power
        readout = readout / (features @ readout).abs().square().mean().sqrt()
    model.emission.weight2.copy_(torch.view_as_real(readout.T.contiguous()))
    model.emission.bias2.zero_()
