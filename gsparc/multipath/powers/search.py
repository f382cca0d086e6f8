"""Where Gaussians stand in the way of paths: found one by one, by the evidence each adds to a process.

A column s phi of the covariance changes the log evidence by (b^2 s^2 / (1 + s^2 c) - log(1 + s^2 c)) / 2 with
b = phi^T K^-1 r and c = phi^T K^-1 phi, most at 1 + s^2 c = b^2 / c: each candidate's strength and worth
follow from two products (D. J. C. MacKay, "Bayesian interpolation", 1992; M. E. Tipping and A. C. Faul, "Fast
marginal likelihood maximisation for sparse Bayesian models", AISTATS 2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from gsparc.methods.power_settings import _by_left_out
from gsparc.methods.time_budget import TimeBudget
from gsparc.multipath.powers.blockers import Blockers, Place
from gsparc.processes.density import gram_of
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import Kernel
from gsparc.processes.powers import Rows
from gsparc.processes.trend import Trend
from gsparc.processes.worker import stop_when_late

CANDIDATES = 3_000  # drawn for each Gaussian
ODDS = 20.0  # that the best of them must be worth against nothing
POLISHED = 4  # of the best candidates
LOOKS = 25  # at a candidate's slopes
REACH = 1.5  # a search moves logarithms of scales by no more, and angles [rad]
TINY = 1e-9


@dataclass(frozen=True)
class Seen:
    """Rows as the search sees them.

    Attributes:
        places: (n, 3) or (n, 6) float64 [m].
        still: of the end that stands [m]; None where both move.
        distance: (n, n) between places [m].
        terms: (n, P) of the mean law.
        values: (n,) less the mean law [dB].
        near, size: median distance of neighbours, and diagonal of the paths' box [m].
    """

    places: Tensor
    still: Place | None
    distance: np.ndarray
    terms: np.ndarray
    values: np.ndarray
    near: float
    size: float

    @classmethod
    def of(cls, rows: Rows, trend: Trend, still: Place | None) -> Seen:
        """Rows that were all heard, about a mean law."""
        places = torch.from_numpy(rows.places)
        ends = rows.places[:, :3]
        apart = cKDTree(np.unique(ends, axis=0)).query(np.unique(ends, axis=0), k=2)[0][:, 1]
        other = rows.places[:, 3:] if still is None else np.array([still])
        size = float(np.linalg.norm(np.ptp(np.concatenate([ends, other]), axis=0)))
        return cls(
            places, still, cdist(rows.places, rows.places), trend.terms(places).numpy(),
            rows.decibels - trend.mean(places).numpy(), float(np.median(apart)), size,
        )  # fmt: skip


def gains(inverse: Tensor, values: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Log evidence (N,) that each column adds with its best strength, and the square of that (N,).

    Zero where the values ask for a strength below nothing: a Gaussian takes power, it gives none. The
    evidence is of all rows but the one that speaks most for the column: one outlier is no wall.

    Args:
        inverse: (n, n) of the covariance of the values.
        values: (n,) [dB].
        columns: (n, N).
    """
    white, weights = inverse @ columns, inverse @ values
    by_value, by_column = columns.T @ weights, (columns * white).sum(0) + TINY
    ratio = by_value.square() / by_column
    # By block inversion: what each row adds to the quadratic forms c' K^-1 v and c' K^-1 c of the others.
    share = inverse.diagonal()[:, None]
    telling = (white * weights[:, None] / share).argmin(0, keepdim=True)
    own, at = white.gather(0, telling)[0], telling[0]
    rest_value = by_value - own * weights[at] / share[at, 0]
    rest_column = torch.maximum(by_column - own.square() / share[at, 0], 1e-9 * by_column)
    rest = rest_value.square() / rest_column
    worth = 0.5 * (rest - 1 - rest.clamp_min(TINY).log())
    worth = torch.where((rest > 1) & (rest_value < 0), worth, 0.0)
    return worth, torch.where((ratio > 1) & (by_value < 0), (ratio - 1) / by_column, 0.0)


def drawn(seen: Seen, count: int, rng: np.random.Generator) -> Blockers:
    """Candidates: upright walls and clumps of all sizes on random paths, half of them along the axes."""
    row, way = rng.integers(len(seen.places), size=count), rng.uniform(0.02, 0.98, (count, 1))
    places = seen.places.numpy()[row]
    other = places[:, 3:] if seen.still is None else np.array(seen.still)
    means = places[:, :3] + way * (other - places[:, :3])
    long = np.exp(rng.uniform(np.log(seen.near), np.log(max(seen.size / 2, 2 * seen.near)), count))
    thin = np.minimum(seen.near * 2 ** rng.uniform(-2, 1, count), long)
    along = math.pi / 2 * rng.integers(2, size=count)
    turns = np.where(rng.uniform(size=count) < 0.5, along, rng.uniform(0, math.pi, count))
    scales = np.log(np.c_[thin, long, long])
    return Blockers(*(torch.from_numpy(part) for part in (means, scales, turns, np.zeros(count))))


def search(
    seen: Seen, kernel: Kernel, most: int, seed: int, budget: TimeBudget | None = None
) -> tuple[Blockers, Kernel, float]:
    """Gaussians, the kernel with them, and the log evidence that they add.

    Args:
        seen: the rows.
        kernel: of the process without Gaussians.
        most: Gaussians.
        seed: of the candidates.
        budget: no further one is sought when it is over.
    """
    rng, found, total = np.random.default_rng(seed), Blockers.none(), 0.0
    values = torch.from_numpy(seen.values)
    while len(found) < most and not (budget and budget.over()):
        terms = np.c_[seen.terms, found.terms(seen.places, seen.still).numpy()]
        gram = gram_of(torch.from_numpy(kernel.parameters()), torch.from_numpy(seen.distance), torch.from_numpy(terms))
        inverse = Factor.of(gram).inverse / kernel.amplitude
        pool = drawn(seen, CANDIDATES, rng)
        first = gains(inverse, values, pool.shadows(seen.places, seen.still))[0].topk(POLISHED).indices
        worth, one = max((_polished(_at(pool, i), seen, inverse) for i in first), key=lambda pair: pair[0])
        if worth < math.log(ODDS * CANDIDATES):
            break
        strength = gains(inverse, values, one.shadows(seen.places, seen.still))[1] / kernel.amplitude
        found, total = found.joined(replace(one, log_strengths=0.5 * strength.log())), total + worth
        terms = np.c_[seen.terms, found.terms(seen.places, seen.still).numpy()]
        kernel = _by_left_out([kernel], torch.from_numpy(seen.distance), torch.from_numpy(terms), values[:, None])[1]
    return found.within(seen.places, seen.still), kernel, total


def _at(pool: Blockers, number: Tensor) -> Blockers:
    return Blockers(*(part[number][None] for part in pool.parts()))


def _polished(one: Blockers, seen: Seen, inverse: Tensor) -> tuple[float, Blockers]:
    """A candidate moved to where it is worth most, and that worth."""
    values, steps = torch.from_numpy(seen.values), one.means.new_tensor([seen.near] * 3 + [1.0] * 4)

    def moved(by: Tensor) -> Blockers:
        by = by * steps
        return replace(
            one, means=one.means + by[:3], log_scales=one.log_scales + by[3:6], turns=one.turns + by[6:]
        )

    def objective(by: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.from_numpy(by).requires_grad_()
        worth = gains(inverse, values, moved(at).shadows(seen.places, seen.still))[0][0]
        (slope,) = torch.autograd.grad(-worth, at)
        return -float(worth.detach()), slope.numpy()

    bounds = [(None, None)] * 3 + [(-REACH, REACH)] * 4
    best = minimize(
        objective,
        np.zeros(7),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxfun": LOOKS},
        callback=stop_when_late,
    )
    return -float(best.fun), moved(torch.from_numpy(best.x))
