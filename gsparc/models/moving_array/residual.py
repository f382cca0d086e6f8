"""What sources leave of spectra (interference, shadow edges): a Gaussian process on images.

Universal kriging (Matheron 1969) with the process of `baselines.gp`; images are numbers of a basis
that they share (`gsparc.physics.separable`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import eigh
from torch import Tensor

from gsparc.models.moving_array.power_gp import solve_and_leave_out
from gsparc.processes.fit_kernel import choose_left_out_kernel
from gsparc.processes.kernel import Kernel
from gsparc.processes.stored import Stored

KERNEL_COMPONENTS = 128  # principal components that kernels are chosen on
SPARED = 3e-4  # of the left-out error: energy of predictions along all axes left out


@dataclass(frozen=True)
class Residual(Stored):
    """The process, conditioned.

    Attributes:
        kernel: over the receivers' places.
        mean: (R,) float32 coefficients of the mean image.
        axes: (C, R) float32, orthonormal, by their share of what is predicted.
        weights: (n, C) float32, one row per training receiver.
    """

    kernel: Kernel
    mean: Tensor
    axes: Tensor
    weights: Tensor

    def coefficients(self, distance: Tensor) -> Tensor:
        """Return coefficients (m, R) of images at places `distance` (m, n)
        [m] from training receivers.
        """
        return torch.addmm(self.mean, self.kernel.correlation(distance) @ self.weights, self.axes)

    def keep_axes(self, count: int) -> Residual:
        """Return the process with the `count` axes that most is predicted along."""
        return Residual(
            self.kernel, self.mean, self.axes[:count], self.weights[:, :count].contiguous()
        )


def fit_residual(
    kernel: Kernel, places: np.ndarray, values: Tensor, limit: int
) -> tuple[Residual, Tensor]:
    """Return the process on coefficients (n, R) at places (n, 3) [m],
    and its left-out predictions (n, R).

    Axes are those of the left-out predictions, fewer than those of the rows: a row's own details
    are on the latter, but in no prediction. What a prediction lacks
    of its axes adds about its energy to the error.
    """
    mean = values.mean(0)
    if limit == 0:
        none = Residual(kernel, mean, torch.zeros(0, len(mean)), torch.zeros(len(values), 0))
        return none, mean.expand(values.shape)
    centred = (values - mean).double().numpy()
    weights, missed = (
        part.numpy() for part in solve_and_leave_out(kernel, places, torch.from_numpy(centred))
    )
    predicted = centred - missed
    energy, axes = energies_and_axes(predicted, limit)
    left_out = (predicted**2).sum() - energy.sum() + energy[::-1].cumsum()[::-1] - energy
    basis = axes[: 1 + int((left_out > SPARED * (missed**2).sum()).sum())]
    turned = torch.from_numpy(weights @ basis.T).float().contiguous()
    residual = Residual(kernel, mean, torch.from_numpy(basis).float().contiguous(), turned)
    return residual, torch.addmm(mean, torch.from_numpy(predicted @ basis.T).float(), residual.axes)


def error_and_likeliest_kernel(places: np.ndarray, values: Tensor) -> tuple[float, Kernel]:
    """Return the left-out squared error of images (n, R) under the likeliest kernel,
    and that kernel.
    """
    mean = values.mean(0)
    centred = (values - mean).double().numpy()
    scores = centred @ energies_and_axes(centred, KERNEL_COMPONENTS)[1].T
    kernel = choose_left_out_kernel(places, scores, values.shape[1], 1)
    residual = solve_and_leave_out(kernel, places, torch.from_numpy(scores))[1]
    missed = float(residual.square().sum()) + (centred**2).sum() - (scores**2).sum()
    return float(missed) / len(values), kernel


def energies_and_axes(values: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `limit` principal axes (C, R) of values (n, R), energies (C,) along them,
    falling.
    """
    n, r = values.shape
    gram = values @ values.T if n <= r else values.T @ values
    keep = min(limit, n, r)
    energy, vectors = eigh(gram, subset_by_index=[len(gram) - keep, len(gram) - 1])
    energy, vectors = energy[::-1], vectors[:, ::-1]
    solid = energy > 1e-10 * max(energy[0], np.finfo(float).tiny)  # below rounding there is no axis
    energy, vectors = energy[solid], vectors[:, solid]
    return energy, (vectors / np.sqrt(energy)).T @ values if n <= r else vectors.T
