"""How wrong a field will be at a place, learned from how wrong it was about rows that it had not seen.

A process on images has one variance for all places of a density; errors have not: shadow edges and
interference sit somewhere. The logarithm of the left-out relative errors is regressed on what is known of a
place before anything is measured there.
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

NEIGHBOURS = 16  # whose left-out errors are averaged
NEAR = 4  # the distance to this neighbour is the reach of the average
LEAST, MOST = 1e-4, 10.0  # relative errors are taken to lie between
ARRAYS = ("places", "errors", "centre", "scale", "slope", "low", "high")
RIDGES = np.logspace(-2, 4, 13)  # tried, by leaving one out


@dataclass(frozen=True)
class Looks:
    """What a prediction looks like (n,) each.

    Attributes:
        left: variance that the process has left, relative to its prior.
        mean: brightness of the image.
        peak: its largest pixel.
        added: mean square of what the process adds to the sources' image.
    """

    left: np.ndarray
    mean: np.ndarray
    peak: np.ndarray
    added: np.ndarray

    def columns(self) -> np.ndarray:
        """(n, 4) for a linear model."""
        logs = (np.log(np.maximum(x, 1e-9)) for x in (self.left, self.mean, self.added))
        return np.column_stack([*logs, self.peak])


@dataclass(frozen=True)
class Doubt:
    """The regression.

    Attributes:
        places: (n, 3) [m] learned from.
        errors: (n,) logarithms of their left-out relative errors.
        centre, scale, slope: (5,) of the standardised columns; the first is the neighbours' error.
        low, high: (5,) range of the columns, beyond which nothing is extrapolated.
        level: the logarithm's mean, raised so that the mean error comes out.
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

    def relative_error(self, places: np.ndarray, looks: Looks) -> np.ndarray:
        """Expected |e|^2 / |h|^2 (m,) at places (m, 3) [m].

        Beyond the farthest distance at which errors were seen it grows with the distance squared.
        """
        distance, row = self._tree.query(places, k=np.arange(1, min(NEIGHBOURS, len(self.places)) + 1))
        columns = np.column_stack([_average(distance, self.errors[row]), looks.columns()])
        columns = np.clip(columns, self.low, self.high)
        said = self.level + ((columns - self.centre) / self.scale) @ self.slope
        beyond = np.maximum(distance[:, 0] / self.farthest, 1.0) ** 2
        return np.exp(np.clip(said, np.log(LEAST), np.log(MOST))) * beyond

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.places)

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        arrays = {name: torch.from_numpy(getattr(self, name)) for name in ARRAYS}
        return {**arrays, "level": self.level, "farthest": self.farthest}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> Doubt:
        """Inverse of `state`."""
        arrays = {name: state[name].numpy() for name in ARRAYS}
        return Doubt(**arrays, level=float(state["level"]), farthest=float(state["farthest"]))


def learn_doubt(places: np.ndarray, relative_error: np.ndarray, looks: Looks) -> Doubt:
    """From the left-out errors |e|^2 / |h|^2 (n,) and looks of rows at places (n, 3) [m]; n of at least 2."""
    errors = np.log(np.clip(relative_error, LEAST, MOST))
    distance, row = cKDTree(places).query(places, k=np.arange(2, min(NEIGHBOURS + 1, len(places)) + 1))
    columns = np.column_stack([_average(distance, errors[row]), looks.columns()])
    centre, scale = columns.mean(0), np.maximum(columns.std(0), 1e-9)
    model = RidgeCV(RIDGES).fit((columns - centre) / scale, errors)
    left = errors - model.predict((columns - centre) / scale)
    # the mean of a relative error is not the exponential of its logarithm's mean (Duan 1983)
    level = float(model.intercept_ + np.log(np.exp(left).mean()))
    farthest = max(float(distance[:, 0].max()), 1e-6)
    return Doubt(
        places, errors, centre, scale, np.asarray(model.coef_, dtype=np.float64),
        columns.min(0), columns.max(0), level, farthest,
    )  # fmt: skip


def _average(distance: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean (m,) of neighbours' values (m, k), the near ones counting more; distances (m, k) are sorted."""
    reach = np.maximum(distance[:, min(NEAR, distance.shape[1]) - 1, None], 1e-9)
    weight = np.exp(-distance / reach)
    return (weight * values).sum(1) / weight.sum(1)
