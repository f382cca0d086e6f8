"""Spectra of a moving array as a method: sources, their powers as a smooth trend, a process for the rest.

The trend moves directions of arrival with the receiver, which interpolating images cannot; the process on
what the trend leaves (interference, shadow edges) is the Gaussian process that serves as our rival, given
that trend (universal kriging; Matheron 1969).
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from gsparc.bearings.compress import components
from gsparc.bearings.lags import BLOCK, Lags
from gsparc.bearings.sources import SearchSettings, bearings, find_sources, mixed, powers
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.method import FitReport, Prediction
from gsparc.peers.encoding import to_real
from gsparc.peers.gp import Kernel, choose_kernel
from gsparc.peers.interpolation import Interpolator

log = logging.getLogger(__name__)

CHOOSING = 128  # components that kernels are chosen with
POOR = 0.02  # share of the energy that lags may leave of a spectrum that the array really measured


@dataclass(frozen=True)
class TrendSettings:
    """How smooth the powers of the sources are taken to be.

    Attributes:
        lengths: of the Matern kernels tried, in diagonals of the receivers' box.
        noise: variance of what is not smooth, relative to the kernel's.
        rows: training rows that the length and the rest's kernel are chosen on, by leaving one out.
    """

    lengths: tuple[float, ...] = (0.06, 0.12, 0.25)
    noise: float = 1.0
    rows: int = 600


class BearingField(Interpolator):
    """Sources seen through the receiver's array.

    Args:
        search: how sources are found.
        trend: how smooth their powers are.
        components: largest number of principal components of what the trend leaves; 0: the trend alone.
        seed: of the search.
        name: as it appears in tables.
    """

    effects = "bearings"

    def __init__(
        self,
        search: SearchSettings | None = None,
        trend: TrendSettings | None = None,
        components: int = 512,
        seed: int = 0,
        name: str = "bearings",
    ) -> None:
        super().__init__()
        self.search, self.trend = search or SearchSettings(), trend or TrendSettings()
        self.components, self.seed, self.name = components, seed, name

    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Find sources, learn their powers and what they leave.

        Raises:
            ValueError: not spectra of a moving receiver with a declared array that keeps its orientation.
        """
        problem = site_problem(data)
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        return super().fit(data, fold, run_dir)

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        begin = time.perf_counter()
        space = self.lags()
        receivers = torch.from_numpy(positions).float()
        self.exponent, lags = self._lags(space, targets)
        rows = _spread(len(targets), self.search.rows)
        assert self.site is not None and self.site.grid is not None
        still = self.site.static_position
        first = None if still is None else torch.from_numpy(np.asarray(still)).float()
        self.sources = find_sources(
            lags[rows],
            receivers[rows],
            first,
            self.rotation(),
            space,
            self.site.grid,
            self.search,
            self.seed,
        )
        found_s = time.perf_counter() - begin
        power = torch.cat([
            powers(part, self._atoms(space, some), self.search.ridge).detach()
            for part, some in zip(lags.split(BLOCK), receivers.split(BLOCK), strict=True)
        ]).double().numpy()  # fmt: skip
        self._choose(space, positions, power, targets)
        left = self._residuals(space, positions, power, targets)
        self.positions = positions
        self._learn_rest(left)
        log.info(
            "%s: %d sources in %.1f s, trend %.3g m, rest %.3g m and noise %.3g",
            self.name, len(self.sources), found_s, self.smooth.length, self.rest.length, self.rest.noise,
        )  # fmt: skip
        return (f"{self.name}: {len(self.sources)} sources, trend over {self.smooth.length:.3g} m",)

    def _lags(self, space: Lags, targets: np.ndarray) -> tuple[int, Tensor]:
        """Whether pixels are amplitude (2) or power (1), and the lags (n, Q) of all spectra.

        Raises:
            ValueError: neither is a spectrum of the declared array.
        """
        exponent, left = beyond(space, self._images(targets[_spread(len(targets), 16)]))
        if left > POOR:
            raise ValueError(
                f"{self.name}: the declared array cannot have measured these spectra "
                f"({left:.0%} of their energy is beyond it)"
            )
        parts = [
            space.of(self._images(targets[i : i + BLOCK]) ** exponent) for i in range(0, len(targets), BLOCK)
        ]
        return exponent, torch.cat(parts)

    def _choose(self, space: Lags, positions: np.ndarray, power: np.ndarray, targets: np.ndarray) -> None:
        """Length of the trend and kernel of the rest, by leaving out rows one at a time."""
        rows = _spread(len(positions), self.trend.rows)
        diagonal = float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
        best = np.inf
        for length in self.trend.lengths:
            kernel = Kernel(length * diagonal, self.trend.noise)
            self._learn_trend(kernel, positions[rows], power[rows])
            left = self._residuals(space, positions[rows], power[rows], targets[rows])
            parts = components(left, CHOOSING)
            rest = choose_kernel(positions[rows], parts.scores, len(parts.mean))
            error = _left_out(rest, positions[rows], parts.scores) + parts.lost * len(parts.mean)
            if error < best:
                best, self.smooth, self.rest = error, kernel, rest
        self._learn_trend(self.smooth, positions, power)

    def _learn_trend(self, kernel: Kernel, positions: np.ndarray, power: np.ndarray) -> None:
        factor = cho_factor(kernel.gram(positions), lower=True)
        self.level = power.mean(0)
        self.trend_weights = cho_solve(factor, power - self.level)
        inverse = cho_solve(factor, np.eye(len(positions)))
        self._left_out_powers = power - self.trend_weights / np.diag(inverse)[:, None]

    def _residuals(
        self, space: Lags, positions: np.ndarray, power: np.ndarray, targets: np.ndarray
    ) -> np.ndarray:
        """What the trend leaves of each image when it has not seen that image (n, H, W) float32."""
        left = np.empty((len(targets), *space.image), dtype=np.float32)
        for start in range(0, len(targets), BLOCK):
            rows = slice(start, start + BLOCK)
            said = self._draw(space, torch.from_numpy(positions[rows]).float(), self._left_out_powers[rows])
            left[rows] = (self._images(targets[rows]) - said).numpy()
        return left

    def _learn_rest(self, left: np.ndarray) -> None:
        self._factor = cho_factor(self.rest.gram(self.positions), lower=True)
        if self.components == 0:
            self.mean = torch.from_numpy(left.mean(0).ravel())
            self.axes = torch.zeros(0, len(self.mean))
            self.weights, self.lost = torch.zeros(len(left), 0, dtype=torch.float64), float(left.var())
        else:
            parts = components(left, self.components)
            self.weights = torch.from_numpy(cho_solve(self._factor, parts.scores))
            self.axes, self.mean = torch.from_numpy(parts.axes), torch.from_numpy(parts.mean)
            self.lost = parts.lost

    def _look_up(self, queries: np.ndarray) -> Prediction:
        space, power = self.lags(), self.powers_at(queries)
        said = self._draw(space, torch.from_numpy(queries).float(), power).reshape(len(queries), -1)
        cross = self.rest.cross(queries, self.positions)
        scores = (torch.from_numpy(cross) @ self.weights).float()
        mean = self._decode(said + torch.addmm(self.mean, scores, self.axes))
        prior = 1 + self.rest.noise
        left = np.clip(prior - (cross * cho_solve(self._factor, cross.T).T).sum(1), 0.0, prior)
        return Prediction(
            mean,
            confidence=torch.from_numpy(1 - left / prior).float(),
            variance=torch.from_numpy(self.rest.amplitude * left + self.lost).float(),
        )

    def size(self) -> int:
        """Number of sources."""
        return len(self.sources)

    def _draw(self, space: Lags, receivers: Tensor, power: np.ndarray) -> Tensor:
        """Images (n, H, W) of the sources' powers (n, K) at receivers (n, 3) [m]."""
        lags = mixed(torch.from_numpy(power).float(), self._atoms(space, receivers))
        image = space.spectrum(lags)
        return image.sqrt_() if self.exponent == 2 else image

    def _atoms(self, space: Lags, receivers: Tensor) -> Tensor:
        return space.atoms(bearings(self.sources, receivers, self.rotation()))

    def _images(self, targets: np.ndarray) -> Tensor:
        return torch.from_numpy(to_real(targets, "spectrum")).reshape(len(targets), *targets.shape[1:])

    def powers_at(self, places: np.ndarray) -> np.ndarray:
        """Power (n, K) of every source as its trend says, at places (n, 3) [m]."""
        return self.level + self.smooth.cross(places, self.positions) @ self.trend_weights

    def rotation(self) -> Tensor:
        """(3, 3) of the array, receiver to world."""
        assert self.site is not None and self.site.rx_rotation is not None
        return torch.from_numpy(np.asarray(self.site.rx_rotation)).float()

    def lags(self) -> Lags:
        """The array's, made once."""
        site = self.site
        assert site is not None and site.array is not None and site.grid is not None
        assert site.wavelength is not None
        if self._prepared is None:
            self._prepared = Lags(site.array, site.grid, site.wavelength)
        return self._prepared

    _prepared: Lags | None = None

    def _learned(self) -> dict[str, Any]:
        return {
            "sources": self.sources,
            "exponent": self.exponent,
            "level": torch.from_numpy(self.level),
            "trend_weights": torch.from_numpy(self.trend_weights),
            "smooth": [self.smooth.length, self.smooth.noise, self.smooth.amplitude],
            "rest": [self.rest.length, self.rest.noise, self.rest.amplitude],
            "positions": torch.from_numpy(self.positions),
            "mean": self.mean,
            "axes": self.axes,
            "weights": self.weights,
            "lost": self.lost,
        }

    def _relearn(self, state: dict[str, Any]) -> None:
        self._prepared = None
        self.sources, self.exponent = state["sources"], int(state["exponent"])
        self.level, self.trend_weights = state["level"].numpy(), state["trend_weights"].numpy()
        self.smooth, self.rest = (Kernel(*map(float, state[name])) for name in ("smooth", "rest"))
        self.positions, self.lost = state["positions"].numpy(), float(state["lost"])
        self.mean, self.axes, self.weights = state["mean"], state["axes"], state["weights"]
        self._factor = cho_factor(self.rest.gram(self.positions), lower=True)


def beyond(space: Lags, images: Tensor) -> tuple[int, float]:
    """Whether images (n, H, W) are amplitude (2) or power (1), and the share of energy no lags can make."""
    left = {}
    for exponent in (2, 1):
        power = images**exponent
        again = space.spectrum(space.of(power))
        left[exponent] = float((again - power).square().sum() / power.square().sum().clamp_min(1e-12))
    exponent = min(left, key=lambda e: left[e])
    return exponent, left[exponent]


def site_problem(data: Measurements) -> str | None:
    """Why bearings cannot be taken from these measurements; None when they can."""
    site = data.site
    if site.kind != "spectrum":
        return f"bearings need spectra, these are {site.kind}"
    if site.static_end != "tx":
        return "bearings need a moving receiver, here the transmitter moves (model=array is for that)"
    if site.array is None or site.grid is None or site.wavelength is None:
        return "the dataset does not say which array (array_position) and carrier its spectra are of"
    if not np.allclose(data.rx_rotation, data.rx_rotation[0], atol=1e-6):
        return "the receiver turns as it moves; bearings need one orientation"
    return None


def _left_out(kernel: Kernel, positions: np.ndarray, scores: np.ndarray) -> float:
    """Mean squared leave-one-out error of scores (n, P) under a kernel, per row."""
    factor = cho_factor(kernel.gram(positions), lower=True)
    inverse = cho_solve(factor, np.eye(len(positions)))
    return float(((cho_solve(factor, scores) / np.diag(inverse)[:, None]) ** 2).sum(1).mean())


def _spread(count: int, some: int) -> np.ndarray:
    """At most `some` of `count` rows, evenly."""
    return np.unique(np.linspace(0, count - 1, min(some, count)).round().astype(int))
