"""A Gaussian process on powers in decibels about a constant or a distance law, silent rows included."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import torch
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.methods.censored_ep import condition, log_evidence, propagate
from gsparc.methods.covering import covering
from gsparc.methods.distance_law import Rows, law_of
from gsparc.methods.haste import UNHURRIED, Haste
from gsparc.methods.nearest_process import NearestProcess, Values, given, settings_of
from gsparc.methods.neighbourhood import NEIGHBOURS
from gsparc.methods.power_kernel import BAD, PowerKernel, bounds_of, choose, kernel_of, slopes
from gsparc.methods.trend import REACH, Trend, trend_of
from gsparc.methods.worker import late, late_when, stop_when_late

log = logging.getLogger(__name__)

MeanName = Literal["auto", "constant", "distance"]
MEANS: tuple[MeanName, ...] = get_args(MeanName)

COMPARED_ON, LEAST_COMPARED_ON = 500, 150  # of them, constant and distance law; in haste
WEIGHED_ON = 600  # the same where some rows were silent: each look factors several
MOST_ROWS = 6_000  # whose covariance is factored as one: of more, each place is predicted from the nearest
MOST_SILENT = 3_000  # of them, where nothing was heard
LAW_NEEDS = 8  # rows that were heard, for a distance law
LAW_ODDS = 3.0  # logarithm of the prior odds of a law over a constant about a known place: 20 to 1
LEAST_FALL = 1.0  # exponent of a law that these odds speak for: below it, rows show no distance law
TWO_LENGTHS_NEED = 100
SHARES = (0.02, 0.1, 0.4)  # starting lengths, of the median distance
SPLITS = ((0.3, 1.5), (0.15, 4.0))  # starting pairs of lengths, of the one length that fits best
EVIDENCE_LOOKS = 30
AMPLITUDES_DB2 = (1e-4, 1e3)  # as wide as powers of one station spread; more only where they were heard to


@dataclass(frozen=True)
class PowerProcess:
    """A fitted process.

    Attributes:
        trend, kernel: the prior.
        places: (n, 3) or (n, 6) float64 [m].
        weights: (n,) of the covariances with these places, in units of the amplitude.
        extra: (n,) variance of the pseudo-values of silent rows, of the amplitude; 0 at rows that were heard.
    """

    trend: Trend
    kernel: PowerKernel
    places: np.ndarray
    weights: np.ndarray
    extra: np.ndarray

    @cached_property
    def factor(self) -> np.ndarray:
        """Lower Cholesky factor (n, n) of the covariance, of the amplitude."""
        return _factored(_gram(self.kernel, self.places, self.trend), self.extra)

    def mean_and_variance(self, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean [dB], variance of a measurement [dB^2], and what is unknown, in [0, 1], each (B,).

        Unknown is the variance as a share of that of the known rows. What the mean law explains of them
        counts as known near them only: its slope says nothing of places far from all data.
        """
        places = torch.from_numpy(queries)
        terms = self.trend.terms(places).numpy()
        far = cdist(queries, self.places)
        cross = self.kernel.correlation(far) + terms @ self._terms.T
        mean = self.trend.mean(places).numpy() + cross @ self.weights
        prior = 1 + self.kernel.noise + (terms**2).sum(1)
        known = (solve_triangular(self.factor, cross.T, lower=True, check_finite=False) ** 2).sum(0)
        left = np.clip(prior - known, 0.0, prior)
        whole, reach = self._spread
        by_law = 1 - (1 + self.kernel.noise) / whole  # share of that variance
        unknown = left / whole + by_law * (1 - np.exp(-((far.min(1) / reach) ** 2)))
        return mean, self.kernel.amplitude * left, np.minimum(unknown, 1.0)

    @cached_property
    def _spread(self) -> tuple[float, float]:
        """Variance of the rows that were heard, of the amplitude, and how far a law of them reaches [m]."""
        heard = self.extra <= 0  # below: the mean of several at one place
        whole = float(self.decibels()[heard].var()) / self.kernel.amplitude if heard.any() else 0.0
        reach = float(np.linalg.norm(np.ptp(self.places, axis=0))) * REACH
        return max(whole, 1 + self.kernel.noise), max(reach, 1e-9)

    def decibels(self) -> np.ndarray:
        """What it was given (n,), pseudo-values where nothing was heard [dB]."""
        lower = np.tril(self.factor)
        return self.trend.mean(torch.from_numpy(self.places)).numpy() + lower @ (lower.T @ self.weights)

    def mean_at(self, queries: Tensor) -> Tensor:
        """The mean alone (B,) [dB] at (B, 3) or (B, 6) float64 [m], with autograd."""
        places, weights = torch.from_numpy(self.places), torch.from_numpy(self.weights)
        apart = (queries[:, None] - places).square().sum(-1).clamp_min(1e-24).sqrt()  # finite slope at 0
        cross = self.trend.terms(queries) @ torch.from_numpy(self._terms).T
        for length, share in zip(self.kernel.lengths, self.kernel.shares, strict=True):
            far = apart * (math.sqrt(3) / length)
            cross = cross + share * (1 + far) * torch.exp(-far)
        return self.trend.mean(queries) + cross @ weights

    @cached_property
    def _terms(self) -> np.ndarray:
        return self.trend.terms(torch.from_numpy(self.places)).numpy()

    def state(self) -> dict[str, Any]:
        """Tensors and numbers that `restored` needs."""
        arrays = {name: torch.from_numpy(getattr(self, name)) for name in ("places", "weights", "extra")}
        return {**self.trend.state(), **self.kernel.state(), **arrays}


Process = PowerProcess | NearestProcess


def restored(state: dict[str, Any]) -> Process:
    """The process whose `state()` this was."""
    if "covariance" in state:
        return NearestProcess.restored(state)
    arrays = (state[name].numpy() for name in ("places", "weights", "extra"))
    return PowerProcess(trend_of(state), PowerKernel.of(state), *arrays)


def fit_powers(
    rows: Rows, site: Site, mean: MeanName = "auto", seed: int = 0, haste: Haste = UNHURRIED
) -> tuple[Process, tuple[str, ...]]:
    """A process of largest leave-one-out likelihood, and what must be said of it.

    Where some rows were silent, settings are those of largest evidence as expectation propagation has it.

    Args:
        rows: at least one.
        site: where the still end is.
        mean: the prior mean; `auto` chooses.
        seed: of the rows that are drawn where there are too many.
        haste: see there.
    """
    trend, kernel, notes = choose_prior(rows, site, mean, seed, haste)
    process, more = conditioned(rows, trend, kernel, seed)
    return process, (*notes, *more)


def choose_prior(
    rows: Rows, site: Site, mean: MeanName = "auto", seed: int = 0, haste: Haste = UNHURRIED
) -> tuple[Trend, PowerKernel, tuple[str, ...]]:
    """The settings of `fit_powers` alone, and what must be said of them."""
    trend, kernel, notes = _chosen(rows, _trends(rows, site, mean), seed, haste)
    return trend, kernel, (_description(trend, kernel), *notes)


def choose_about(
    rows: Rows, trend: Trend, seed: int = 0, haste: Haste = UNHURRIED
) -> tuple[PowerKernel, tuple[str, ...]]:
    """The kernel about a mean law that is given, and what must be said of it."""
    return _chosen(rows, [(trend, 0.0, ())], seed, haste)[1:]


def _chosen(
    rows: Rows, trends: list[tuple[Trend, float, tuple[str, ...]]], seed: int, haste: Haste
) -> tuple[Trend, PowerKernel, tuple[str, ...]]:
    """The best of `trends` with its kernel, and what must be said of the choice."""
    with late_when(haste.late):
        trend, kernel, said = _settings(rows, trends, seed, haste)
    if len(rows.places) > MOST_ROWS and not rows.silent.any():  # these tell of settings too
        kernel, how = settings_of(Values.of(rows.places, rows.decibels), trend, kernel, seed)
        said = (*said, f"then {how}")
    return trend, kernel, said


def draw(silent: np.ndarray, most: int, seed: int) -> np.ndarray:
    """At most so many rows, sorted; at least half of them were heard where as many were."""
    rng = np.random.default_rng(seed)
    loud, quiet = (rng.permutation(np.flatnonzero(one)) for one in (~silent, silent))
    if len(loud) + len(quiet) > most:
        share = round(most * len(loud) / (len(loud) + len(quiet)))
        first = max(share, min(len(loud), most // 2))
        loud, quiet = loud[:first], quiet[: most - first]
    return np.sort(np.concatenate([loud, quiet]))


@dataclass(frozen=True)
class _Candidate:
    """A prior, its log likelihood less `cost` for fitted parameters, and what must be said of it."""

    score: float
    trend: Trend
    kernel: PowerKernel
    cost: float
    notes: tuple[str, ...] = ()


def _settings(
    rows: Rows, trends: list[tuple[Trend, float, tuple[str, ...]]], seed: int, haste: Haste
) -> tuple[Trend, PowerKernel, tuple[str, ...]]:
    """Mean, lengths and noise, chosen on a part of many rows, and what must be said of the choice."""
    loud = rows.at(np.flatnonzero(~rows.silent)) if not rows.silent.all() else rows
    loud = loud.at(draw(np.zeros(len(loud.places), bool), haste.rows, seed))
    compared_on = min(COMPARED_ON, max(haste.rows // 2, LEAST_COMPARED_ON))
    few = loud.at(draw(np.zeros(len(loud.places), bool), compared_on, seed))
    weighed = rows.at(draw(rows.silent, min(WEIGHED_ON, haste.rows), seed))
    both = weighed.silent.any() and not weighed.silent.all()
    found = [_one_length(few, trend, cost, notes) for trend, cost, notes in trends]
    if both and not late():
        found = [_weighed(weighed, one) for one in found]
    best = max(found, key=lambda one: one.score)
    if len(loud.places) > len(few.places) and not both and not late():
        best = _refined(loud, best)
    if len(loud.places) >= TWO_LENGTHS_NEED and not late():
        two = _two_lengths(loud, best)
        best = max((best, _weighed(weighed, two) if both else two), key=lambda one: one.score)
    count = len((weighed if both else loud).places)
    if count < len(rows.places):
        said = f"settings chosen on {count} of {len(rows.places)} rows, drawn evenly"
        return best.trend, best.kernel, (*best.notes, said)
    return best.trend, best.kernel, best.notes


def _trends(rows: Rows, site: Site, mean: MeanName) -> list[tuple[Trend, float, tuple[str, ...]]]:
    """Candidate means, their cost, and notes.

    The cost is the number of parameters that the covariance leaves out, less the prior odds of a
    law: near the rows both predict alike, and far from them powers fall.
    """
    constant: tuple[Trend, float, tuple[str, ...]] = (Trend.of(rows, None), 0.0, ())
    if mean == "constant" or (mean == "auto" and int((~rows.silent).sum()) < LAW_NEEDS):
        return [constant]
    law, notes = law_of(rows, site)
    trend = Trend.of(rows, law)
    odds = LAW_ODDS if law.exponent >= LEAST_FALL else 0.0
    by_distance = trend, 4 if notes else 1 - odds, notes  # its floor, and a place that was sought
    return [by_distance] if mean == "distance" else [constant, by_distance]


def _views(rows: Rows, trend: Trend) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (n, n) [m], terms (n, P) and values less the mean (n,) [dB]."""
    places = torch.from_numpy(rows.places)
    distance = cdist(rows.places, rows.places)
    return distance, trend.terms(places).numpy(), rows.decibels - trend.mean(places).numpy()


def _one_length(rows: Rows, trend: Trend, cost: float, notes: tuple[str, ...]) -> _Candidate:
    distance, terms, values = _views(rows, trend)
    scale = float(np.median(distance)) or float(distance.max()) or 1.0
    if len(values) < 3 or not values.any() or not distance.any():
        amplitude = max(float((values**2).mean()), 1e-12)
        return _Candidate(0.0, trend, PowerKernel((scale,), (1.0,), 1e-2, amplitude), cost, notes)
    starts = [PowerKernel((scale * share,), (1.0,), 0.1, 1.0) for share in SHARES]
    value, kernel = choose(starts, distance, terms, values)
    return _Candidate(-value - cost, trend, kernel, cost, notes)


def _refined(rows: Rows, one: _Candidate) -> _Candidate:
    """The same with settings of more rows."""
    value, kernel = choose([one.kernel], *_views(rows, one.trend))
    return replace(one, score=-value - one.cost, kernel=kernel)


def _two_lengths(rows: Rows, one: _Candidate) -> _Candidate:
    """The same mean with two lengths, for two more parameters."""
    length, noise = one.kernel.lengths[0], one.kernel.noise
    starts = [PowerKernel((length * a, length * b), (0.5, 0.5), noise, 1.0) for a, b in SPLITS]
    value, kernel = choose(starts, *_views(rows, one.trend))
    return replace(one, score=-value - one.cost - 2, kernel=kernel, cost=one.cost + 2)


def _weighed(rows: Rows, one: _Candidate) -> _Candidate:
    """The same with settings of largest evidence, silent rows among the rest."""
    distance, terms, values = _views(rows, one.trend)
    amplitudes = AMPLITUDES_DB2[0], max(AMPLITUDES_DB2[1], 4 * float((values[~rows.silent] ** 2).mean()))
    low, high = np.array([*bounds_of(len(one.kernel.lengths), distance), tuple(np.log(amplitudes))]).T

    def objective(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        kernel, amplitude = kernel_of(parameters[:-1]), math.exp(parameters[-1])
        gram = amplitude * kernel.gram(distance, terms)
        try:
            value, by_gram = log_evidence(gram, values, rows.silent)
        except LinAlgError:  # in float64: as bad as it gets
            return BAD, np.zeros(len(parameters))
        by_parameter = [*(amplitude * slopes(kernel, distance, by_gram)), float(np.vdot(by_gram, gram))]
        return -value / len(values), -np.array(by_parameter) / len(values)

    start = np.clip([*one.kernel.parameters(), math.log(one.kernel.amplitude)], low, high)
    pace = {"ftol": 1e-5, "maxfun": EVIDENCE_LOOKS}
    limits = list(zip(low, high, strict=True))
    best = minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=limits, options=pace, callback=stop_when_late
    )
    kernel = kernel_of(best.x[:-1], math.exp(best.x[-1]))
    return replace(one, score=-float(best.fun) * len(values) - one.cost, kernel=kernel)


def conditioned(rows: Rows, trend: Trend, kernel: PowerKernel, seed: int) -> tuple[Process, tuple[str, ...]]:
    """The process given all rows with settings as they are, and what must be said of the silent ones."""
    if len(rows.places) > MOST_ROWS and not rows.silent.all():
        return _nearest(rows, trend, kernel, seed)
    return _whole(rows.at(draw(rows.silent, MOST_ROWS, seed)), trend, kernel, seed)


def _nearest(
    rows: Rows, trend: Trend, kernel: PowerKernel, seed: int
) -> tuple[NearestProcess, tuple[str, ...]]:
    """Of rows too many for one factor; of silent ones, those that a part of the rows is not sure of."""
    loud = rows.at(np.flatnonzero(~rows.silent))
    values = Values.of(loud.places, loud.decibels)
    said = f"each place is predicted from the {NEIGHBOURS} nearest of {len(values.places)} (Vecchia)"
    if not rows.silent.any():
        return given(values, trend, kernel, None, np.zeros(0), seed), (said,)
    part = rows.at(draw(rows.silent, MOST_ROWS, seed))
    few, notes = _whole(part, trend, kernel, seed)
    quiet = few.extra > 0
    stand_ins = Values(few.places[quiet], few.decibels()[quiet], np.ones(int(quiet.sum())))
    of = f"of {int(rows.silent.sum())} silent rows {int(part.silent.sum())}, drawn evenly, are looked at"
    return given(values, trend, kernel, stand_ins, few.extra[quiet], seed), (said, of, *notes)


def exact(process: Process) -> PowerProcess:
    """One that has covariances between places; of rows too many for that, given some that cover the site."""
    if isinstance(process, PowerProcess):
        return process
    few = covering(process.places, MOST_ROWS, 0)
    log.info(
        "covariances between places: of %d of %d rows that cover the site", len(few), len(process.places)
    )
    places, extra = process.places[few], process.noise[few] - process.kernel.noise
    factor = _factored(_gram(process.kernel, places, process.trend), extra)
    weights = cho_solve((factor, True), process.values[few], check_finite=False)
    return PowerProcess(process.trend, process.kernel, places, weights, extra)


def approximated(name: str, process: object) -> str:
    """A method's name with how its process is approximated, where it is."""
    how = getattr(process, "approximation", None)
    return name if how is None else f"{name} ({how})"


def _whole(rows: Rows, trend: Trend, kernel: PowerKernel, seed: int) -> tuple[PowerProcess, tuple[str, ...]]:
    notes: list[str] = []
    extra = np.zeros(len(rows.places))
    places = torch.from_numpy(rows.places)
    values = rows.decibels - trend.mean(places).numpy()
    gram = _gram(kernel, rows.places, trend)
    if rows.silent.any():
        deviation = math.sqrt(kernel.amplitude)
        notes.append(f"{int(rows.silent.sum())} rows where nothing was heard are below their level")
        told, level = condition(gram, values / deviation, rows.silent), values[rows.silent] / deviation
        near = np.flatnonzero(told.uncertain(level))
        if len(near) > MOST_SILENT:
            notes.append(f"{MOST_SILENT} of {len(near)} rows near the level are used, drawn evenly")
            near = np.sort(np.random.default_rng(seed).permutation(near)[:MOST_SILENT])
        used = np.sort(np.concatenate([np.flatnonzero(~rows.silent), np.flatnonzero(rows.silent)[near]]))
        rows, values, extra, gram = rows.at(used), values[used], extra[used], gram[np.ix_(used, used)]
        if len(near):
            sites = propagate(told.of(near), level[near])
            extra[rows.silent], values[rows.silent] = sites.variance, deviation * sites.value
            if not sites.settled:
                notes.append("what these rows say had not settled after all sweeps")
    factor = _factored(gram, extra)
    weights = cho_solve((factor, True), values, check_finite=False)
    process = PowerProcess(trend, kernel, rows.places, weights, extra)
    process.__dict__["factor"] = factor  # as `cached_property` would keep it
    return process, tuple(notes)


def _gram(kernel: PowerKernel, places: np.ndarray, trend: Trend) -> np.ndarray:
    return kernel.gram(cdist(places, places), trend.terms(torch.from_numpy(places)).numpy())


def _factored(gram: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor (n, n) of a covariance with `extra` (n,) on its diagonal; both are consumed."""
    gram[np.diag_indices_from(gram)] += extra
    return cho_factor(gram, lower=True, overwrite_a=True, check_finite=False)[0]


def _description(trend: Trend, kernel: PowerKernel) -> str:
    """One line of the settings."""
    parts = [f"{length:.4g} m" for length in kernel.lengths]
    if len(parts) == 2:
        parts = [f"{part} ({share:.0%})" for part, share in zip(parts, kernel.shares, strict=True)]
    law = trend.law
    mean = "a constant" if law is None else f"a distance law of exponent {law.exponent:.3g}"
    word = "length" if len(parts) == 1 else "lengths"
    return f"{word} {' and '.join(parts)}, noise {kernel.noise:.3g} of the signal's variance, about {mean}"
