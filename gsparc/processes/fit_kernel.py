"""Settings of kernels: the walk to where rows are likeliest, by rows left out or by evidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.processes.censored import PseudoValues
from gsparc.processes.density import (
    TINY,
    LeftOutSums,
    NegativeLogEvidence,
    ProfiledDensity,
    left_out_density,
)
from gsparc.processes.factor import NotDefiniteError
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.kernel import SHARES, Kernel, Stationary, distances

LOOKS = 40  # of a walk: most evaluations
# Gain of a step that is the last [nats of all rows]. Over rows a gain of g has a standard error of
# sqrt(2 g): below 2 none is sure. What remains after such a step is many times as much:
# at .5 it was 5 % of some errors.
SETTLED = 0.03
# Of them per number, of images, whose numbers are not independent: answers move by 1e-4 beyond
FINEST = 2e-5
BAD = 1e12  # in place of a density where no Cholesky factor exists
STARTS = np.array([0.01, 0.05, 0.25])  # lengths that a search starts from, of the extent
# As wide as powers [dB^2] of one station spread; more only where they were heard to
AMPLITUDES = (1e-4, 1e3)
SHORT, LONG = (0.25, 1.0), (1.0, 300.0)  # wavelengths; next to no field varies within a quarter
WAVES = (0.37, 2.8)  # of these, that a search starts from
SPANS = 3.0  # spacings between places, that the longer length starts from at least
NOISES = (1e-4, 10.0)  # of the signal's power
LEARNED_ON, TWO_LENGTH_LOOKS = 400, 8  # rows, and looks at them
TAILS = 3.0  # degrees of freedom of what is known of numbers: many rows may go far from it


class KernelRows(NamedTuple):
    """Rows of one process as its settings see them.

    Attributes:
        apart: (n, n) distances [m]; places (n, D) where other than distances counts.
        columns: (n, Q) of terms with unit normal weights; None: none.
        values: (n, P) less their mean.
        side: (n,) int8 of values that are levels, see `PowerRows`; None: all were measured.
    """

    apart: Tensor
    columns: Tensor | None
    values: Tensor
    side: Tensor | None = None

    def gram(self, kernel: Kernel, unit: Tensor | float = 1.0) -> Tensor:
        """Return the covariance (n, n) with noise, of amplitude 1,
        differentiable in the kernel's numbers; columns are divided by `unit`.

        >>> one = torch.zeros(1, 1, dtype=torch.float64)
        >>> KernelRows(one, None, one).gram(Kernel.from_length(length=2.0, noise=0.5))
        tensor([[1.5000]], dtype=torch.float64)
        """
        total = kernel.correlations_of(self.apart)
        if self.columns is not None:
            total = total + (self.columns @ self.columns.T) / unit**2
        return total + kernel.noise * torch.eye(len(total), dtype=total.dtype)


def minimise(
    objective: Callable[[Tensor], Tensor],
    starts: Sequence[np.ndarray],
    bounds: Sequence[tuple[float, float]],
    looks: int = LOOKS,
    settled: float = SETTLED,
) -> tuple[np.ndarray, float]:
    """Find where an objective is least, by L-BFGS-B from the best of some starts,
    and its value there.

    >>> start, bounds = [np.zeros(1)], [(-5.0, 5.0)]
    >>> best, value = minimise(lambda at: (at - 3).square().sum(), start, bounds, 50, 1e-12)
    >>> best.round(3), round(value, 3)
    (array([3.]), 0.0)

    Args:
        objective: of parameters (p,) float64, with autograd.
        starts: (p,) each.
        bounds: p of them.
        looks: most evaluations.
        settled: gain of a step that is the last, in the objective's unit.
    """
    low, high = np.array(bounds).T

    @lru_cache(1 + len(starts))  # the walk begins by asking for the best start again
    def evaluate_bytes(values: bytes) -> tuple[float, np.ndarray]:
        point = np.frombuffer(values)
        at = torch.from_numpy(point.copy()).requires_grad_()
        try:
            value = objective(at)
        except NotDefiniteError:  # in float64: as bad as it gets
            return BAD, np.zeros(len(point))
        (slope,) = torch.autograd.grad(value, at)
        # A walk by a slope that is none ends in a corner, and says nothing of it.
        assert torch.cat([value[None], slope]).isfinite().all(), (
            f"no slope at {point}: {value}, {slope}"
        )
        return float(value.detach()), slope.numpy()

    def evaluate(point: np.ndarray) -> tuple[float, np.ndarray]:
        return evaluate_bytes(point.tobytes())

    points = [np.clip(start, low, high) for start in starts]
    start = min(points, key=lambda point: evaluate(point)[0]) if len(points) > 1 else points[0]
    result = minimize(
        evaluate,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"ftol": settled / max(abs(evaluate(start)[0]), 1.0), "maxfun": looks},
    )
    return result.x, float(result.fun)


def fit_kernel(
    objective: Callable[[Kernel], tuple[Tensor, Tensor]],
    starts: Sequence[Kernel],
    bounds: Sequence[tuple[float, float]],
    looks: int = LOOKS,
    settled: float = SETTLED,
) -> tuple[float, Kernel]:
    """Find where an objective of kernels is least, and the kernel there,
    from the best of `starts` on.

    Args:
        objective: its value, with autograd, and the best amplitude.
        starts: of terms of one kind.
        bounds, looks, settled: see `minimise`.
    """
    first, points = starts[0], [start.parameters().numpy() for start in starts]
    best, _ = minimise(
        lambda at: objective(first.with_values(at))[0], points, bounds, looks, settled
    )
    with torch.no_grad():
        kernel = first.with_values(torch.from_numpy(best))
        value, amplitude = objective(kernel)
    return float(value), replace(kernel, amplitude=float(amplitude))


def fit_kernel_by_left_out(
    starts: Sequence[Kernel],
    views: Sequence[KernelRows],
    bounds: Sequence[tuple[float, float]] = (),
    looks: int = LOOKS,
    entries: int = 1,
    bounded: bool = True,
    alike: float = 0.0,
) -> tuple[float, Kernel]:
    """Find the least negative density of rows left out one by one [nats per output],
    and its kernel.

    Args:
        starts: of terms of one kind.
        views: rows of independent processes that differ in their amplitudes alone; the mean of
            these is told.
        bounds: of the parameters; none: those of the first process.
        looks: most evaluations.
        entries, bounded, alike: see `left_out_density`.
    """
    sizes = torch.tensor([len(view.values) for view in views], dtype=torch.float64)

    def objective(kernel: Kernel) -> tuple[Tensor, Tensor]:
        parts = [(view.gram(kernel), view.values) for view in views]
        value, amplitude = left_out_density(parts, entries, bounded, alike)
        return value / sizes.sum(), ((sizes * amplitude.log()).sum() / sizes.sum()).exp()

    count = float(sizes.sum())
    settled = max(SETTLED / (count * entries), FINEST)
    value, kernel = fit_kernel(
        objective, starts, bounds or starts[0].bounds(views[0].apart), looks, settled
    )
    return value * count, kernel


@dataclass(frozen=True)
class NumberPrior:
    """What is known of a process's numbers before any row: each is log-normal, its middle first.

    Attributes:
        length: of that of rows' extent.
        deviation, noise: of values [dB].
    """

    length: tuple[float, float]
    deviation: tuple[float, float]
    noise: tuple[float, float]

    def start(self, extent: float, term: type[Stationary]) -> Kernel:
        """Return the kernel of the middle numbers, of rows of an extent [m]."""
        deviation, noise = self.deviation[0], self.noise[0]
        return Kernel.from_length(
            self.length[0] * extent, (noise / deviation) ** 2, deviation**2, term
        )

    def cost(self, kernel: Tensor, amplitude: Tensor, lengths: int, extent: float) -> Tensor:
        """Return how much numbers are against it [nats], of `Kernel.parameters` (p,)
        and the logarithm of an amplitude ().
        """
        sizes = kernel[:lengths] - math.log(extent), 0.5 * amplitude, 0.5 * (amplitude + kernel[-1])
        known = self.length, self.deviation, self.noise
        parts = (
            ((size - math.log(middle)) / spread).square().div(TAILS).log1p().sum()
            for size, (middle, spread) in zip(sizes, known, strict=True)
        )
        return 0.5 * (TAILS + 1) * sum(parts, amplitude.new_zeros(()))


def fit_kernel_by_evidence(
    start: Kernel,
    views: Sequence[KernelRows],
    looks: int,
    known: NumberPrior | None = None,
    extent: float = 1.0,
) -> tuple[float, Kernel]:
    """Find the kernel of largest evidence, levels among the values; without looks `start` as it is.

    Args:
        start: where the search begins.
        views: rows of independent processes of one prior, such as those of several stations.
        looks: at all of them.
        known: of the numbers; columns of views then are in the values' unit, else in deviations of
            the process, and where all was heard the density of rows left out counts as much as the
            evidence, which a process of another shape misleads.
        extent: of the rows, which lengths are known by [m].

    Returns:
        The least negative evidence [nats per row], and its kernel.
    """
    sides = [torch.zeros(len(view.values)) if view.side is None else view.side for view in views]
    heard = torch.cat([view.values[side == 0] for view, side in zip(views, sides, strict=True)])
    most = max(AMPLITUDES[1], 4 * float(heard.square().mean()))
    bounds = [*start.bounds(views[0].apart), (math.log(AMPLITUDES[0]), math.log(most))]
    last, count = [list[PseudoValues]() for _ in views], sum(map(len, sides))

    def negative_log_evidence(at: Tensor) -> Tensor:
        kernel, total, unit = start.with_values(at[:-1]), at.new_zeros(()), at.new_ones(())
        if known is not None:
            unit = (0.5 * at[-1]).exp()
            total = known.cost(at[:-1], at[-1], len(start.signals), extent)
        for view, side, before in zip(views, sides, last, strict=True):
            gram = at[-1].exp() * view.gram(kernel, unit)
            evidence = NegativeLogEvidence.apply(gram, view.values[:, 0], side, before)  # type: ignore[no-untyped-call]
            if known is not None and not side.any():
                squares, precisions = LeftOutSums.apply(gram, view.values)  # type: ignore[no-untyped-call]
                evidence = 0.5 * evidence + 0.25 * (squares - precisions)
            total = total + evidence
        return total / count

    best = np.append(start.parameters().numpy(), math.log(start.amplitude))
    if looks:
        best, value = minimise(negative_log_evidence, [best], bounds, looks, SETTLED / count)
    else:
        value = float(negative_log_evidence(torch.from_numpy(best)))
    return value, replace(
        start.with_values(torch.from_numpy(best[:-1])), amplitude=math.exp(best[-1])
    )


def choose_left_out_kernel(
    positions: np.ndarray, scores: np.ndarray, entries: int, count: int = 2
) -> Kernel:
    """Return the lengths and noise of largest leave-one-out likelihood.

    Two lengths are those of interference and of levels: one that is short enough for interference
    predicts the mean in every gap.

    Args:
        positions: (n, 3) [m].
        scores: (n, P) centred targets in an orthonormal basis.
        entries: real numbers per target, P or more.
        count: of lengths, 1 or 2.
    """
    spread = float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
    # Two rows, or equal ones, have no likeliest length: the site's extent stands in.
    if len(positions) < 3 or not scores.any():
        return Kernel.from_length(
            spread, 1e-2, max(float((scores**2).sum()) / (len(scores) * entries), TINY)
        )
    bounds = [(math.log(spread * 1e-4), math.log(spread * 1e2))] * count
    bounds += [*[(-SHARES, SHARES)] * (count - 1), (math.log(1e-8), math.log(1e2))]
    # A coarse look picks the valley, the optimiser walks down it:
    # each look factors an n x n matrix.
    lengths = combinations(spread * STARTS, count)
    starts = [Kernel.from_lengths(length, [1 / count] * count, 0.01) for length in lengths]
    places, values = torch.from_numpy(positions), torch.from_numpy(scores)
    view = KernelRows(distances(places, places), None, values)
    return fit_kernel_by_left_out(starts, [view], bounds, entries=entries, bounded=False)[1]


def initial_kernel(length: float, spacing: float = 0.0) -> Kernel:
    """Return the kernel before anything was learned.

    `length` is a wavelength, or what stands for it; `spacing` between places,
    which the longer one spans [m].

    >>> [round(length, 3) for length in initial_kernel(0.1).lengths]
    [0.037, 0.28]
    """
    lengths = WAVES[0] * length, max(WAVES[1] * length, SPANS * spacing)
    return Kernel.from_lengths(lengths, (0.5, 0.5), 0.01)


def fit_two_lengths(places: np.ndarray, values: np.ndarray, length: float, start: Kernel) -> Kernel:
    """Return the kernel of a short and a long length, of largest evidence near `start`.

    Of channels whose rows were turned to be like their neighbours, the carrier's phase is gone:
    what is left varies within a fraction of a wavelength where paths interfere,
    and over many as the strongest does.

    Args:
        places: (n, D) [m].
        values: (n, P) complex.
        length: see `initial_kernel`.
        start: where to begin.
    """
    rows = covering_rows(places, LEARNED_ON, 0)
    at = torch.from_numpy(places[rows])
    # Parts of a circular value are independent and alike: twice as many outputs.
    real = torch.from_numpy(np.concatenate([values[rows].real, values[rows].imag], 1)).double()
    bounds = [
        *((math.log(low * length), math.log(high * length)) for low, high in (SHORT, LONG)),
        (-SHARES, SHARES),
        (math.log(NOISES[0]), math.log(NOISES[1])),
    ]
    view = KernelRows(distances(at, at), None, real)
    evidence = lambda kernel: ProfiledDensity.apply(view.gram(kernel), real)  # noqa: E731
    return fit_kernel(evidence, [start], bounds, TWO_LENGTH_LOOKS, SETTLED / real.numel())[1]
