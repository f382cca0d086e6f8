"""Error model: expected error at a place, regressed on the leave-one-out errors of training rows.

The posterior variance of a process on images depends on the sampling density alone; errors do not: they are
large at shadow boundaries and where paths interfere. The logarithm of the leave-one-out relative error is
regressed on what is known of a prediction without a measurement. Far from all rows nothing is known: the
error is that of an image drawn at random.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from sklearn.linear_model import RidgeCV
from torch import Tensor

from gsparc.array.moving.power_gp import matern
from gsparc.methods.gp import Kernel

NEIGHBOURS = 16  # whose leave-one-out errors are averaged, and on which variances are conditioned
NEAR = 4  # the distance to this neighbour is the reach of the average
MIN_ERROR, MAX_ERROR = 1e-4, 10.0  # relative errors are clipped to
ARRAYS = ("places", "errors", "centre", "scale", "slope", "low", "high")
NUMBERS = ("level", "farthest", "reach", "prior")
RIDGES = np.logspace(-2, 4, 13)  # chosen by leave-one-out


def image_features(image: Tensor, added: Tensor) -> np.ndarray:
    """Features (n, 3) of predicted images: logarithms of brightness and of what is added, largest pixel.

    Args:
        image: (n, H, W), the prediction.
        added: (n,) mean square of what the process adds to the sources' image.
    """
    flat = image.flatten(1)
    power = torch.stack([flat.mean(1), added], 1).clamp_min(1e-9).log()
    return torch.cat([power, flat.amax(1, keepdim=True)], 1).double().numpy()


@dataclass(frozen=True)
class ErrorModel:
    """The regression.

    Attributes:
        places: (n, 3) [m] learned from.
        errors: (n,) logarithms of their leave-one-out relative errors.
        centre, scale, slope: (5,) of the standardised columns: the neighbours' error, the logarithm of the
            residual's variance given the neighbours, and `image_features`.
        low, high: (5,) range of the columns, beyond which nothing is extrapolated.
        kernel: of the residual.
        level: mean of the logarithm, corrected so that the mean error is unbiased.
        farthest: largest distance of a learned place to its nearest other [m].
        reach: correlation length of the sources' powers [m].
        prior: mean square error per pixel of an image drawn at random.
    """

    places: np.ndarray
    errors: np.ndarray
    centre: np.ndarray
    scale: np.ndarray
    slope: np.ndarray
    low: np.ndarray
    high: np.ndarray
    kernel: Kernel
    level: float
    farthest: float
    reach: float
    prior: float

    def expected(self, places: np.ndarray, features: np.ndarray, power: Tensor) -> tuple[Tensor, Tensor]:
        """What is unknown (m,) in [0, 1], and the mean square error per pixel (m,), float32.

        With the correlation c of a source's power to the nearest row, an image is known to its relative error
        with weight c and not at all with weight 1 - c.

        Args:
            places: (m, 3) [m].
            features: (m, 3), see `image_features`.
            power: (m,) mean square of the predicted images.
        """
        relative, nearest = self.relative_error(places, features)
        error, known = (torch.from_numpy(v).float() for v in (relative, nearest))
        known = matern(known, self.reach)
        variance = torch.lerp(torch.tensor(self.prior), (error * power).clamp_max(self.prior), known)
        return 1 - known / (1 + error), variance

    def relative_error(self, places: np.ndarray, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Expected |e|^2 / |h|^2 (m,) at places (m, 3) [m] near rows, and distances (m,) [m] to the nearest.

        Beyond the largest distance between training places it grows with the distance squared.
        """
        distance, row = self._tree.query(places, k=np.arange(1, min(NEIGHBOURS, len(self.places)) + 1))
        columns = _columns(self.kernel, self.places, self.errors, distance, row, features)
        columns = np.clip(columns, self.low, self.high)
        predicted = self.level + ((columns - self.centre) / self.scale) @ self.slope
        beyond = np.maximum(distance[:, 0] / self.farthest, 1.0) ** 2
        return np.exp(np.clip(predicted, np.log(MIN_ERROR), np.log(MAX_ERROR))) * beyond, distance[:, 0]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.places)

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        arrays = {name: torch.from_numpy(getattr(self, name)) for name in ARRAYS}
        numbers = {name: getattr(self, name) for name in NUMBERS}
        return {**arrays, **numbers, "kernel": [*vars(self.kernel).values()]}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> ErrorModel:
        """Inverse of `state`."""
        arrays = {name: state[name].numpy() for name in ARRAYS}
        numbers = {name: float(state[name]) for name in NUMBERS}
        return ErrorModel(**arrays, **numbers, kernel=Kernel(*map(float, state["kernel"])))


def fit_error_model(
    places: np.ndarray,
    relative_error: np.ndarray,
    features: np.ndarray,
    kernel: Kernel,
    reach: float,
    prior: float,
) -> ErrorModel:
    """From leave-one-out errors |e|^2 / |h|^2 (n,) and features (n, 3) at places (n, 3) [m]; n at least 2.

    `kernel`, `reach` and `prior` are `ErrorModel`'s.
    """
    errors = np.log(np.clip(relative_error, MIN_ERROR, MAX_ERROR))
    distance, row = cKDTree(places).query(places, k=np.arange(2, min(NEIGHBOURS + 1, len(places)) + 1))
    columns = _columns(kernel, places, errors, distance, row, features)
    centre, scale = columns.mean(0), np.maximum(columns.std(0), 1e-9)
    model = RidgeCV(RIDGES).fit((columns - centre) / scale, errors)
    residual = errors - model.predict((columns - centre) / scale)
    # the mean of a relative error is not the exponential of its logarithm's mean (Duan 1983)
    level = float(model.intercept_ + np.log(np.exp(residual).mean()))
    farthest = max(float(distance[:, 0].max()), 1e-6)
    return ErrorModel(
        places, errors, centre, scale, np.asarray(model.coef_, dtype=np.float64),
        columns.min(0), columns.max(0), kernel, level, farthest, reach, prior,
    )  # fmt: skip


def _columns(
    kernel: Kernel,
    places: np.ndarray,
    errors: np.ndarray,
    distance: np.ndarray,
    row: np.ndarray,
    features: np.ndarray,
) -> np.ndarray:
    """Columns (m, 5) of the regression from the k nearest rows (m, k) and their distances (m, k) [m]."""
    variance = np.log(_variance(kernel, places[row], distance))
    return np.column_stack([_average(distance, errors[row]), variance, features])


def _variance(kernel: Kernel, near: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Posterior variance (m,) over the amplitude, given rows at (m, k, 3) [m], `distance` (m, k) away.

    The nearest rows screen off the others (Stein 2002), whose Cholesky factor would be most of a query.
    """
    between = torch.from_numpy(np.linalg.norm(near[:, :, None] - near[:, None], axis=-1))
    cross = matern(torch.from_numpy(distance), kernel.length)[..., None]
    gram = matern(between, kernel.length) + kernel.noise * torch.eye(near.shape[1], dtype=torch.float64)
    explained = (cross * torch.linalg.solve(gram, cross)).sum((1, 2))
    prior = 1 + kernel.noise
    return (prior - explained).clamp(1e-9, prior).numpy()


def _average(distance: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean (m,) of neighbours' values (m, k) with exponential weights of the sorted distances (m, k)."""
    reach = np.maximum(distance[:, min(NEAR, distance.shape[1]) - 1, None], 1e-9)
    weight = np.exp(-distance / reach)
    return (weight * values).sum(1) / weight.sum(1)
