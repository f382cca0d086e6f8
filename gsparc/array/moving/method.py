"""Spectra of a moving array as a method: sources, their powers as a smooth trend, a process for the rest.

The trend moves directions of arrival with the receiver, which interpolating images cannot; the process on
what the trend leaves (interference, shadow edges) is the Gaussian process that serves as our rival, given
that trend (universal kriging; Matheron 1969). Images of several searches are averaged.
"""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from gsparc.array.moving.compress import components
from gsparc.array.moving.error_model import Doubt, Looks, learn_doubt
from gsparc.array.moving.power_gp import Trend, TrendSettings, learn_trend
from gsparc.array.moving.reduce import reduced
from gsparc.array.moving.triangulate import SearchSettings, bearings, find_sources, mixed, powers
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.methods.gp import Kernel, choose_kernel
from gsparc.methods.interpolation import Interpolator
from gsparc.methods.method import FitContext, FitReport, Method, Prediction, PredictsVariance
from gsparc.methods.pareto import Settings
from gsparc.methods.target_rows import to_real
from gsparc.physics.lags import BLOCK, Lags

log = logging.getLogger(__name__)

CHOOSING = 128  # components that kernels are chosen with
POOR = 0.02  # share of the energy that lags may leave of a spectrum that the array really measured
LEAST_GAIN = 0.005  # of the left-out error: searches end when the last of them gained less
PATIENCE = 3
LAST = 0.8  # share of a budget after which no search may end


class BearingField(Interpolator, PredictsVariance):
    """Sources seen through the receiver's array.

    With `trainer.budget_s` it searches while that is not spent and helps.

    Args:
        search: how sources are found.
        trend: how smooth their powers are.
        searches: how often, without a budget.
        rest_rows: that the kernel of the rest is chosen on; seconds grow with their cube.
        components: largest number of principal components of what the trends leave; 0: the trends alone.
        seed: of the first search; the others have the next ones.
        name: as it appears in tables.
    """

    effects = "moving_array"

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
        self._budget_s: float | None = None

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Find sources, learn their powers and what they leave.

        Raises:
            ValueError: not spectra of a moving receiver with a declared array that keeps its orientation.
        """
        problem = site_problem(data)
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        self._budget_s = context.budget_s
        return super().fit(data, fold, context)

    def explains(self, data: Measurements, rows: np.ndarray, seed: int) -> tuple[bool, str]:
        """See `Explains`."""
        return explained_by_lags(data, rows)

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`; searches where there are several."""
        own = ("keep", "stride", "confidence")
        return ("searches", *own) if len(self.trends) > 1 else own

    def contributions(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Nothing: what a component contributes stands in the process."""
        return {}

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`."""
        return reduced(self, settings)

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        begin = time.perf_counter()
        space = self.lags()
        self.positions = positions
        self.exponent, lags = self._lags(space, targets)
        budget_s, longest = self._budget_s, 0.0
        drawn = np.zeros((len(targets), *space.image), dtype=np.float32)  # sum over searches, each row unseen
        self.trends, errors = [], []
        while True:
            start = time.perf_counter()
            trend, left_out = self._search(space, lags, positions, targets)
            self._add(space, trend.sources, left_out, drawn)
            self.trends.append(trend)
            errors.append(self._judge(positions, targets, drawn))
            now = time.perf_counter()
            longest = max(longest, now - start)
            log.info(
                "%s: search %d, %d sources, trend %.3g m, left-out error %.4g, %.0f s",
                self.name, len(errors), len(trend.sources), trend.kernel.length, errors[-1], now - begin,
            )  # fmt: skip
            if budget_s is None and len(errors) == self.searches:
                break
            if budget_s is not None and (now - begin + longest > LAST * budget_s or _settled(errors)):
                break
        drawn /= -len(self.trends)
        left = self._images_less(targets, drawn)
        rows = _spread(len(left), self.rest_rows)
        self.rest = _explained(positions[rows], left[rows])[1]
        self._learn_rest(left, targets)
        note = f"{self.name}: {len(self.trends)} searches, {self.size()} sources, left-out error " + " ".join(
            f"{error:.4g}" for error in errors
        )
        rest = f"{self.rest.length:.3g} m and noise {self.rest.noise:.3g}, chosen on {len(rows)} rows"
        return (note, f"{self.name}: rest {rest}")

    def _search(
        self, space: Lags, lags: Tensor, positions: np.ndarray, targets: np.ndarray
    ) -> tuple[Trend, np.ndarray]:
        """The next search's trend, and the powers (n, K) it says of each row without that row."""
        assert self.site is not None and self.site.grid is not None
        receivers = torch.from_numpy(positions).float()
        rows = _spread(len(targets), self.search.rows)
        still = self.site.static_position
        first = None if still is None else torch.from_numpy(np.asarray(still)).float()
        sources = find_sources(
            lags[rows], receivers[rows], first, self.rotation(), space, self.site.grid, self.search,
            self.seed + len(self.trends),
        )  # fmt: skip
        power = torch.cat([
            powers(part, self._atoms(space, sources, some), self.search.ridge)
            for part, some in zip(lags.split(BLOCK), receivers.split(BLOCK), strict=True)
        ]).double().numpy()  # fmt: skip
        kernel = self._choose(space, sources, positions, power, targets)
        return learn_trend(sources, kernel, positions, power)

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

    def _choose(
        self, space: Lags, sources: Tensor, positions: np.ndarray, power: np.ndarray, targets: np.ndarray
    ) -> Kernel:
        """Kernel of a trend, by leaving out rows one at a time."""
        rows = _spread(len(positions), self.trend.rows)
        diagonal = float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
        errors = {}
        for length in self.trend.lengths:
            kernel = Kernel(length * diagonal, self.trend.noise)
            said = learn_trend(sources, kernel, positions[rows], power[rows])[1]
            drawn = np.zeros((len(rows), *space.image), dtype=np.float32)
            self._add(space, sources, said, drawn, positions[rows])
            errors[kernel] = _explained(positions[rows], self._images_less(targets[rows], -drawn))[0]
        return min(errors, key=lambda kernel: errors[kernel])

    def _judge(self, positions: np.ndarray, targets: np.ndarray, drawn: np.ndarray) -> float:
        """Left-out error (mean square) of all searches so far together."""
        rows = _spread(len(positions), self.trend.rows)
        left = self._images_less(targets[rows], drawn[rows] / -len(self.trends))
        return _explained(positions[rows], left)[0]

    def _add(
        self,
        space: Lags,
        sources: Tensor,
        power: np.ndarray,
        drawn: np.ndarray,
        places: np.ndarray | None = None,
    ) -> None:
        """Add to images (n, H, W) those of sources of powers (n, K) at places (n, 3), all rows by default."""
        places = self.positions if places is None else places
        for start in range(0, len(drawn), BLOCK):
            rows = slice(start, start + BLOCK)
            receivers = torch.from_numpy(places[rows]).float()
            drawn[rows] += self._draw(space, sources, receivers, power[rows]).numpy()

    def _images_less(self, targets: np.ndarray, minus: np.ndarray) -> np.ndarray:
        """Targets plus `minus` (n, H, W) float32, in place of `minus`: images of thousands exist once."""
        for start in range(0, len(targets), BLOCK):
            rows = slice(start, start + BLOCK)
            minus[rows] += self._images(targets[rows]).numpy()
        return minus

    def _learn_rest(self, left: np.ndarray, targets: np.ndarray) -> None:
        """The process of what the trends leave (n, H, W), and how wrong both together are where."""
        self._factor = cho_factor(self.rest.gram(self.positions), lower=True)
        if self.components == 0:
            self.mean = torch.from_numpy(left.mean(0).ravel())
            self.axes, scores = torch.zeros(0, len(self.mean)), np.zeros((len(left), 0))
        else:
            parts = components(left, self.components)
            self.axes, self.mean, scores = (
                torch.from_numpy(parts.axes),
                torch.from_numpy(parts.mean),
                parts.scores,
            )
        weights = cho_solve(self._factor, scores)
        self.weights = torch.from_numpy(weights)
        spread = 1 / np.diag(
            cho_solve(self._factor, np.eye(len(left)))
        )  # left-out variance, over the amplitude
        said = torch.from_numpy(scores - weights * spread[:, None]).float()
        error, looks = np.empty(len(left)), []
        for start in range(0, len(left), BLOCK):
            rows = slice(start, start + BLOCK)
            image = self._images(targets[rows]).flatten(1)
            added = torch.addmm(self.mean, said[rows], self.axes)
            found = (image - torch.from_numpy(left[rows]).flatten(1) + added).clamp_(0, 1)
            error[rows] = ((found - image).square().sum(1) / image.square().sum(1).clamp_min(1e-12)).numpy()
            looks.append(_looks(spread[rows], found, added))
        self.doubt = learn_doubt(self.positions, error, _joined(looks))

    def _look_up(self, queries: np.ndarray) -> Prediction:
        space, receivers = self.lags(), torch.from_numpy(queries).float()
        drawn = torch.zeros(len(queries), space.image[0] * space.image[1])
        for trend in self.trends:
            power = trend.powers_at(queries, self.positions)
            drawn += self._draw(space, trend.sources, receivers, power).flatten(1)
        cross = self.rest.cross(queries, self.positions)
        added = torch.addmm(self.mean, (torch.from_numpy(cross) @ self.weights).float(), self.axes)
        mean = self._decode(drawn.div_(len(self.trends)).add_(added))
        prior = 1 + self.rest.noise
        left = np.clip(prior - (cross * cho_solve(self._factor, cross.T).T).sum(1), 1e-9, prior)
        relative = torch.from_numpy(
            self.doubt.relative_error(queries, _looks(left, mean.flatten(1), added))
        ).float()
        return Prediction(
            mean,
            confidence=1 / (1 + relative),
            variance=relative * mean.square().flatten(1).mean(1),
        )

    def size(self) -> int:
        """Number of sources of all searches."""
        return sum(len(trend.sources) for trend in self.trends)

    def _draw(self, space: Lags, sources: Tensor, receivers: Tensor, power: np.ndarray) -> Tensor:
        """Images (n, H, W) of sources of powers (n, K) at receivers (n, 3) [m]."""
        lags = mixed(torch.from_numpy(power).float(), self._atoms(space, sources, receivers))
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
            "trends": [trend.state() for trend in self.trends],
            "exponent": self.exponent,
            "rest": [self.rest.length, self.rest.noise, self.rest.amplitude],
            "positions": torch.from_numpy(self.positions),
            "mean": self.mean,
            "axes": self.axes,
            "weights": self.weights,
            "doubt": self.doubt.state(),
        }

    def _relearn(self, state: dict[str, Any]) -> None:
        self._prepared = None
        self.trends = [Trend.from_state(trend) for trend in state["trends"]]
        self.exponent, self.rest = int(state["exponent"]), Kernel(*map(float, state["rest"]))
        self.positions, self.doubt = state["positions"].numpy(), Doubt.from_state(state["doubt"])
        self.mean, self.axes, self.weights = state["mean"], state["axes"], state["weights"]
        self._factor = cho_factor(self.rest.gram(self.positions), lower=True)


def explained_by_lags(data: Measurements, rows: np.ndarray) -> tuple[bool, str]:
    """Whether the moving array can have measured the images of rows (n,), by the energy it cannot."""
    problem, site = site_problem(data), data.site
    if problem is not None:
        return False, problem
    assert site.array is not None and site.grid is not None and site.wavelength is not None
    images = torch.from_numpy(to_real(data.target[rows], site.kind)).reshape(data.target[rows].shape)
    _, left = beyond(Lags(site.array, site.grid, site.wavelength), images)
    return left <= POOR, f"{left:.1%} of the energy of {len(rows)} probed images is beyond the moving array"


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


def _explained(positions: np.ndarray, left: np.ndarray) -> tuple[float, Kernel]:
    """Left-out mean square of images (n, H, W) under the kernel of largest likelihood, and that kernel.

    Rasmussen and Williams (2006), eq. 5.12.
    """
    parts = components(left, CHOOSING)
    kernel = choose_kernel(positions, parts.scores, len(parts.mean))
    factor = cho_factor(kernel.gram(positions), lower=True)
    inverse = cho_solve(factor, np.eye(len(positions)))
    missed = (cho_solve(factor, parts.scores) / np.diag(inverse)[:, None]) ** 2
    return float(missed.sum(1).mean()) / len(parts.mean) + parts.lost, kernel


def _settled(errors: list[float]) -> bool:
    """Whether the last search gained next to nothing."""
    return len(errors) > 1 and errors[-1] > (1 - LEAST_GAIN) * errors[-2]


def _looks(left: np.ndarray, image: Tensor, added: Tensor) -> Looks:
    """Of images (n, P) and what the process added to them (n, P); `left` (n,) is its relative variance."""
    return Looks(
        left,
        image.mean(1).double().numpy(),
        image.amax(1).double().numpy(),
        added.square().mean(1).double().numpy(),
    )


def _joined(parts: list[Looks]) -> Looks:
    names = ("left", "mean", "peak", "added")
    return Looks(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _spread(count: int, some: int) -> np.ndarray:
    """At most `some` of `count` rows, evenly."""
    return np.unique(np.linspace(0, count - 1, min(some, count)).round().astype(int))
