"""A first field in closed form: project the training images on the footprints, regress over position.

Footprints are fixed, so an image is linear in the emissions, and an emission that is linear in the whitened
kernel features is a Gaussian process of position: both fits are ridge least squares. Gradient training
starts from there; from random weights it needs minutes to get as far and generalises worse (Adam's solution
is not the one of least norm).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.field.encoding import Prior
from gsparc.field.model import GaussianModel
from gsparc.methods.gp import choose_kernel, principal_components
from gsparc.methods.target_rows import training_targets
from gsparc.ops import Pose

IMAGE_RIDGE = 1e-4  # relative to the mean footprint energy; footprints overlap, so the projection is singular
CHUNK = 256  # images held as floats at a time
KERNEL_ROWS = 1024  # leave-one-out factors a matrix of this size at every look
COMPONENTS = 128


def learn_prior(data: Measurements, rows: np.ndarray, anchors: int, seed: int) -> Prior:
    """Smoothness and up to `anchors` positions (drawn by seed) from training rows (n,)."""
    generator = np.random.default_rng(seed)
    chosen = rows if len(rows) <= anchors else np.sort(generator.choice(rows, anchors, replace=False))
    looked_at = chosen[:: -(-len(chosen) // KERNEL_ROWS)]
    parts = principal_components(training_targets(data, looked_at), data.site.kind, COMPONENTS)
    kernel = choose_kernel(data.moving[looked_at], parts.scores, len(parts.mean))
    return Prior(torch.from_numpy(data.moving[chosen].astype(np.float32)), kernel.length, kernel.noise)


@torch.no_grad()
@torch.autocast("cpu", enabled=False)  # a Gram matrix rounded to half precision has no Cholesky factor
def warm_start(
    model: GaussianModel, data: Measurements, rows: np.ndarray, receiver: Pose, noise: float
) -> None:
    """Set the emission's last layer so that the model reproduces the training spectra as well as it can.

    Args:
        model: spectra, a static receiver, a linear read-out (`emission.hidden=0`).
        data: all measurements.
        rows: (n,) training rows.
        receiver: the static pose.
        noise: ridge of the regression over position, relative to the unit variance of the kernel.

    Raises:
        ValueError: the emission has hidden units.
    """
    if model.settings.emission.hidden:
        raise ValueError("init=images solves a linear read-out: set model.emission.hidden=0")
    version = int(model.gaussians.version)
    weights = model.freeze(receiver).render(torch.eye(len(model.gaussians)), version).flatten(1).mT
    gram = weights.mT @ weights
    ridge = IMAGE_RIDGE * gram.diagonal().mean() * torch.eye(len(gram))
    factor = torch.linalg.cholesky(gram + ridge)
    logits, encoded = [], []
    targets = training_targets(data, rows)  # holes are filled
    for start in range(0, len(rows), CHUNK):
        batch = data.batch(rows[start : start + CHUNK])
        images = torch.from_numpy(targets[start : start + CHUNK]).flatten(1)
        images = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        emission = torch.cholesky_solve(weights.mT @ images.mT, factor).mT
        distance = model.distances(batch.tx)
        attenuation = model.attenuation(distance)
        emission = emission if attenuation is None else emission / attenuation
        logits.append(model.emission.inverse(emission.unsqueeze(-1), distance).squeeze(-1))
        encoded.append(model.emission.encoding(model.site.moving(batch.tx, batch.rx)))
    outputs, features = torch.cat(logits).double(), torch.cat(encoded).double()
    mean = outputs.mean(0)
    readout = _ridge(features, outputs - mean, noise)
    model.emission.weight2.copy_(readout.mT.unsqueeze(-1).float())
    model.emission.bias2.copy_(mean.unsqueeze(-1).float())


def _ridge(features: Tensor, targets: Tensor, noise: float) -> Tensor:
    """(features' features + noise)^-1 features' targets: (n, M), (n, N) -> (M, N)."""
    gram = features.mT @ features
    gram.diagonal().add_(max(noise, 1e-6))
    return torch.cholesky_solve(features.mT @ targets, torch.linalg.cholesky(gram))
