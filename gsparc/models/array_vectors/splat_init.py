"""A splatted field whose array vectors are the posterior of the vector process, in closed form.

Footprints are fixed, so the vectors are linear in the emissions: h = s G with G = A times the
frozen plan. Emissions are linear in features of the process (`gsparc.processes.features`), whose
weights give its posterior mean h(x) = phi(x) W: the emissions of least norm are phi(x) W G^+. The
same features tell the unknown share.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.field.confidence import fit_error_law
from gsparc.field.encoding import Smoothness
from gsparc.field.frozen import gaussian_vectors
from gsparc.field.initial import InitTask, Start
from gsparc.field.model import GaussianModel
from gsparc.field.response import ArrayResponse
from gsparc.models.array_vectors.cross_validation import choose_kernel
from gsparc.models.array_vectors.vector_cache import recover_cached, write_recovery_report
from gsparc.models.array_vectors.vector_gp import (
    align_by_likelihood,
    align_to_nearest,
    index_mirror_elements,
)
from gsparc.models.splat.left_out_images import LeftOut
from gsparc.models.target_rows import training_targets
from gsparc.ops import Pose
from gsparc.physics.array_response import steering_matrix
from gsparc.processes.features import whitened_features
from gsparc.processes.few_rows import covering_rows
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

# Spectra whose vectors are aligned as one, in their number cubed: more follow their nearest
MOST_ROWS = 5000
RIDGE = 1e-3  # of the largest singular value of G: bounds the norm of emissions


@dataclass(frozen=True)
class VectorProcess:
    """What training spectra say about a field through their array.

    Attributes:
        prior: features of the emission.
        weights: (E, M) complex128, features to array vectors.
        background: (H, W) float32, the mean spectrum.
        error: level and power of the field's `ErrorModel`.
        left_out: training spectra predicted without their neighbours; None for too few.
    """

    prior: Smoothness
    weights: Tensor
    background: Tensor
    error: tuple[float, float]
    left_out: LeftOut | None


def start_from_vectors(task: InitTask) -> Start:
    """Return Gaussians whose emissions through the array are the posterior of its vectors.

    Raises:
        ValueError: no array, no rows, or an emission that is not linear in its features.
    """
    assert task.receiver is not None
    if task.settings.emission.hidden or task.settings.attenuation.inverse_distance:
        raise ValueError(
            "init=vectors solves a linear read-out: leave init=auto, or set "
            "model.emission.hidden=0 and "
            "model.attenuation.inverse_distance=false"
        )
    process = learn_vector_process(
        task.data, task.rows, task.most_anchors, task.seed, task.run_dir, task.watch
    )
    return Start(
        process.prior,
        partial(set_emissions, process=process, receiver=task.receiver),
        process.left_out,
    )


def learn_vector_process(
    data: Measurements,
    rows: np.ndarray,
    anchors: int,
    seed: int,
    run_dir: Path,
    watch: Stopwatch | None = None,
) -> VectorProcess:
    """Retrieve the vectors of the given rows (cached where known) and fit their process.

    Args:
        data: spectra of a static array.
        rows: (n,) to learn from.
        anchors: largest number of places that stand for them.
        seed: of every random choice.
        run_dir: for the report of phase retrieval.
        watch: see `recover_cached`.

    Raises:
        ValueError: the site declares no usable array, or there are no rows.
    """
    site = data.site
    if site.array_problem is not None:
        raise ValueError(f"model.response.array=true is not possible: {site.array_problem}")
    if not len(rows):
        raise ValueError("the training set is empty")
    array, grid, wavelength = site.array_geometry()
    recovery = recover_cached(data, rows, seed, watch)
    if run_dir != Path():  # of a run: a fit in Python leaves nothing behind
        write_recovery_report(recovery, data, rows, run_dir / "array_recovery.csv")
    matrix = steering_matrix(array, grid, wavelength).numpy()
    partner, places = index_mirror_elements(array), data.tx[rows]
    core = covering_rows(places, MOST_ROWS, seed)
    images = data.site.target.to_real(training_targets(data, rows[core]))
    tuned = choose_kernel(
        recovery.vectors[core], places[core], images, matrix, wavelength, partner, seed
    )
    kernel = tuned.kernel
    vectors = np.empty(recovery.vectors.shape, np.complex128)
    vectors[core] = align_by_likelihood(recovery.vectors[core], places[core], partner, kernel)
    rest = np.setdiff1d(np.arange(len(rows)), core)
    if len(rest):
        log.info(
            "array: %d of %d spectra, which cover the site, align the others", len(core), len(rows)
        )
        others = recovery.vectors[rest], places[rest]
        vectors[rest] = align_to_nearest(*others, vectors[core], places[core], partner)
    # As queries come: they are told by differences
    stored = torch.from_numpy(places).float().double()
    features = whitened_features(stored, kernel.length, kernel.noise, "smooth_rough", anchors)
    log.info(
        "array: length %.3g m, noise %.2g of the field's variance, %d features of %d spectra",
        kernel.length,
        kernel.noise,
        len(features.places),
        len(rows),
    )
    return VectorProcess(
        Smoothness(
            features.places.float(),
            kernel.length,
            kernel.noise,
            "smooth_rough",
            features.whitening.float(),
        ),
        features.weigh.to(torch.complex128) @ torch.from_numpy(vectors),
        torch.from_numpy(images.mean(0)).view(grid.height, grid.width),
        fit_error_law(tuned.unknown, tuned.error),
        tuned.left_out,
    )


@torch.no_grad()
def set_emissions(model: GaussianModel, process: VectorProcess, receiver: Pose) -> None:
    """Set what a fresh model emits, its mean spectrum and its errors to what was learned."""
    response = model.response
    assert isinstance(response, ArrayResponse)
    view = gaussian_vectors(model, receiver)  # (N, M)
    left_vectors, size, right_vectors = torch.linalg.svd(
        view.to(torch.complex128), full_matrices=False
    )
    # Tikhonov's inverse: what the array hardly sees gets no large emissions.
    damped = size / (size.square() + (RIDGE * size[:1]).square()).clamp_min(
        torch.finfo(size.dtype).tiny
    )
    readout = process.weights @ ((right_vectors.mH * damped) @ left_vectors.mH)  # (E, N)
    model.emission.weight2.copy_(torch.view_as_real(readout.T.contiguous()))
    model.emission.bias2.zero_()
    response.background = process.background
    if model.error is not None:
        model.error.set_error_law(*process.error)
