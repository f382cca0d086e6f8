"""Ordinary kriging of log power: the classical map of coverage.

N. Cressie, "Statistics for Spatial Data" (1993), chapters 2 and 3; the exponential law is that of
shadowing, M. Gudmundson, "Correlation model for shadow fading in mobile radio systems", Electronics
Letters 27 (1991). Power is kriged in decibels; spectra pixel by pixel, channels entry by entry,
with one variogram for all, so that one set of weights serves them. A channel's phase is that of the
measured ones under the same weights: a map of power knows no better. Of more than `WHOLE` places
each query is kriged from its `NEAREST` ones alone: they screen those farther away. Left out: drift
with distance (universal kriging), anisotropy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.linalg import lu_factor, lu_solve
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, pdist

from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.processes.averages import mean_at_places
from gsparc.processes.stored import Stored

FLOOR = 1e-3  # of a pixel, of the brightest possible: -30 dB
SILENCE = 1e-36  # power of a channel where none was measured, in stored units: it has no decibels
BINS = 24
PAIRS = 200_000  # looked at for the variogram
SIDE = 2048  # pixels of an image looked at for it
WHOLE = 3_000  # places whose system is factored as one: that costs their number cubed
NEAREST = 100  # places that a query is kriged from, of more than these
BLOCK = 256  # queries whose systems are solved at a time: memory
BYTES = 2**27  # of measured rows beside them
JITTER = 1e-9  # of the variance, only so that a system without nugget can be solved


@dataclass(frozen=True)
class Variogram(Stored):
    """`nugget + sill (1 - exp(-distance / range))` beyond distance 0, where it is 0.

    Attributes:
        nugget, sill: [dB^2].
        range: [m].
    """

    nugget: float
    sill: float
    range: float

    @property
    def variance(self) -> float:
        """Variance of a measurement far from all others [dB^2]."""
        return self.nugget + self.sill


def fit_variogram(positions: np.ndarray, values: np.ndarray, seed: int = 0) -> Variogram:
    """Fit the empirical variogram up to half the extent by least squares,
    weighed by the number of pairs.

    Args:
        positions: (n, 3) [m].
        values: (n, D) [dB].
    """
    rng = np.random.default_rng(seed)
    columns = rng.permutation(values.shape[1])[:SIDE]
    chosen = rng.permutation(len(positions))[: int(np.sqrt(2 * PAIRS))]
    pair_distances = pdist(positions[chosen])
    half = pdist(values[chosen][:, columns].astype(np.float64), "sqeuclidean") / (2 * len(columns))
    spread = float(half.mean()) if len(half) else 1.0
    limit = pair_distances.max() / 2 if len(pair_distances) else 1.0
    inside = pair_distances[pair_distances <= limit]
    edges = np.unique(np.quantile(inside, np.linspace(0, 1, BINS + 1))) if len(inside) else inside
    if len(edges) < 5 or spread <= 0:  # too few distances to see a law
        return Variogram(0.0, max(spread, 1e-9), max(limit, 1e-3))
    which = np.clip(np.digitize(pair_distances, edges) - 1, 0, len(edges) - 2)
    near = pair_distances <= limit
    number = np.bincount(which[near], minlength=len(edges) - 1)
    filled = number > 0
    distance = (
        np.bincount(which[near], pair_distances[near], len(edges) - 1)[filled] / number[filled]
    )
    gamma = np.bincount(which[near], half[near], len(edges) - 1)[filled] / number[filled]

    def variogram(r: np.ndarray, nugget: float, sill: float, length: float) -> np.ndarray:
        return nugget + sill * -np.expm1(-r / length)

    low, high = [0, 0, limit * 1e-3], [spread * 3, spread * 10, limit * 10]
    start = [float(gamma[0]) / 2, spread, limit / 5]
    start = [min(max(s, a), b) for s, a, b in zip(start, low, high, strict=True)]
    weight = np.sqrt(number[filled])
    optimum = least_squares(
        lambda p: weight * (variogram(distance, *p) - gamma), start, bounds=(low, high)
    )
    return Variogram(*optimum.x.tolist())


class Kriging(Interpolator):
    """Powers, spectra, and the power of channels."""

    name = "kriging"
    baseline_order = 80
    kinds = ("rssi",)
    no_gradient = "its systems are solved outside of autograd"
    stored = ("positions", "values", "variogram", "channels")
    system: tuple[np.ndarray, np.ndarray] | None = None
    tree: cKDTree | None = None

    @property
    def label(self) -> str:
        """The name, and how many places a query is kriged from where it is not all."""
        return self.name if self.tree is None else f"{self.name} (nearest {NEAREST})"

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        # Repeated places would make the system singular: their mean is kriged.
        decibels, self.channels = self._to_decibels(targets), None
        first, self.values, _ = mean_at_places(positions, decibels)
        self.positions = positions[first]
        if self.target.is_complex:
            self.channels = mean_at_places(positions, targets.reshape(len(targets), -1))[1]
        self.variogram = fit_variogram(positions, decibels)
        self._factor_system()
        v = self.variogram
        few = (
            f"; of {len(self.positions)} places each query's nearest {NEAREST}"
            if self.system is None
            else ""
        )
        return (
            f"kriging: nugget {v.nugget:.3g} dB^2, sill {v.sill:.3g} dB^2, range "
            f"{v.range:.3g} m{few}",
        )

    def _to_decibels(self, targets: np.ndarray) -> np.ndarray:
        if self.target.is_complex:
            power = np.abs(targets.reshape(len(targets), -1)) ** 2
            floor = max(float(power.mean()) * 1e-8, SILENCE)
            return to_decibels(np.maximum(power, floor)).astype(np.float32)
        rows = self.target.to_real(targets)
        if self.kind == "rssi":
            return rows  # already decibels
        return to_decibels(np.maximum(rows, np.float32(FLOOR)))

    def _factor_system(self) -> None:
        """Factor the system of all places, or prepare to find the nearest of too many for that."""
        self.system, self.tree = None, None
        if len(self.positions) > WHOLE:
            self.tree = cKDTree(self.positions)
        else:
            self.system = lu_factor(self._kriging_matrix(cdist(self.positions, self.positions)))

    def _kriging_matrix(self, distance: np.ndarray) -> np.ndarray:
        """Of the weights of n places and the multiplier that makes them sum to one:
        (..., n + 1, n + 1).
        """
        n = distance.shape[-1]
        system = np.ones((*distance.shape[:-2], n + 1, n + 1))
        system[..., :n, :n] = self._covariance(distance)
        system[..., np.arange(n), np.arange(n)] += (
            self.variogram.nugget + JITTER * self.variogram.variance
        )
        system[..., n, n] = 0.0
        return system

    def _weights(self, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For queries (Q, D): their places (Q, n), weights (Q, n), and variances [dB^2] (Q,)."""
        if self.tree is None:
            place = np.broadcast_to(
                np.arange(len(self.positions)), (len(queries), len(self.positions))
            )
            distance = cdist(queries, self.positions)
        else:
            distance, place = self.tree.query(queries, k=NEAREST)
        right = np.ones((len(queries), distance.shape[1] + 1))
        right[:, :-1] = self._covariance(distance)  # without the nugget: noise is not kept
        if self.system is not None:
            factor, pivots = self.system
            # Pivots are counted from 1 meanwhile
            solved = lu_solve((factor, pivots.copy()), right.T).T
        else:
            near = self.positions[place]
            pair_distances = np.linalg.norm(near[:, :, None] - near[:, None], axis=-1)
            solved = np.linalg.solve(self._kriging_matrix(pair_distances), right[..., None])[..., 0]
        variance = np.clip(self.variogram.variance - (solved * right).sum(1), 0.0, None)
        return place, solved[:, :-1], variance

    def _covariance(self, distance: np.ndarray) -> np.ndarray:
        return self.variogram.sill * np.exp(-distance / self.variogram.range)

    def _look_up(self, queries: np.ndarray) -> Prediction:
        # Answered at a time
        block = max(1, min(BLOCK, BYTES // (NEAREST * self.values[:1].nbytes)))
        if self.tree is not None and len(queries) > block:
            parts = [self._look_up(queries[i : i + block]) for i in range(0, len(queries), block)]
            return Prediction.joined(parts)
        place, weights, variance_db2 = self._weights(queries)
        shares = torch.from_numpy(weights)

        def weighted_sum(values: np.ndarray, kind: torch.dtype) -> torch.Tensor:
            if self.tree is None:
                return shares.to(kind) @ torch.from_numpy(values)
            return torch.einsum("qk,qkd->qd", shares.to(kind), torch.from_numpy(values[place]))

        decibels, variance = (
            weighted_sum(self.values, torch.float32),
            torch.from_numpy(variance_db2).float(),
        )
        power = self.kind == "rssi"
        if self.channels is None:
            mean = self._to_targets(decibels if power else from_decibels(decibels))
        else:
            towards = weighted_sum(self.channels, torch.complex64)
            mean = torch.polar(from_decibels(decibels / 2), towards.angle()).view(-1, *self.shape)
        unknown = (variance / self.variogram.variance).clamp(0, 1)
        return Prediction(
            mean, self.target.entry_variance(variance, mean) if power else None, unknown
        )

    def _relearn(self, state: dict[str, Any]) -> None:
        super()._relearn(state)
        self._factor_system()
