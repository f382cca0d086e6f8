"""`model=distance_law`: received power falls with the logarithm of the distance,
and with nothing else.

The log-distance law of path loss, T. S. Rappaport, "Wireless Communications", 2nd ed. (2002),
section 4.9, with residuals of Huber's density, Gaussian within `CORNER` scales and exponential
beyond: an outlier bends little, and skewed shadowing is not cut off as Student's t cuts it (P. J.
Huber, "Robust estimation of a location parameter", Ann. Math. Stat. 35 (1964)). Where nothing was
heard, or a receiver was saturated, the likelihood is that of a power below or above the level (J.
Tobin, "Estimation of relationships for limited dependent variables", Econometrica 26 (1958)).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import ndtr
from torch import Tensor

from gsparc.data.schema import ENDS, Site
from gsparc.models.baselines.interpolation import Differentiable
from gsparc.models.method import Prediction
from gsparc.physics.decibels import RELATIVE_DB, to_decibels
from gsparc.processes.few_rows import sample_place_rows
from gsparc.processes.places import has_both_ends
from gsparc.processes.powers import PowerRows
from gsparc.processes.trend import TINY_M, Law
from gsparc.training.stopwatch import Stopwatch

EXPONENTS = (0.0, 8.0)  # bounds of n: 2 in free space, 6 through many walls
USUAL, SPREAD = 3.0, 2.0  # mean and deviation of a prior on n, which only few rows notice
CORNER = 3.0  # scales from which on the residuals' density is exponential
FLOORS = 10  # candidates of d0
UNSEEN = 10.0  # of the nearest row's distance: d0 where rows show none
SPREADS_DB = (0.05, 60.0)  # bounds of the scale of the residuals
LOOKED_AT = 2_000  # rows that an unknown place is sought with
STARTS = 6  # of that search, drawn at random, beside two that the powers suggest
PARAMETERS = 3  # a, n and the scale


def _mass_and_variance(corner: float) -> tuple[float, float]:
    """Integral of exp(-Huber's loss), and the variance of that density."""
    edge, middle = (
        math.exp(-(corner**2) / 2),
        math.sqrt(2 * math.pi) * math.erf(corner / math.sqrt(2)),
    )
    mass = middle + 2 * edge / corner
    return mass, (
        middle - 2 * corner * edge + 2 * edge * (corner + 2 / corner + 2 / corner**3)
    ) / mass


MASS, VARIANCE = _mass_and_variance(CORNER)


def law_variance(law: Law) -> float:
    """Return the variance of a measurement about the law [dB^2]."""
    return law.scale**2 * VARIANCE


def log_probability_below(z: np.ndarray) -> np.ndarray:
    """Return the logarithm of the probability that a residual lies below z (n,) scales."""
    tail = np.minimum(z, -CORNER)  # exponential: its logarithm is a line, however far out
    far = CORNER**2 / 2 + CORNER * tail - math.log(CORNER)
    edge = math.exp(-(CORNER**2) / 2) / CORNER
    inside = ndtr(np.clip(z, -CORNER, CORNER)) - ndtr(-CORNER)
    beyond = edge - np.exp(CORNER**2 / 2 - CORNER * np.maximum(z, CORNER)) / CORNER
    near = edge + math.sqrt(2 * math.pi) * inside + beyond
    return np.where(z < -CORNER, far, np.log(near)) - math.log(MASS)


def likelihood_slopes(
    residual: np.ndarray, side: np.ndarray, scale: float
) -> tuple[float, np.ndarray, float]:
    """Return the negative log likelihood of residuals (n,) [dB], its slopes by each (n,)
    and by log(scale).

    Where `side` (n,) is 1 or -1 the residual is of a level that the power lies below or above.
    """
    z = residual / scale
    influence = np.clip(z, -CORNER, CORNER)
    density = influence * (influence / 2 - z) - math.log(MASS)
    beyond = log_probability_below(np.where(side < 0, -z, z))  # the density is symmetric
    value = -float(np.where(side, beyond, density - math.log(scale)).sum())
    slope = np.where(side, side * -np.exp(density - beyond), influence)
    return value, slope / scale, float((side == 0).sum() - (slope * z).sum())


def _posterior(
    p: np.ndarray, loss: np.ndarray, rows: PowerRows
) -> tuple[float, list[float], np.ndarray]:
    """Negative log posterior of level, exponent and log scale,
    its slopes by these and by residuals (n,).
    """
    level, exponent, log_scale = p[:PARAMETERS]
    residual = rows.decibels - level + exponent * loss
    value, slope, by_scale = likelihood_slopes(residual, rows.side, math.exp(log_scale))
    away = (exponent - USUAL) / SPREAD
    slopes = [-slope.sum(), (slope * loss).sum() + away / SPREAD, by_scale]
    return value + 0.5 * away**2, slopes, slope


def fit_level_and_exponent(
    loss: np.ndarray, rows: PowerRows, start: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the least negative log posterior, its (level, exponent, log scale).

    `loss` (n,) [dB] is that of exponent 1.
    """

    def neg_log_posterior(p: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes, _ = _posterior(p, loss, rows)
        return value, np.array(slopes)

    bounds = [(None, None), EXPONENTS, tuple(np.log(SPREADS_DB))]
    result = minimize(neg_log_posterior, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return float(result.fun), result.x


def _initial_parameters(loss: np.ndarray, rows: PowerRows) -> np.ndarray:
    """Level and scale by medians for the usual exponent, from what was heard where anything was."""
    used = ~rows.silent if not rows.silent.all() else rows.silent
    levels = rows.decibels[used] + USUAL * loss[used]
    middle = float(np.median(levels))
    scale = 1.5 * float(np.median(np.abs(levels - middle)))
    return np.array([middle, USUAL, math.log(min(max(scale, 1.0), SPREADS_DB[1] / 2))])


def fit_law(rows: PowerRows, end: np.ndarray | None) -> Law:
    """Return the law of largest likelihood; the floor is chosen by it too.

    Args:
        rows: at least one.
        end: (3,) of the still end [m]; None where `rows.places` are of both ends.
    """
    at = None if end is None else (float(end[0]), float(end[1]), float(end[2]))
    law = Law(0.0, USUAL, 0.0, 1.0, at)
    places = torch.from_numpy(np.ascontiguousarray(rows.places, np.float64))
    far = law.distance(places).numpy()
    # From the nearest row (no floor) to the median: beyond,
    # half of the rows would tell nothing of n.
    low, high = np.maximum(np.quantile(far, [0.0, 0.5]), TINY_M)
    start = at_best = _initial_parameters(to_decibels(far), rows)
    best = np.inf
    for floor in np.unique(np.geomspace(low, high, FLOORS)):
        value, result = fit_level_and_exponent(to_decibels(np.maximum(far, floor)), rows, start)
        if value < best:
            best, at_best, law, start = value, result, replace(law, floor=float(floor)), result
    if law.floor <= low:  # rows show none: nearer than all of them powers rise on
        law = replace(law, floor=max(float(low) / UNSEEN, TINY_M))
    count = int((~rows.silent).sum())
    # Parameters swallow residuals
    few = math.sqrt(count / max(count - PARAMETERS, 1)) if count else 1.0
    level, exponent, scale = (float(value) for value in at_best)
    return replace(law, level=level, exponent=exponent, scale=math.exp(scale) * few)


def locate_still_end(rows: PowerRows, seed: int = 0) -> np.ndarray:
    """Return the place (3,) [m] of a still end that explains powers best, from several starts.

    Heights above and below the places' own plane fit alike:
    of places at one height the upper one is taken.
    """
    rng = np.random.default_rng(seed)
    if len(rows.places) > LOOKED_AT:
        rows = rows.subset(sample_place_rows(rows.places, LOOKED_AT, rng))
    low, high = rows.places.min(0), rows.places.max(0)
    size = max(float(np.linalg.norm(high - low)), TINY_M)
    bounds = np.stack([low - size, high + size], 1)
    loud = np.argsort(np.where(rows.side > 0, -np.inf, rows.decibels))[::-1]
    flat = high - low <= 1e-3 * size
    starts = [rows.places[loud[0]], rows.places[loud[: max(1, len(loud) // 20)]].mean(0)]
    starts += list(rng.uniform(low - size / 2, high + size / 2, (STARTS, len(low))))
    tiny = (1e-3 * size) ** 2  # a row on the very place must not decide alone

    def neg_log_posterior(p: np.ndarray) -> tuple[float, np.ndarray]:
        towards = (p[PARAMETERS:] * size) - rows.places
        squared = (towards**2).sum(1) + tiny
        value, slopes, slope = _posterior(p, to_decibels(squared) / 2, rows)
        by_place = RELATIVE_DB * p[1] * size * (slope / squared) @ towards
        return value, np.array([*slopes, *by_place])

    limits = [(None, None), EXPONENTS, tuple(np.log(SPREADS_DB)), *(bounds / size)]
    result = []
    for place in starts:
        place = place + 0.05 * size * flat  # in the plane itself heights have no slope
        loss = to_decibels(((place - rows.places) ** 2).sum(1) + tiny) / 2
        start = np.concatenate([_initial_parameters(loss, rows), place / size])
        result.append(
            minimize(neg_log_posterior, start, jac=True, method="L-BFGS-B", bounds=limits)
        )
    place = min(result, key=lambda one: float(one.fun)).x[PARAMETERS:] * size
    if flat[2]:  # its mirror image fits as well, and few stations stand under the ground
        place[2] = low[2] + abs(place[2] - low[2])
    return place


def say_estimated(place: np.ndarray) -> str:
    """Say that a place was not given but found, at world (3,) [m]."""
    where = ", ".join(f"{value:.4g}" for value in place)
    return f"is not given; estimated from powers at ({where}) m, its height least surely"


def fit_site_law(rows: PowerRows, site: Site) -> tuple[Law, tuple[str, ...]]:
    """Return the law of powers at a site, and notes: a place that nobody gave is estimated."""
    if has_both_ends(rows.places):
        return fit_law(rows, None), ()
    if site.static_position is not None and np.isfinite(site.static_position).all():
        return fit_law(rows, site.static_position), ()
    place = locate_still_end(rows)
    return fit_law(rows, place), (
        f"the {ENDS[site.still_end]}'s place {say_estimated(place + site.origin)}",
    )


class DistanceLaw(Differentiable):
    """Powers by the distance between the moving and the still end, or between two moving ends."""

    name = "distance_law"
    baseline_order = 70
    kinds = ("rssi",)
    stored = ("law",)
    uses_censored = True

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        raise ValueError(
            f"distance_law: needs received powers (rssi), not {self.kind}; take model=gp"
        )

    def _learn_powers(self, rows: PowerRows) -> tuple[str, ...]:
        started = Stopwatch()
        self.law, notes = fit_site_law(rows, self.fitted_site)
        law = self.law
        summary = (
            f"exponent {law.exponent:.3g} from {law.floor:.3g} m on, "
            f"deviation {law_variance(law) ** 0.5:.3g} dB"
            f" ({started.seconds:.2g} s)"
        )
        return tuple(f"distance_law: {note}" for note in (summary, *notes))

    def _predict_at(self, queries: Tensor, dtype: torch.dtype) -> Prediction:
        mean = self._to_targets(self.law.mean(queries)[:, None].to(dtype))
        variance = torch.full((len(queries),), law_variance(self.law), dtype=dtype)
        return Prediction(mean, variance=self.target.entry_variance(variance, mean))
