"""`model=moving_array`: sources, their powers as smooth trends, a Gaussian process on residual spectra.

The trend moves directions of arrival with the receiver, which interpolating images cannot; the residual
(interference, shadow boundaries) goes to the Gaussian process on images of `gsparc.methods.gp` (universal
kriging; Matheron 1969). Images of several searches are averaged.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from gsparc.array.moving import reduce
from gsparc.array.moving.compress import components
from gsparc.array.moving.error_model import ErrorModel, fit_error_model, image_features
from gsparc.array.moving.power_gp import Trend, TrendSettings, fit_trend
from gsparc.array.moving.triangulate import SearchSettings, bearings, find_sources, mixture, powers
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.methods.gp import Kernel, choose_kernel
from gsparc.methods.interpolation import Interpolator
from gsparc.methods.method import FitContext, FitReport, Prediction, PredictsVariance
from gsparc.methods.target_rows import to_real
from gsparc.methods.time_budget import TimeBudget
from gsparc.physics.lags import BLOCK, Lags

log = logging.getLogger(__name__)

KERNEL_COMPONENTS = 128  # principal components that kernels are chosen on
MAX_UNEXPLAINED = 0.02  # share of energy outside the array's lags, above which it measured no such spectrum
MIN_GAIN = 0.005  # of the leave-one-out error: searches end when the last one gained less
BUDGET_SHARE = 0.8  # of the budget, by which the last search must end


class MovingArrayField(Interpolator, PredictsVariance):
    """Triangulated sources seen through the receiver's array, and a Gaussian process on the residual images.

    With `trainer.budget_s` it searches until the budget is spent or the leave-one-out error stops falling.

    Args:
        search: how sources are found.
        trend: how smooth their powers are.
        searches: number, without a budget.
        rest_rows: that the residual's kernel is chosen on; seconds grow with their cube.
        components: largest number of principal components of the residual; 0: the trends alone.
        seed: of the first search; the others have the next ones.
        name: as it appears in tables.
    """

    effects = "moving_array"
    takes_budget = True

    def __init__(
        self,
        search: SearchSettings | None = None,
        trend: TrendSettings | None = None,
        searches: int = 1,
        rest_rows: int = 1500,
        components: int = 512,
        seed: int = 0,
        name: str = "moving_array",
    ) -> None:
        super().__init__()
        if searches < 1 or rest_rows < 3:
            raise ValueError(
                f"{name}: model.searches={searches}, model.rest_rows={rest_rows}: expected at least 1 and 3"
            )
        self.search, self.trend = search or SearchSettings(), trend or TrendSettings()
        self.searches, self.rest_rows, self.components = searches, rest_rows, components
        self.seed, self.name = seed, name
        self.trends: list[Trend] = []
        self._budget = TimeBudget()

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Find sources, fit their powers and the residual.

        Raises:
            ValueError: not spectra of a moving receiver with a declared array that keeps its orientation.
        """
        problem = site_problem(data)
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        self._budget = context.time_budget()
        return replace(super().fit(data, fold, context), limited_by=self._budget.limited_by)

    def explains(self, data: Measurements, rows: np.ndarray, seed: int) -> tuple[bool, str]:
        """See `Explains`."""
        problem, site = site_problem(data), data.site
        if problem is not None:
            return False, problem
        images = torch.from_numpy(to_real(data.target[rows], site.kind)).reshape(data.target[rows].shape)
        _, residual = unexplained_energy(Lags(*site.array_geometry()), images)
        share = f"{residual:.1%} of the energy of {len(rows)} probed images"
        return residual <= MAX_UNEXPLAINED, f"{share} is outside the moving array's lags"

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`; searches where there are several."""
        own = ("keep", "stride", "confidence")
        return ("searches", *own) if len(self.trends) > 1 else own

    def contributions(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Nothing: the process itself holds what each component contributes."""
        return {}

    reduced = reduce.reduced

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        begin = time.perf_counter()
        space = self.lags()
        self.positions = positions
        self.exponent, lags = self._lags(space, targets)
        budget, longest = self._budget, 0.0
        # sum over searches of leave-one-out images
        modelled = np.zeros((len(targets), *space.image), dtype=np.float32)
        self.trends, errors = [], []
        while True:
            start = time.perf_counter()
            trend, left_out = self._search(space, lags, positions, targets)
            self._add_images(space, trend.sources, left_out, modelled, positions)
            self.trends.append(trend)
            errors.append(self._left_out_error(positions, targets, modelled))
            now = time.perf_counter()
            longest = max(longest, now - start)
            log.info(
                "%s: search %d, %d sources, trend length %.3g m, leave-one-out error %.4g, %.0f s",
                self.name, len(errors), len(trend.sources), trend.kernel.length, errors[-1], now - begin,
            )  # fmt: skip
            if budget.seconds == math.inf:
                done = len(errors) == self.searches
            else:
                late = budget.over(BUDGET_SHARE - longest / budget.seconds)
                done = late or (len(errors) > 1 and errors[-1] > (1 - MIN_GAIN) * errors[-2])
            if done:
                break
        modelled /= -len(self.trends)
        residual = self._add_targets(targets, modelled)
        rows = _spread(len(residual), self.rest_rows)
        self.residual_kernel = _residual_error(positions[rows], residual[rows])[1]
        self._fit_residual(residual, targets)
        note = f"{self.name}: {len(self.trends)} searches, {self.size()} sources, leave-one-out error "
        note += " ".join(f"{error:.4g}" for error in errors)
        kernel = self.residual_kernel
        fitted = f"length {kernel.length:.3g} m and noise {kernel.noise:.3g}, chosen on {len(rows)} rows"
        return (note, f"{self.name}: residual of {fitted}")

    def _search(
        self, space: Lags, lags: Tensor, positions: np.ndarray, targets: np.ndarray
    ) -> tuple[Trend, np.ndarray]:
        """The next search's trend, and its leave-one-out powers (n, K)."""
        assert self.site is not None and self.site.grid is not None
        receivers = torch.from_numpy(positions).float()
        rows = _spread(len(targets), self.search.rows)
        static = self.site.static_position
        first = None if static is None else torch.from_numpy(np.asarray(static)).float()
        sources = find_sources(
            lags[rows], receivers[rows], first, self.rotation(), space, self.site.grid, self.search,
            self.seed + len(self.trends),
        )  # fmt: skip
        power = torch.cat([
            powers(part, self._atoms(space, sources, places), self.search.ridge)
            for part, places in zip(lags.split(BLOCK), receivers.split(BLOCK), strict=True)
        ]).double().numpy()  # fmt: skip
        kernel = self._choose_kernel(space, sources, positions, power, targets)
        return fit_trend(sources, kernel, positions, power)

    def _lags(self, space: Lags, targets: np.ndarray) -> tuple[int, Tensor]:
        """Whether pixels are amplitude (2) or power (1), and the lags (n, Q) of all spectra.

        Raises:
            ValueError: neither is a spectrum of the declared array.
        """
        exponent, residual = unexplained_energy(space, self._images(targets[_spread(len(targets), 16)]))
        if residual > MAX_UNEXPLAINED:
            raise ValueError(
                f"{self.name}: the declared array cannot have measured these spectra "
                f"({residual:.0%} of their energy is outside its lags)"
            )
        parts = [
            space.of(self._images(targets[i : i + BLOCK]) ** exponent) for i in range(0, len(targets), BLOCK)
        ]
        return exponent, torch.cat(parts)

    def _choose_kernel(
        self, space: Lags, sources: Tensor, positions: np.ndarray, power: np.ndarray, targets: np.ndarray
    ) -> Kernel:
        """Kernel of a trend, by leave-one-out error."""
        rows = _spread(len(positions), self.trend.rows)
        diagonal = float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
        errors = {}
        for length in self.trend.lengths:
            kernel = Kernel(length * diagonal, self.trend.noise)
            predicted = fit_trend(sources, kernel, positions[rows], power[rows])[1]
            modelled = np.zeros((len(rows), *space.image), dtype=np.float32)
            self._add_images(space, sources, predicted, modelled, positions[rows])
            errors[kernel] = _residual_error(positions[rows], self._add_targets(targets[rows], -modelled))[0]
        return min(errors, key=lambda kernel: errors[kernel])

    def _left_out_error(self, positions: np.ndarray, targets: np.ndarray, modelled: np.ndarray) -> float:
        """Leave-one-out error (mean square) of all searches so far together."""
        rows = _spread(len(positions), self.trend.rows)
        residual = self._add_targets(targets[rows], modelled[rows] / -len(self.trends))
        return _residual_error(positions[rows], residual)[0]

    def _add_images(
        self, space: Lags, sources: Tensor, power: np.ndarray, modelled: np.ndarray, places: np.ndarray
    ) -> None:
        """Add to images (n, H, W) those of sources of powers (n, K) at places (n, 3)."""
        for start in range(0, len(modelled), BLOCK):
            rows = slice(start, start + BLOCK)
            receivers = torch.from_numpy(places[rows]).float()
            modelled[rows] += self._render(space, sources, receivers, power[rows]).numpy()

    def _add_targets(self, targets: np.ndarray, minus: np.ndarray) -> np.ndarray:
        """Targets plus `minus` (n, H, W) float32, written to `minus`: one copy of thousands of images."""
        for start in range(0, len(targets), BLOCK):
            rows = slice(start, start + BLOCK)
            minus[rows] += self._images(targets[rows]).numpy()
        return minus

    def _fit_residual(self, residual: np.ndarray, targets: np.ndarray) -> None:
        """The process on residual images (n, H, W), and the error model of the sum."""
        self._factor = cho_factor(self.residual_kernel.gram(self.positions), lower=True)
        if self.components == 0:
            self.mean = torch.from_numpy(residual.mean(0).ravel())
            self.axes, scores = torch.zeros(0, len(self.mean)), np.zeros((len(residual), 0))
        else:
            parts = components(residual, self.components)
            self.axes, self.mean = torch.from_numpy(parts.axes), torch.from_numpy(parts.mean)
            scores = parts.scores
        weights = cho_solve(self._factor, scores)
        self.weights = torch.from_numpy(weights)
        # leave-one-out variance, over the amplitude
        spread = 1 / np.diag(cho_solve(self._factor, np.eye(len(residual))))
        predicted = torch.from_numpy(scores - weights * spread[:, None]).float()
        error, features = np.empty(len(residual)), []
        for start in range(0, len(residual), BLOCK):
            rows = slice(start, start + BLOCK)
            image = self._images(targets[rows]).flatten(1)
            added = torch.addmm(self.mean, predicted[rows], self.axes)
            found = (image - torch.from_numpy(residual[rows]).flatten(1) + added).clamp_(0, 1)
            error[rows] = ((found - image).square().sum(1) / image.square().sum(1).clamp_min(1e-12)).numpy()
            features.append(image_features(spread[rows], found, added))
        self.error_model = fit_error_model(self.positions, error, np.concatenate(features))

    def _look_up(self, queries: np.ndarray) -> Prediction:
        space, receivers = self.lags(), torch.from_numpy(queries).float()
        modelled = torch.zeros(len(queries), space.image[0] * space.image[1])
        for trend in self.trends:
            power = trend.powers_at(queries, self.positions)
            modelled += self._render(space, trend.sources, receivers, power).flatten(1)
        cross = self.residual_kernel.cross(queries, self.positions)
        added = torch.addmm(self.mean, (torch.from_numpy(cross) @ self.weights).float(), self.axes)
        mean = self._decode(modelled.div_(len(self.trends)).add_(added))
        prior = 1 + self.residual_kernel.noise
        variance = np.clip(prior - (cross * cho_solve(self._factor, cross.T).T).sum(1), 1e-9, prior)
        features = image_features(variance, mean.flatten(1), added)
        relative = torch.from_numpy(self.error_model.relative_error(queries, features)).float()
        return Prediction(mean, 1 / (1 + relative), relative * mean.square().flatten(1).mean(1))

    def size(self) -> int:
        """Number of sources of all searches."""
        return sum(len(trend.sources) for trend in self.trends)

    def _render(self, space: Lags, sources: Tensor, receivers: Tensor, power: np.ndarray) -> Tensor:
        """Images (n, H, W) of sources of powers (n, K) at receivers (n, 3) [m]."""
        lags = mixture(torch.from_numpy(power).float(), self._atoms(space, sources, receivers))
        image = space.spectrum(lags)
        return image.sqrt_() if self.exponent == 2 else image

    def _atoms(self, space: Lags, sources: Tensor, receivers: Tensor) -> Tensor:
        return space.atoms(bearings(sources, receivers, self.rotation()))

    def _images(self, targets: np.ndarray) -> Tensor:
        return torch.from_numpy(to_real(targets, "spectrum")).reshape(len(targets), *targets.shape[1:])

    def rotation(self) -> Tensor:
        """(3, 3) of the array, receiver to world."""
        assert self.site is not None and self.site.rx_rotation is not None
        return torch.from_numpy(np.asarray(self.site.rx_rotation)).float()

    def lags(self) -> Lags:
        """The array's, computed once."""
        assert self.site is not None
        if self._prepared is None:
            self._prepared = Lags(*self.site.array_geometry())
        return self._prepared

    _prepared: Lags | None = None

    def _learned(self) -> dict[str, Any]:
        return {
            "trends": [trend.state() for trend in self.trends],
            "exponent": self.exponent,
            "rest": [*vars(self.residual_kernel).values()],
            "positions": torch.from_numpy(self.positions),
            "mean": self.mean,
            "axes": self.axes,
            "weights": self.weights,
            "doubt": self.error_model.state(),
        }

    def _relearn(self, state: dict[str, Any]) -> None:
        self._prepared = None
        self.trends = [Trend.from_state(trend) for trend in state["trends"]]
        self.exponent, self.residual_kernel = int(state["exponent"]), Kernel(*map(float, state["rest"]))
        self.positions, self.error_model = state["positions"].numpy(), ErrorModel.from_state(state["doubt"])
        self.mean, self.axes, self.weights = state["mean"], state["axes"], state["weights"]
        self._factor = cho_factor(self.residual_kernel.gram(self.positions), lower=True)


def unexplained_energy(space: Lags, images: Tensor) -> tuple[int, float]:
    """Whether images (n, H, W) are amplitude (2) or power (1), and the share of energy outside the lags."""
    residual = {}
    for exponent in (2, 1):
        power = images**exponent
        again = space.spectrum(space.of(power))
        residual[exponent] = float((again - power).square().sum() / power.square().sum().clamp_min(1e-12))
    exponent = min(residual, key=lambda e: residual[e])
    return exponent, residual[exponent]


def site_problem(data: Measurements) -> str | None:
    """Why sources cannot be triangulated from these measurements; None when they can."""
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


def _residual_error(positions: np.ndarray, residual: np.ndarray) -> tuple[float, Kernel]:
    """Leave-one-out mean square of images (n, H, W) under the kernel of largest likelihood, and that kernel.

    Rasmussen and Williams (2006), eq. 5.12.
    """
    parts = components(residual, KERNEL_COMPONENTS)
    kernel = choose_kernel(positions, parts.scores, len(parts.mean))
    factor = cho_factor(kernel.gram(positions), lower=True)
    inverse = cho_solve(factor, np.eye(len(positions)))
    missed = (cho_solve(factor, parts.scores) / np.diag(inverse)[:, None]) ** 2
    return float(missed.sum(1).mean()) / len(parts.mean) + parts.lost, kernel


def _spread(count: int, limit: int) -> np.ndarray:
    """At most `limit` of `count` rows, evenly."""
    return np.unique(np.linspace(0, count - 1, min(limit, count)).round().astype(int))
