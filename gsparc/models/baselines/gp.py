"""A Gaussian process on whole targets: one kernel shared by all entries,
set by leave-one-out likelihood.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg import eigh
from torch import Tensor

from gsparc.base.limits import check_arguments, choice, whole
from gsparc.data.blocks import row_blocks
from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.target import Target
from gsparc.models.baselines.interpolation import Differentiable
from gsparc.models.baselines.likeliest import CHOSEN_ON, MEANS, MeanName, fit_power_process
from gsparc.models.closed_form import ClosedForm
from gsparc.models.method import Method, Prediction
from gsparc.models.reduced import Interpolated, MeanOnly, Settings
from gsparc.models.target_rows import power_rows, training_targets
from gsparc.physics.separable import Separable, separate_axes
from gsparc.processes.density import TINY
from gsparc.processes.few_rows import covering_rows, sample_row_numbers
from gsparc.processes.fit_kernel import choose_left_out_kernel
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import PlaceValues, choose_kernel_by_nearest, condition_on_nearest
from gsparc.processes.neighbourhood import NEIGHBOURS
from gsparc.processes.posterior import Exact, Posterior, approximation_label
from gsparc.processes.powers import (
    MOST_ROWS,
    PowerProcess,
    PowerRows,
    condition_on_powers,
)
from gsparc.processes.prior import Prior

LOOKED_AT = 600  # rows that tell the strongest components
STRONGEST = 32  # components that they are chosen by
FINER = 0.01  # of the share that components leave out, what their numbers by rows and columns may
ROUNDING = 1e-10  # of the largest eigenvalue, below which one is of no axis


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


def principal_components(
    targets: np.ndarray, target: Target, limit: int, block: int = 2048
) -> Components:
    """Return all components, or the `limit` largest, of stored targets (n, ...)
    by the method of snapshots.

    Works through blocks of `block` entries, so that thousands
    of byte images never become floats at once.
    """
    n = len(targets)
    flat = targets.reshape(n, -1)
    blocks = [flat[:, i : i + block] for i in range(0, flat.shape[1], block)]
    means, gram, energy = [], np.zeros((n, n)), 0.0
    for part in blocks:
        rows = target.to_real(part).astype(np.float64)
        means.append(rows.mean(0))
        rows -= means[-1]
        gram += rows @ rows.T
        energy += float((rows**2).sum())
    # n centred rows span n - 1 directions.
    keep = max(1, min(limit, n - 1, sum(len(m) for m in means)))
    values, vectors = eigh(gram, subset_by_index=[n - keep, n - 1])
    solid = values > ROUNDING * max(values[-1], TINY)
    if not solid.any():  # one sample, or all alike
        solid[-1] = True
    values, vectors = values[solid], vectors[:, solid]
    length = np.sqrt(np.maximum(values, TINY))
    axes = [
        (vectors / length).T @ (target.to_real(p) - m) for p, m in zip(blocks, means, strict=True)
    ]
    mean, scores = np.concatenate(means), vectors * np.sqrt(np.maximum(values, 0.0))
    # A small difference of large sums may round below 0.
    residual = max(0.0, energy - float((scores**2).sum())) / (n * len(mean))
    return Components(
        mean.astype(np.float32), np.concatenate(axes, 1).astype(np.float32), scores, residual
    )


def kernel_of_targets(data: Measurements, rows: np.ndarray, components: int) -> Kernel:
    """Return the likeliest kernel of one length for rows (n,),
    by so many components of their targets.
    """
    parts = principal_components(training_targets(data, rows), data.site.target, components)
    return choose_left_out_kernel(data.moving[rows], parts.scores, len(parts.mean), 1)


class GaussianProcess(Differentiable, ClosedForm):
    """Matern-3/2 of two lengths, isotropic, over the moving end's position, about the mean target.

    Powers are learned in decibels, with one or two lengths, about a constant or a distance law, and
    from rows where nothing was heard too (`gsparc.processes.powers`).

    Args:
        components: largest number of principal components kept; all of them when the training set
            is smaller.
        mean: of powers: `constant`, `distance`, or `auto`, the one of larger leave-one-out
            likelihood.
    """

    name = "gp"
    baseline_order = 90
    stored = ("mean", "axes", "pixels", "lost", "scores", "powers")
    uses_censored = True
    count_gaussians = 0  # type: ignore[assignment]
    powers: PowerProcess | None = None  # None: not powers
    scores: Posterior | None = None  # of what is not
    pixels: tuple[Tensor, Tensor] | None = None  # rows, columns that mean and axes are numbers of

    def __init__(self, components: int = 512, mean: MeanName = "auto") -> None:
        check_arguments(locals(), components=whole(1), mean=choice(*MEANS))
        self.limit, self.about = components, mean

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        if len(targets) > MOST_ROWS:
            return self._learn_many(positions, targets)
        self.powers = None
        parts = principal_components(targets, self.target, self.limit)
        looked_at = sample_row_numbers(len(targets), CHOSEN_ON, 0)
        kernel = choose_left_out_kernel(
            positions[looked_at], parts.scores[looked_at], len(parts.mean)
        )
        at, scores = torch.from_numpy(positions), torch.from_numpy(parts.scores)
        self.scores = Exact.from_values(Prior(kernel), at, scores)
        self.mean, self.axes = torch.from_numpy(parts.mean), torch.from_numpy(parts.axes)
        self.lost = parts.lost
        notes = [f"gp: {kernel.description}"]
        if parts.lost > 0 and len(parts.axes) == self.limit < len(targets) - 1:
            notes.append(f"gp: {self.limit} components kept, mean square left out {parts.lost:.2e}")
        if len(looked_at) < len(targets):
            notes.append(f"gp: settings chosen on {CHOSEN_ON} of {len(targets)} rows, drawn evenly")
        return tuple(notes)

    def _learn_many(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        """Learn rows too many for one factor: components of some over the site,
        scores by the nearest.
        """
        # Rows that cover the site: components of crowded parts would miss what is seen elsewhere.
        rows = covering_rows(positions, CHOSEN_ON, 0)
        parts = principal_components(targets[rows], self.target, self.limit)
        start = choose_left_out_kernel(positions[rows], parts.scores, len(parts.mean))
        scores, self.lost = project_targets(targets, self.target, parts.mean, parts.axes)
        kernel, fit_note = choose_nearest_kernel(positions, scores, len(parts.mean), start, 0)
        once = torch.ones(len(scores), dtype=torch.float64)
        values = PlaceValues(positions, torch.from_numpy(scores), once)
        self.scores = condition_on_nearest(Prior(kernel), values, 0)
        self.mean, self.axes = torch.from_numpy(parts.mean), torch.from_numpy(parts.axes)
        basis = (
            f"{len(parts.axes)} components of {len(rows)} rows, mean square left out "
            f"{self.lost:.2e}"
        )
        scheme = (
            f"each query is predicted from the {NEIGHBOURS} nearest of {len(targets)} rows "
            "(Vecchia)"
        )
        return tuple(f"gp: {note}" for note in (kernel.description, fit_note, scheme, basis))

    def _learn_powers(self, rows: PowerRows) -> tuple[str, ...]:
        self.powers, notes = fit_power_process(rows, self.fitted_site, self.about)
        return tuple(f"gp: {note}" for note in notes)

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        return approximation_label(
            self.name, self.scores if self.powers is None else self.powers.posterior
        )

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        return self.powers

    def copy_conditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of powers alone."""
        if self.powers is None:
            return None
        result = copy.copy(self)
        result.powers, _ = condition_on_powers(
            power_rows(data, rows), self.powers.posterior.prior, 0
        )
        return result

    def _predict_at(self, queries: Tensor, dtype: torch.dtype) -> Prediction:
        if self.powers is not None:
            decibels, spread, share = self.powers.answer(queries)
            power = self._to_targets(decibels[:, None].to(dtype))
            return Prediction(
                power, self.target.entry_variance(spread.to(dtype), power), share.to(dtype)
            )
        assert self.scores is not None
        result, kernel = (
            self.scores.answer(queries, dtype == torch.float64),
            self.scores.prior.kernel,
        )
        mean = self._targets_of_scores(result.mean, dtype)
        # What the components leave out is an error of every prediction.
        variance = (kernel.amplitude * result.variance + self.lost).to(dtype)
        unknown = (result.variance / (1 + kernel.noise)).to(dtype)
        return Prediction(mean, self.target.entry_variance(variance, mean), unknown)

    def mean_at(self, query: Query) -> Tensor:
        """Return the mean (B, ...) of `predict` alone: the variance is most of a prediction."""
        places, dtype = query.places(self.fitted_site), query.tx.dtype
        if self.powers is not None:
            return self._to_targets(self.powers.mean_at(places)[:, None].to(dtype))
        assert self.scores is not None
        return self._targets_of_scores(self.scores.mean_at(places, dtype == torch.float64), dtype)

    def _targets_of_scores(self, scores: Tensor, dtype: torch.dtype) -> Tensor:
        """Targets (B, ...) of components (B, P)."""
        rows = torch.addmm(self.mean.to(dtype), scores.to(dtype), self.axes.to(dtype))
        if self.pixels is not None:
            rows = Separable(*(part.to(dtype) for part in self.pixels)).images(rows)
        return self._to_targets(rows)

    def with_strongest(self, lost: float) -> GaussianProcess:
        """Return it with the fewest components that leave out at most a share `lost`
        of what targets vary.

        Spectra are then made of the few numbers that an array resolves: a query reads these,
        not all pixels.
        """
        if not isinstance(self.scores, Exact):
            return self
        energy, order = self.scores.given_values().square().sum(0).sort(descending=True)
        beyond = energy.sum() - energy.cumsum(0)
        count = min(int((beyond > lost * energy.sum()).sum()) + 1, len(order))
        result = self._with_components(order[:count])
        entries = len(self.scores.rows) * len(self.mean)
        result.lost = self.lost + max(float(beyond[count - 1]), 0.0) / entries
        if self.kind == "spectrum" and self.pixels is None and lost:
            size = energy[:count].sqrt().float()[:, None].clamp_min(TINY)
            shape = self.shape[0], self.shape[1]
            basis, mean, axes = separate_axes(self.mean, result.axes * size, shape, lost * FINER)
            if 2 * len(mean) <= len(self.mean):  # else nothing is gained
                result.mean, result.axes, result.pixels = (
                    mean,
                    axes / size,
                    (basis.rows, basis.columns),
                )
        return result

    def _with_components(self, chosen: Tensor) -> GaussianProcess:
        """The same of these components alone."""
        assert isinstance(self.scores, Exact)
        result = copy.copy(self)
        result.scores = replace(self.scores, weights=self.scores.weights[:, chosen])
        result.axes = self.axes[chosen]
        return result

    def reduction_settings(self) -> tuple[str, ...]:
        """See `Method.reduce`."""
        if not isinstance(self.scores, Exact):
            return ("confidence",)
        return ("keep", "confidence", *(("stride",) if self.kind == "spectrum" else ()))

    def reduce(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Method.reduce`: the strongest components (`keep`, a share)
        on fewer pixels (`stride`).
        """
        if set(settings) <= {"confidence"} and settings.get("confidence", True):
            return self
        if not isinstance(self.scores, Exact):
            return MeanOnly(self, self.mean_at)
        stride, grid = int(settings.get("stride", 1)), self.fitted_site.grid
        count = max(1, math.ceil(float(settings.get("keep", 1.0)) * len(self.axes)))
        chosen = (
            self.scores.weights.square().sum(0).topk(count).indices
            if count < len(self.axes)
            else None
        )
        lean = copy.copy(self) if chosen is None else self._with_components(chosen)
        if stride > 1:
            if lean.pixels is not None:
                few = Separable(*lean.pixels).subsample_pixels(stride)
                lean.pixels = few.rows, few.columns
            else:
                parts = (
                    part.unflatten(-1, self.shape)[..., ::stride, ::stride]
                    for part in (lean.mean, lean.axes)
                )
                lean.mean, lean.axes = (part.flatten(-2).contiguous() for part in parts)
            lean.shape = tuple(-(-side // stride) for side in self.shape)
        lean.seen = len(lean.axes)
        means = MeanOnly(lean, lean.mean_at)
        return Interpolated(means, grid, stride) if stride > 1 and grid is not None else means


def project_targets(
    targets: np.ndarray, target: Target, mean: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return scores (n, P) float32 of stored targets (n, ...),
    and their mean square per number beyond.
    """
    scores, beyond = np.empty((len(targets), len(axes)), np.float32), 0.0
    for part in row_blocks(targets):
        rows = target.to_real(targets[part]) - mean
        scores[part] = result = rows @ axes.T
        beyond += float((rows.astype(np.float64) ** 2).sum()) - float(
            (result.astype(np.float64) ** 2).sum()
        )
    return scores, max(beyond, 0.0) / (len(targets) * len(mean))


def choose_nearest_kernel(
    places: np.ndarray, scores: np.ndarray, entries: int, start: Kernel, seed: int
) -> tuple[Kernel, str]:
    """Return lengths and noise likeliest given the nearest rows, by the strongest components,
    and a note.

    Args:
        places, scores: (n, D) [m] and (n, P) float32.
        entries: real numbers of a target.
        start: a kernel chosen on few rows.
        seed: of rows that are drawn.
    """
    energy = (scores[covering_rows(places, LOOKED_AT, seed)].astype(np.float64) ** 2).sum(0)
    strong = np.argsort(-energy, kind="stable")[:STRONGEST]
    once = torch.ones(len(places), dtype=torch.float64)
    values = PlaceValues(places, torch.from_numpy(scores[:, strong]).double(), once)
    result, note = choose_kernel_by_nearest(Prior(start), values, seed)
    share = energy.sum() / max(energy[strong].sum(), TINY)
    return replace(result, amplitude=result.amplitude * len(strong) / entries * float(share)), note
