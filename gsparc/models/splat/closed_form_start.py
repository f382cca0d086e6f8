"""A first field in closed form: project the training images on the footprints,
regress over position.

Footprints are fixed, so an image is linear in the emissions, and an emission that is linear in the
whitened kernel features is a Gaussian process of position: both fits are ridge least squares.
Gradient training starts from there; from random weights it needs minutes to get as far and
generalises worse (Adam's solution is not the one of least norm).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.field.confidence import fit_error_law
from gsparc.field.encoding import Smoothness
from gsparc.field.initial import InitTask, Start
from gsparc.field.model import GaussianModel
from gsparc.models.array_vectors.splat_init import start_from_vectors
from gsparc.models.baselines.gp import kernel_of_targets
from gsparc.models.splat.left_out_images import LeftOut, means_and_variances
from gsparc.models.stack import LEAST_HELD
from gsparc.models.target_rows import training_targets
from gsparc.ops import Pose
from gsparc.ops.transforms import full_precision
from gsparc.processes.factor import Factor
from gsparc.processes.features import Features, whitened_features
from gsparc.processes.few_rows import sample_row_numbers
from gsparc.processes.kernel import Kernel
from gsparc.processes.left_out import left_out_residuals

# Relative to the mean footprint energy; footprints overlap, so the projection is singular
IMAGE_RIDGE = 1e-4
CHUNK = 256  # images held as floats at a time
KERNEL_ROWS = 1024  # leave-one-out factors a matrix of this size at every look
COMPONENTS = 128
GAPS = (0.0, 2.0, 5.0, 10.0)  # between a row and what is left, in spacings of rows
PIXELS, CENTRES = 600, 160  # of the images, and rows, that are predicted so
LEAST_NOISE = 1e-6  # of the kernel's variance


def learn_prior(data: Measurements, rows: np.ndarray, anchors: int, seed: int) -> Smoothness:
    """Return smoothness and up to `anchors` positions (drawn by seed) from training rows (n,)."""
    chosen, kernel = _fit_kernel(data, rows, anchors, seed)
    return Smoothness(
        torch.from_numpy(data.moving[chosen].astype(np.float32)), kernel.length, kernel.noise
    )


@dataclass(frozen=True)
class Process:
    """A process of position, conditioned on training rows.

    Attributes:
        prior: of the emission's encoding.
        features: with what maps values at the rows to weights.
    """

    prior: Smoothness
    features: Features


def learn_process(data: Measurements, rows: np.ndarray, anchors: int, seed: int) -> Process:
    """Learn a process of training rows (n,), at up to `anchors` places."""
    _, kernel = _fit_kernel(data, rows, anchors, seed)
    noise = max(kernel.noise, LEAST_NOISE)
    places = torch.from_numpy(data.moving[rows]).float().double()  # as queries come
    features = whitened_features(places, kernel.length, noise, "matern32", anchors)
    prior = Smoothness(
        features.places.float(), kernel.length, noise, "matern32", features.whitening.float()
    )
    return Process(prior, features)


def _fit_kernel(
    data: Measurements, rows: np.ndarray, limit: int, seed: int
) -> tuple[np.ndarray, Kernel]:
    """At most so many of rows (n,), drawn by seed,
    and the kernel of largest likelihood for them.
    """
    draw = np.random.default_rng(seed)
    chosen = rows if len(rows) <= limit else np.sort(draw.choice(rows, limit, replace=False))
    looked_at = chosen[:: -(-len(chosen) // KERNEL_ROWS)]
    return chosen, kernel_of_targets(data, looked_at, COMPONENTS)


@dataclass(frozen=True)
class ImageEmissions:
    """Training images as emissions of fixed footprints.

    Attributes:
        weights: (P, N), pixels by Gaussians.
        images: (n, P), the targets.
        outputs: (n, N) float64, of the emission's read-out.
        attenuation: (n, N), or None.
    """

    weights: Tensor
    images: Tensor
    outputs: Tensor
    attenuation: Tensor | None

    def subset(self, rows: np.ndarray) -> ImageEmissions:
        """Return the emissions of some rows (m,) alone."""
        attenuation = None if self.attenuation is None else self.attenuation[rows]
        return ImageEmissions(self.weights, self.images[rows], self.outputs[rows], attenuation)

    def render(self, outputs: Tensor) -> Tensor:
        """Return images (n, P) of other outputs (n, N) at the same places."""
        emission = outputs.float()
        return (
            emission if self.attenuation is None else emission * self.attenuation
        ) @ self.weights.mT


@torch.no_grad()
@full_precision  # a Gram matrix rounded to half precision has no Cholesky factor
def solve_emissions(
    model: GaussianModel, data: Measurements, rows: np.ndarray, receiver: Pose, process: Process
) -> LeftOut | None:
    """Set the emission's last layer so that the model reproduces the training spectra
    as well as it can.

    What the process leaves unknown becomes the model's error model.

    Args:
        model: spectra, a static receiver, a linear read-out (`emission.hidden=0`) of the process's
            features.
        data: all measurements.
        rows: (n,) training rows.
        receiver: the static pose.
        process: of these rows.

    Returns:
        Rows predicted without their neighbours; None where there are too few.

    Raises:
        ValueError: the emission has hidden units.
    """
    if model.settings.emission.hidden:
        raise ValueError(
            "init=images solves a linear read-out: leave init=auto, or model.emission.hidden=0"
        )
    version = int(model.gaussians.version)
    weights = model.freeze(receiver).render(torch.eye(len(model.gaussians)), version).flatten(1).mT
    parts = [
        _emissions(model, data, part, weights)
        for part in np.array_split(rows, -(-len(rows) // CHUNK))
    ]
    outputs = torch.cat([part.outputs for part in parts])
    mean = outputs.mean(0)
    readout = process.features.weigh @ (outputs - mean)
    model.emission.weight2.copy_(readout.mT.unsqueeze(-1).float())
    model.emission.bias2.copy_(mean.unsqueeze(-1).float())
    first = parts[0]
    chunk = rows[: len(first.outputs)]
    places = torch.from_numpy(data.moving[chunk]).float().double()
    features = whitened_features(
        places, process.prior.length, process.prior.noise, "matern32", len(chunk)
    )
    inverse = features.weigh.mT @ features.weigh
    if model.error is not None:
        model.error.set_error_law(*_error_law(first, inverse, process.prior.noise, mean))
    return _leave_out(first, inverse, data.moving[chunk], mean)


def _emissions(
    model: GaussianModel, data: Measurements, rows: np.ndarray, weights: Tensor
) -> ImageEmissions:
    """Emissions (least squares) that show the images of rows (n,)."""
    gram = weights.mT @ weights
    ridge = IMAGE_RIDGE * gram.diagonal().mean() * torch.eye(len(gram))
    batch = data.batch(rows)
    filled = training_targets(data, rows)
    images = torch.from_numpy(data.site.target.to_real(filled)).flatten(1)
    emission = Factor.from_gram(gram + ridge).solve(weights.mT @ images.mT).mT
    distance = model.relative_distances(batch.tx)
    attenuation = model.attenuation(distance)
    emission = emission if attenuation is None else emission / attenuation
    outputs = model.emission.to_logits(emission.unsqueeze(-1), distance).squeeze(-1)
    return ImageEmissions(weights, images, outputs.double(), attenuation)


def _error_law(
    seen: ImageEmissions, inverse: Tensor, noise: float, mean: Tensor
) -> tuple[float, float]:
    """Level and power of the `ErrorModel`: errors of rows left out one by one,
    and of the mean alone.

    Rasmussen and Williams (2006), eq. 5.12.
    """
    residual, variance = left_out_residuals(inverse, inverse @ (seen.outputs - mean))
    unknown = (variance - noise).clamp(0, 1)
    images = [seen.render(seen.outputs - residual), seen.render(mean.expand_as(seen.outputs))]
    error = torch.cat([(image - seen.images).square().mean(1) for image in images])
    return fit_error_law(
        torch.cat([unknown, torch.ones_like(unknown)]).numpy(), error.double().numpy()
    )


def _leave_out(
    seen: ImageEmissions, inverse: Tensor, places: np.ndarray, mean: Tensor
) -> LeftOut | None:
    """Rows at places (n, 3) [m] predicted without their neighbours, at gaps of some spacings."""
    count = len(places)
    if count < LEAST_HELD:
        return None
    draws = np.random.default_rng(0)
    pixels = torch.from_numpy(sample_row_numbers(seen.images.shape[1], PIXELS, draws))
    centres = sample_row_numbers(count, CENTRES, draws)
    distance = cdist(places, places)
    spacing = np.median(np.where(np.eye(count, dtype=bool), np.inf, distance).min(1))
    gaps = np.array(GAPS) * spacing
    about = (seen.outputs - mean).numpy()
    means, _ = means_and_variances(inverse.numpy(), about, distance, centres, gaps)
    some = replace(seen, weights=seen.weights[pixels], images=seen.images[:, pixels]).subset(
        centres
    )
    predicted = [some.render(torch.from_numpy(at_gap) + mean).clamp(0, 1) for at_gap in means]
    images = seen.images[:, pixels].double().numpy()
    return LeftOut(places, images, centres, gaps, torch.stack(predicted).double().numpy())


def start_in_closed_form(task: InitTask) -> Start:
    """Return the start of a task.

    Raises:
        ValueError: a start is asked for that the data do not allow.
    """
    if task.settings.response.array and task.closed_form:
        return start_from_vectors(task)
    if task.closed_form:
        assert task.receiver is not None  # else `auto_settings` refuses
        process = learn_process(task.data, task.rows, task.most_anchors, task.seed)
        solve = partial(
            solve_emissions, data=task.data, rows=task.rows, receiver=task.receiver, process=process
        )
        return Start(process.prior, solve)
    kernel = "kernel" in (
        task.settings.emission.encoding.kind,
        task.settings.confidence.encoding.kind,
    )
    prior = learn_prior(task.data, task.rows, task.most_anchors, task.seed) if kernel else None
    return Start(prior)
