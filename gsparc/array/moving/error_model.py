"""Error model: expected relative error at a place, regressed on the leave-one-out errors of training rows.

The posterior variance of a process on images depends on the sampling density alone; errors do not: they are
large at shadow boundaries and where paths interfere. The logarithm of the leave-one-out relative error is
regressed on what is known of a prediction without a measurement.
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

NEIGHBOURS = 16  # whose leave-one-out errors are averaged
NEAR = 4  # the distance to this neighbour is the reach of the average
MIN_ERROR, MAX_ERROR = 1e-4, 10.0  # relative errors are clipped to
ARRAYS = ("places", "errors", "centre", "scale", "slope", "low", "high")
RIDGES = np.logspace(-2, 4, 13)  # chosen by leave-one-out


def image_features(variance: np.ndarray, image: torch.Tensor, added: torch.Tensor) -> np.ndarray:
    """Features (n, 4) of predicted images (n, P).

    Args:
        variance: (n,) of the residual process, relative to its prior.
        image: the prediction; its brightness and its largest pixel.
        added: what the process adds to the sources' image; its mean square.
    """
    power = (variance, *(part.mean(1).double().numpy() for part in (image, added.square())))
    logs = (np.log(np.maximum(x, 1e-9)) for x in power)
    return np.column_stack([*logs, image.amax(1).double().numpy()])


@dataclass(frozen=True)
class ErrorModel:
    """The regression.

    Attributes:
        places: (n, 3) [m] learned from.
        errors: (n,) logarithms of their leave-one-out relative errors.
        centre, scale, slope: (5,) of the standardised columns; the first is the neighbours' error.
        low, high: (5,) range of the columns, beyond which nothing is extrapolated.
        level: mean of the logarithm, corrected so that the mean error is unbiased.
        farthest: largest distance of a learned place to its nearest other [m].
    """

    places: np.ndarray
    errors: np.ndarray
    centre: np.ndarray
    scale: np.ndarray
    slope: np.ndarray
    low: np.ndarray
    high: np.ndarray
    level: float
    farthest: float

    def relative_error(self, places: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Expected |e|^2 / |h|^2 (m,) at places (m, 3) [m], of `image_features` (m, 4).

        Beyond the largest distance between training places it grows with the distance squared.
        """
        distance, row = self._tree.query(places, k=np.arange(1, min(NEIGHBOURS, len(self.places)) + 1))
        columns = np.column_stack([_average(distance, self.errors[row]), features])
        columns = np.clip(columns, self.low, self.high)
        predicted = self.level + ((columns - self.centre) / self.scale) @ self.slope
        beyond = np.maximum(distance[:, 0] / self.farthest, 1.0) ** 2
        return np.exp(np.clip(predicted, np.log(MIN_ERROR), np.log(MAX_ERROR))) * beyond

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.places)

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        arrays = {name: torch.from_numpy(getattr(self, name)) for name in ARRAYS}
        return {**arrays, "level": self.level, "farthest": self.farthest}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> ErrorModel:
        """Inverse of `state`."""
        arrays = {name: state[name].numpy() for name in ARRAYS}
        return ErrorModel(**arrays, level=float(state["level"]), farthest=float(state["farthest"]))


def fit_error_model(places: np.ndarray, relative_error: np.ndarray, features: np.ndarray) -> ErrorModel:
    """From leave-one-out errors |e|^2 / |h|^2 (n,) and features (n, 4) at places (n, 3) [m]; n at least 2."""
    errors = np.log(np.clip(relative_error, MIN_ERROR, MAX_ERROR))
    distance, row = cKDTree(places).query(places, k=np.arange(2, min(NEIGHBOURS + 1, len(places)) + 1))
    columns = np.column_stack([_average(distance, errors[row]), features])
    centre, scale = columns.mean(0), np.maximum(columns.std(0), 1e-9)
    model = RidgeCV(RIDGES).fit((columns - centre) / scale, errors)
    residual = errors - model.predict((columns - centre) / scale)
    # the mean of a relative error is not the exponential of its logarithm's mean (Duan 1983)
    level = float(model.intercept_ + np.log(np.exp(residual).mean()))
    farthest = max(float(distance[:, 0].max()), 1e-6)
    return ErrorModel(
        places, errors, centre, scale, np.asarray(model.coef_, dtype=np.float64),
        columns.min(0), columns.max(0), level, farthest,
    )  # fmt: skip


def _average(distance: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean (m,) of neighbours' values (m, k) with exponential weights of the sorted distances (m, k)."""
    reach = np.maximum(distance[:, min(NEAR, distance.shape[1]) - 1, None], 1e-9)
    weight = np.exp(-distance / reach)
    return (weight * values).sum(1) / weight.sum(1)
