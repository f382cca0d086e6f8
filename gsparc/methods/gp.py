"""A Gaussian process on whole targets: one kernel shared by all entries, set by leave-one-out likelihood."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, eigh
from scipy.linalg.lapack import dtrtri
from scipy.optimize import minimize
from sklearn.gaussian_process.kernels import Matern
from torch import Tensor

from gsparc.data.schema import Kind, Measurements
from gsparc.methods.censored import silent
from gsparc.methods.coarse_grid import Filled
from gsparc.methods.covering import covering
from gsparc.methods.distance_law import Rows
from gsparc.methods.haste import CHOSEN_ON
from gsparc.methods.interpolation import Interpolator
from gsparc.methods.method import Method, Prediction
from gsparc.methods.nearest_targets import NearestTargets, learned, projected
from gsparc.methods.neighbourhood import NEIGHBOURS
from gsparc.methods.pareto import Settings
from gsparc.methods.power_kernel import PowerKernel
from gsparc.methods.power_process import (
    MEANS,
    MOST_ROWS,
    MeanName,
    PowerProcess,
    Process,
    approximated,
    conditioned,
    draw,
    exact,
    fit_powers,
    restored,
)
from gsparc.methods.reduced import View
from gsparc.methods.target_rows import entry_variance, from_real, to_real, training_targets
from gsparc.methods.worker import stop_when_late
from gsparc.ops import Pose


@dataclass(frozen=True)
class Components:
    """Principal components of n centred targets of D real numbers.

    Attributes:
        mean: (D,) float32, the mean target.
        axes: (P, D) float32, orthonormal rows.
        scores: (n, P) float64.
        lost: mean square per real number that the P components leave out.
    """

    mean: np.ndarray
    axes: np.ndarray
    scores: np.ndarray
    lost: float


def principal_components(targets: np.ndarray, kind: Kind, limit: int, block: int = 2048) -> Components:
    """All components, or the `limit` largest, of stored targets (n, ...) by the method of snapshots.

    Works through blocks of `block` entries, so that thousands of byte images never become floats at once.
    """
    n = len(targets)
    flat = targets.reshape(n, -1)
    blocks = [flat[:, i : i + block] for i in range(0, flat.shape[1], block)]
    means, gram, energy = [], np.zeros((n, n)), 0.0
    for part in blocks:
        rows = to_real(part, kind).astype(np.float64)
        means.append(rows.mean(0))
        rows -= means[-1]
        gram += rows @ rows.T
        energy += float((rows**2).sum())
    keep = max(1, min(limit, n - 1, sum(len(m) for m in means)))
    values, vectors = eigh(gram, subset_by_index=[n - keep, n - 1])
    solid = values > 1e-10 * max(values[-1], np.finfo(float).tiny)  # rounding noise has no axis
    if not solid.any():  # one sample, or all alike
        solid[-1] = True
    values, vectors = values[solid], vectors[:, solid]
    length = np.sqrt(np.maximum(values, np.finfo(float).tiny))
    axes = [(vectors / length).T @ (to_real(p, kind) - m) for p, m in zip(blocks, means, strict=True)]
    mean, scores = np.concatenate(means), vectors * np.sqrt(np.maximum(values, 0.0))
    lost = max(0.0, energy - float((scores**2).sum())) / (n * len(mean))
    return Components(mean.astype(np.float32), np.concatenate(axes, 1).astype(np.float32), scores, lost)


@dataclass(frozen=True)
class Kernel:
    """`amplitude * (Matern-3/2(distance / length) + noise * identity)`.

    Attributes:
        length: [m].
        noise: variance relative to `amplitude`.
        amplitude: variance per real number of a target.
    """

    length: float
    noise: float
    amplitude: float = 1.0

    def cross(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Correlations (A, B) without noise between positions (A, 3) and (B, 3) [m]."""
        return Matern(self.length, nu=1.5)(a, b)

    def gram(self, a: np.ndarray) -> np.ndarray:
        """Correlations (A, A) with noise."""
        matrix = self.cross(a, a)
        matrix[np.diag_indices_from(matrix)] += self.noise
        return matrix


def leave_one_out(gram: np.ndarray, scores: np.ndarray, entries: int) -> tuple[float, float]:
    """Negative leave-one-out log density per real number, and the amplitude that minimises it.

    With R = K^-1 Y and d = diag(K^-1) the left-out error of row i is R_i / d_i and its variance
    amplitude / d_i (Rasmussen and Williams 2006, eqs. 5.10 to 5.12, summed over outputs that share K).

    Args:
        gram: (n, n) correlations with noise.
        scores: (n, P) centred targets in an orthonormal basis.
        entries: real numbers per target, P or more.
    """
    factor = cholesky(gram, lower=True)
    inverse_diagonal = (dtrtri(factor, lower=1)[0] ** 2).sum(0)  # K^-1 = L^-T L^-1, without forming it
    squared = (cho_solve((factor, True), scores) ** 2).sum(1)
    amplitude = float((squared / inverse_diagonal).sum()) / (len(gram) * entries)
    amplitude = max(amplitude, np.finfo(float).tiny)
    return 0.5 * (np.log(amplitude) - float(np.log(inverse_diagonal).mean())), amplitude


def choose_kernel(positions: np.ndarray, scores: np.ndarray, entries: int) -> Kernel:
    """Length and noise of largest leave-one-out likelihood, from three starting lengths.

    Args:
        positions: (n, 3) [m].
        scores, entries: as in `leave_one_out`.
    """
    spread = float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
    if len(positions) < 3 or not scores.any():
        return Kernel(spread, 1e-2, max(float((scores**2).sum()) / (len(scores) * entries), 1e-12))

    def objective(log_parameters: np.ndarray) -> float:
        length, noise = np.exp(log_parameters)
        try:
            return leave_one_out(Kernel(length, noise).gram(positions), scores, entries)[0]
        except LinAlgError:  # not positive definite in float64: as bad as it gets
            return 1e12

    bounds = [(np.log(spread * 1e-4), np.log(spread * 1e2)), (np.log(1e-8), np.log(1e2))]
    # A coarse look picks the valley, the optimiser walks down it: each look factors an n x n matrix.
    starts = [np.log([spread * share, 0.01]) for share in (0.01, 0.05, 0.25)]
    pace = {"ftol": 1e-5, "maxfun": 60}  # seconds a look for thousands of rows; the figures move by 1e-4
    start = min(starts, key=objective)
    best = minimize(objective, start, method="L-BFGS-B", bounds=bounds, options=pace, callback=stop_when_late)
    length, noise = (float(value) for value in np.exp(best.x))
    return Kernel(length, noise, leave_one_out(Kernel(length, noise).gram(positions), scores, entries)[1])


class GaussianProcess(Interpolator):
    """Matern-3/2, isotropic, over the moving end's position; the mean target is subtracted.

    Powers are learned in decibels, with one or two lengths, about a constant or a distance law, and from rows
    where nothing was heard too (`gsparc.methods.power_process`).

    Args:
        components: largest number of principal components kept; all of them when the training set is smaller.
        mean: of powers: `constant`, `distance`, or `auto`, the one of larger leave-one-out likelihood.
    """

    name = "gp"
    stored = ("mean", "axes", "weights", "lost")
    uses_censored = True
    powers: Process | None = None  # None: not powers, or learned by an earlier version
    near: NearestTargets | None = None  # of rows too many for one factor

    def __init__(self, components: int = 512, mean: MeanName = "auto") -> None:
        if components < 1:
            raise ValueError(f"gp: components must be at least 1, got {components}")
        if mean not in MEANS:
            raise ValueError(f"gp: mean={mean!r} is none of {', '.join(MEANS)}")
        self.limit, self.about = components, mean

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        if self.kind == "rssi":
            return self._learn_censored(positions, targets, np.zeros(len(targets), bool))
        if len(targets) > MOST_ROWS:
            return self._learn_many(positions, targets)
        self.near = None
        thinned: list[str] = []
        parts = principal_components(targets, self.kind, self.limit)
        entries = len(parts.mean)
        looked_at: np.ndarray | slice = slice(None)
        if len(targets) > CHOSEN_ON:
            thinned.append(f"gp: settings chosen on {CHOSEN_ON} of {len(targets)} rows, drawn evenly")
            looked_at = draw(np.zeros(len(targets), bool), CHOSEN_ON, 0)
        self.kernel = choose_kernel(positions[looked_at], parts.scores[looked_at], entries)
        self.lost, self.positions = parts.lost, positions
        self.factor = cho_factor(self.kernel.gram(positions), lower=True)
        self.weights = torch.from_numpy(cho_solve(self.factor, parts.scores))
        self.mean, self.axes = torch.from_numpy(parts.mean), torch.from_numpy(parts.axes)
        found = self.kernel
        notes = [f"gp: length {found.length:.4g} m, noise {found.noise:.3g} of the signal's variance"]
        if parts.lost > 0 and len(parts.axes) == self.limit < len(targets) - 1:
            notes.append(f"gp: {self.limit} components kept, mean square left out {parts.lost:.2e}")
        return (*notes, *thinned)

    def _learn_many(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        """Of rows too many for one factor."""
        kept = covering(positions, CHOSEN_ON, 0)
        parts = principal_components(targets[kept], self.kind, self.limit)
        entries = len(parts.mean)
        start = choose_kernel(positions[kept], parts.scores, entries)
        scores, lost = projected(targets, self.kind, parts.mean, parts.axes)
        first = PowerKernel((start.length,), (1.0,), start.noise, 1.0)
        self.near, said = learned(positions, scores, lost, entries, first, 0)
        self.mean, self.axes = torch.from_numpy(parts.mean), torch.from_numpy(parts.axes)
        found = self.near.kernel
        basis = f"{len(parts.axes)} components of {len(kept)} rows, mean square left out {lost:.2e}"
        told_by = f"each query is predicted from the {NEIGHBOURS} nearest of {len(targets)} rows (Vecchia)"
        settings = f"length {found.lengths[0]:.4g} m, noise {found.noise:.3g} of the signal's variance"
        return tuple(f"gp: {note}" for note in (settings, said, told_by, basis))

    def _learn_censored(
        self, positions: np.ndarray, targets: np.ndarray, silent: np.ndarray
    ) -> tuple[str, ...]:
        assert self.site is not None
        rows = Rows(positions, to_real(targets, self.kind)[:, 0].astype(np.float64), silent)
        self.powers, notes = fit_powers(rows, self.site, self.about)
        return tuple(f"gp: {note}" for note in notes)

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        return approximated(self.name, self.powers or self.near)

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        return None if self.powers is None else exact(self.powers)

    def reconditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of powers alone."""
        if self.powers is None:
            return None
        decibels = to_real(training_targets(data, rows), "rssi")[:, 0].astype(np.float64)
        found = copy.copy(self)
        seen = Rows(data.moving[rows], decibels, silent(data, rows))
        found.powers, _ = conditioned(seen, self.powers.trend, self.powers.kernel, 0)
        return found

    def _look_up(self, queries: np.ndarray) -> Prediction:
        if self.powers is not None:
            decibels, spread, share = (torch.from_numpy(v) for v in self.powers.mean_and_variance(queries))
            power = self._decode(decibels[:, None].float())
            return Prediction(power, (1 - share).float(), entry_variance(spread.float(), power, self.kind))
        if self.near is not None:
            return self._look_up_near(self.near, torch.from_numpy(queries))
        cross = self.kernel.cross(queries, self.positions)
        scores = (torch.from_numpy(cross) @ self.weights).float()
        mean = self._decode(torch.addmm(self.mean, scores, self.axes))
        explained = (cross * cho_solve(self.factor, cross.T).T).sum(1)
        prior = 1 + self.kernel.noise
        left = np.clip(prior - explained, 0.0, prior)
        variance = torch.from_numpy(self.kernel.amplitude * left + self.lost).float()
        sure = torch.from_numpy(1 - left / prior).float()
        return Prediction(mean, sure, entry_variance(variance, mean, self.kind))

    @torch.no_grad()
    def _look_up_near(self, near: NearestTargets, queries: Tensor) -> Prediction:
        scores, left = near.at(queries)
        mean = self._decode(torch.addmm(self.mean, scores, self.axes))
        variance = (near.kernel.amplitude * left + near.lost).float()
        sure = (1 - left / (1 + near.kernel.noise)).float()
        return Prediction(mean, sure, entry_variance(variance, mean, self.kind))

    def mean_at(self, tx: Tensor, rx: Pose) -> Tensor:
        """The mean (B, ...) alone; see `Differentiable`. The variance is most of a prediction."""
        if self.powers is not None:
            return self._decode(self.powers.mean_at(self._queries(tx, rx))[:, None].float())
        if self.near is not None:
            return self._decode(torch.addmm(self.mean, self.near.at(self._queries(tx, rx))[0], self.axes))
        places = torch.from_numpy(self.positions)
        squared = (self._queries(tx, rx)[:, None] - places).square().sum(-1)
        far = squared.clamp_min(1e-24).sqrt() * (math.sqrt(3) / self.kernel.length)  # finite slope at 0
        scores = (((1 + far) * torch.exp(-far)) @ self.weights).float()
        return self._decode(torch.addmm(self.mean, scores, self.axes))

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`."""
        if self.powers is not None or self.near is not None:
            return ("confidence",)
        return ("keep", "confidence", *(("stride",) if self.kind == "spectrum" else ()))

    def contributions(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Nothing: what a component contributes stands in the process."""
        return {}

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`: the strongest components (`keep`, a share) on fewer pixels (`stride`)."""
        assert self.site is not None
        if set(settings) <= {"confidence"} and settings.get("confidence", True):
            return self
        if self.powers is not None or self.near is not None:
            return MeanAlone(self)
        stride, grid = int(settings.get("stride", 1)), self.site.grid
        count = max(1, math.ceil(float(settings.get("keep", 1.0)) * len(self.axes)))
        kept: Tensor | slice = slice(
            None
        )  # a view: the axes of thousands of images are hundreds of megabytes
        if count < len(self.axes):
            kept = self.weights.square().sum(0).topk(count).indices
        mean, axes, shape = self.mean, self.axes[kept], self.shape
        if stride > 1:
            assert grid is not None
            parts = [part.unflatten(-1, shape)[..., ::stride, ::stride] for part in (mean, axes)]
            shape = tuple(parts[0].shape)
            mean, axes = (part.flatten(-2).contiguous() for part in parts)
        lean = ReducedMean(self, mean, axes, self.weights[:, kept], shape)
        return Filled(lean, grid, stride) if stride > 1 and grid is not None else lean

    def _learned(self) -> dict[str, Any]:
        if self.powers is not None:
            return {"powers": self.powers.state()}
        if self.near is not None:
            return {"near": self.near.state(), "mean": self.mean, "axes": self.axes}
        kernel = [self.kernel.length, self.kernel.noise, self.kernel.amplitude]
        return {**super()._learned(), "positions": torch.from_numpy(self.positions), "kernel": kernel}

    def _relearn(self, state: dict[str, Any]) -> None:
        self.powers = restored(state["powers"]) if "powers" in state else None
        self.near = NearestTargets.of(state["near"]) if "near" in state else None
        if self.powers is not None:
            return
        if self.near is not None:
            self.mean, self.axes = state["mean"], state["axes"]
            return
        super()._relearn(state)
        self.kernel = Kernel(*(float(v) for v in state["kernel"]))
        self.positions = state["positions"].numpy()
        self.factor = cho_factor(self.kernel.gram(self.positions), lower=True)


class MeanAlone(View):
    """The mean, without its variance."""

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        assert isinstance(self.inner, GaussianProcess)
        return Prediction(self.inner.mean_at(tx, rx))


class ReducedMean(View):
    """The mean of a Gaussian process, without its variance.

    Args:
        inner: fitted.
        mean, axes: (P,) and (C, P), the basis of targets.
        weights: (n, C), so that scores are `kernel(query, places) @ weights`.
        shape: of a target.
    """

    def __init__(
        self, inner: GaussianProcess, mean: Tensor, axes: Tensor, weights: Tensor, shape: tuple[int, ...]
    ) -> None:
        super().__init__(inner)
        assert inner.site is not None
        self._kind, self._site, self._shape = inner.site.kind, inner.site, shape
        self._mean, self._axes, self._weights = mean, axes, weights.float().contiguous()
        self._middle = torch.from_numpy(inner.positions.mean(0)).float()
        self._scale = math.sqrt(3) / inner.kernel.length
        self._places = (torch.from_numpy(inner.positions).float() - self._middle) * self._scale

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; Matern-3/2 as in `Kernel`, in float32."""
        where = self._site.moving(tx, rx).expand(len(tx), -1)
        query = (where - self._middle) * self._scale
        far = torch.linalg.vector_norm(query[:, None] - self._places, dim=-1)  # cdist: three times slower
        scores = ((1 + far) * torch.exp(-far)) @ self._weights
        return Prediction(from_real(torch.addmm(self._mean, scores, self._axes), self._kind, self._shape))

    def size(self) -> int:
        """Components kept."""
        return len(self._axes)
