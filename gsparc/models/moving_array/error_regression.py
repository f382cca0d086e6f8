"""Expected errors of images over the receivers' places,
from the leave-one-out errors of training rows.

The posterior variance of a process on images depends on the sampling density alone; errors do not:
they are large at shadow boundaries and where paths interfere. Far from all rows nothing is known:
the error is that of an image drawn at random.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.models.relative_error import LEAST_ERROR, RelativeErrorRegression
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import Kernel
from gsparc.processes.matern import matern32
from gsparc.processes.neighbourhood import rows_with_nearest
from gsparc.processes.stored import Stored

NEIGHBOURS = 16  # whose leave-one-out errors are averaged, and on which variances are conditioned
NEAR = 4  # the distance to this neighbour is the reach of the average
LEAST_NOISE = 1e-6  # of neighbours that nearly coincide
LEAST_M = 1e-6  # [m], of rows that are at one place


def image_features(image: Tensor, added: Tensor) -> Tensor:
    """Return features (n, 3) of predicted images: log brightness, log of what is added,
    largest pixel.

    Args:
        image: (n, H, W), the prediction.
        added: (n,) mean square of what the process adds to the sources' image.
    """
    flat = image.flatten(1)
    power = torch.stack([flat.mean(1), added], 1).clamp_min(1e-9).log()
    return torch.cat([power, flat.amax(1, keepdim=True)], 1)


@dataclass(frozen=True)
class ImageErrors(Stored):
    """Errors of images near training rows and far from them.

    Attributes:
        near: (n, k) rows nearest to each of the n training rows, itself first.
        precision: (n, k, k) float64, inverse of these rows' correlations with noise.
        errors: (n,) logarithms of leave-one-out relative errors.
        regression: on five columns: the neighbours' error, the logarithm of the residual's variance
            given the neighbours, and `image_features`.
        kernel: of the residual.
        farthest: largest distance of a learned place to its nearest other [m].
        reach: correlation length of the sources' powers [m].
        prior: mean square error per pixel of an image drawn at random.
    """

    near: Tensor
    precision: Tensor
    errors: Tensor
    regression: RelativeErrorRegression
    kernel: Kernel
    farthest: float
    reach: float
    prior: float

    def unknown_and_variance(
        self, far: Tensor, features: Tensor, power: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return what is unknown (m,) in [0, 1], and the mean square error per pixel (m,), float32.

        An image is known to its relative error with weight c and not at all with weight 1 - c, the
        correlation c of a source's power over what the nearest row is farther
        than the largest gap of rows.

        Args:
            far: (m, n) [m] from the training rows.
            features: (m, 3), see `image_features`.
            power: (m,) mean square of the predicted images.
        """
        error, nearest = self.error_and_nearest(far, features)
        correlation = matern32((nearest - self.farthest).clamp_min(0), self.reach)
        variance = (
            correlation * (error * power).clamp_max(self.prior) + (1 - correlation) * self.prior
        )
        return 1 - correlation / (1 + error), variance

    def error_and_nearest(self, far: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the expected |e|^2 / |h|^2 (m,) near rows, and distances (m,) [m]; see `expected`.

        Beyond the largest distance between training places it grows with the distance squared.
        """
        nearest, row = far.min(1)
        near = self.near[row]
        distance = far.gather(1, near)
        columns = _columns(self.kernel, distance, self.precision[row], self.errors[near], features)
        beyond = (nearest / self.farthest).clamp_min(1.0).square()
        return self.regression.expected_error(columns) * beyond, nearest


def fit_errors(
    places: np.ndarray,
    relative_error: Tensor,
    features: Tensor,
    kernel: Kernel,
    reach: float,
    prior: float,
) -> ImageErrors:
    """Fit leave-one-out errors |e|^2 / |h|^2 (n,) and features (n, 3) at places (n, 3) [m];
    n at least 2.

    `kernel`, `reach` and `prior` are `ImageErrors`'s.
    """
    errors = relative_error.clamp_min(LEAST_ERROR).log()
    rows = torch.from_numpy(rows_with_nearest(places, np.arange(len(places)), NEIGHBOURS))
    others, near, positions = rows[:, 1:], rows[:, :NEIGHBOURS], torch.from_numpy(places)
    distance = (positions[others] - positions[:, None]).norm(dim=2).float()
    columns = _columns(
        kernel, distance, _precision(kernel, positions[others]), errors[others], features
    )
    regression = RelativeErrorRegression.from_rows(columns, relative_error)
    precision, farthest = (
        _precision(kernel, positions[near]),
        max(float(distance[:, 0].max()), LEAST_M),
    )
    return ImageErrors(near, precision, errors, regression, kernel, farthest, reach, prior)


def _columns(
    kernel: Kernel, distance: Tensor, precision: Tensor, errors: Tensor, features: Tensor
) -> Tensor:
    """Columns (m, 5) of the regression from k neighbours: (m, k) distances [m], (m, k, k), (m, k)
    errors.
    """
    variance = _posterior_variance(kernel, distance, precision).log().to(distance.dtype)
    return torch.cat(
        [torch.stack([_average_neighbours(distance, errors), variance], 1), features], 1
    )


def _precision(kernel: Kernel, places: Tensor) -> Tensor:
    """Inverse correlations (m, k, k) with noise, of rows at (m, k, 3) float64 [m]."""
    noise = max(kernel.noise, LEAST_NOISE) * torch.eye(places.shape[1], dtype=torch.float64)
    return Factor.from_gram(kernel.correlations(places, places) + noise, "raise").inverse


def _posterior_variance(kernel: Kernel, distance: Tensor, precision: Tensor) -> Tensor:
    """Posterior variance (m,) float64 over the amplitude at a `distance` (m, k)
    [m] from k neighbours.

    The nearest rows screen off the others (Stein 2002),
    whose Cholesky factor would be most of a query.
    """
    cross = kernel.correlation(distance.double())[:, None]
    prior = 1 + kernel.noise
    return (prior - (cross @ precision @ cross.mT)[:, 0, 0]).clamp(
        max(kernel.noise, LEAST_NOISE), prior
    )


def _average_neighbours(distance: Tensor, values: Tensor) -> Tensor:
    """Mean (m,) of neighbours' values (m, k) with exponential weights of the distances (m, k)."""
    near = min(NEAR, distance.shape[1])
    reach = distance.kthvalue(near, dim=1, keepdim=True).values.clamp_min(LEAST_M)
    return ((-distance / reach).softmax(1) * values).sum(1)
