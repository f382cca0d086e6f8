"""Settings of a process of powers: its mean law, lengths and noise, from rows heard and silent."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.models.baselines.distance_law import law_of
from gsparc.models.haste import CHOSEN_ON, UNHURRIED, Haste
from gsparc.processes.density import Evidence, by_left_out, gram_of, walked
from gsparc.processes.kernel import Kernel, apart, bounds_of
from gsparc.processes.nearest import Values, settings_of
from gsparc.processes.powers import PowerProcess, Rows, conditioned, draw, trend_of_rows
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Trend
from gsparc.processes.worker import late, late_when

MeanName = Literal["auto", "constant", "distance"]
MEANS: tuple[MeanName, ...] = get_args(MeanName)

COMPARED_ON, LEAST_COMPARED_ON = 500, 150  # of them, constant and distance law; in haste
WEIGHED_ON = 600  # the same where some rows were silent: each look factors several
LAW_NEEDS = 8  # rows that were heard, for a distance law
LAW_ODDS = 3.0  # logarithm of the prior odds of a law over a constant about a known place: 20 to 1
LEAST_FALL = 1.0  # exponent of a law that these odds speak for: below it, rows show no distance law
TWO_LENGTHS_NEED = 100
SHARES = (0.02, 0.1, 0.4)  # starting lengths, of the median distance
SPLITS = ((0.3, 1.5), (0.15, 4.0))  # starting pairs of lengths, of the one length that fits best
LOOKS, SETTLED = 40, 5e-6
EVIDENCE_LOOKS, EVIDENCE_SETTLED = 30, 1e-5
AMPLITUDES_DB2 = (1e-4, 1e3)  # as wide as powers of one station spread; more only where they were heard to


def fit_powers(
    rows: Rows, site: Site, mean: MeanName = "auto", seed: int = 0, haste: Haste = UNHURRIED
) -> tuple[PowerProcess, tuple[str, ...]]:
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
) -> tuple[Trend, Kernel, tuple[str, ...]]:
    """The settings of `fit_powers` alone, and what must be said of them."""
    trend, kernel, notes = chosen_among(rows, _trends(rows, site, mean), seed, haste)
    return trend, kernel, (_description(trend, kernel), *notes)


def chosen_among(
    rows: Rows, trends: list[tuple[Trend, float, tuple[str, ...]]], seed: int, haste: Haste
) -> tuple[Trend, Kernel, tuple[str, ...]]:
    """The best of mean laws (each with its cost and notes), its kernel, and what must be said of it."""
    many = len(rows.places) > CHOSEN_ON and not rows.silent.any()
    with late_when(haste.late):
        pace = replace(haste, rows=min(haste.rows, COMPARED_ON)) if many else haste
        trend, kernel, notes = _settings(rows, trends, seed, pace)
    if many:  # given their nearest, all tell of settings
        values = Values.of(rows.places, torch.from_numpy(rows.decibels)[:, None])
        kernel, how = settings_of(Prior(kernel, trend), values, seed)
        notes = (*notes, f"then {how}")
    return trend, kernel, notes


@dataclass(frozen=True)
class _Candidate:
    """A prior, its log likelihood less `cost` for fitted parameters, and what must be said of it."""

    score: float
    trend: Trend
    kernel: Kernel
    cost: float
    notes: tuple[str, ...] = ()


def _settings(
    rows: Rows, trends: list[tuple[Trend, float, tuple[str, ...]]], seed: int, haste: Haste
) -> tuple[Trend, Kernel, tuple[str, ...]]:
    """Mean, lengths and noise, chosen on a part of many rows, and what must be said of the choice."""
    loud = rows if rows.silent.all() else rows.loud
    loud = loud.at(draw(np.zeros(len(loud.places), bool), haste.rows, seed))
    compared_on = min(COMPARED_ON, max(haste.rows // 2, LEAST_COMPARED_ON))
    few = loud.at(draw(np.zeros(len(loud.places), bool), compared_on, seed))
    weighed = rows.at(draw(rows.silent, min(WEIGHED_ON, haste.rows), seed))
    both = weighed.silent.any() and not weighed.silent.all()
    candidates = [_one_length(few, trend, cost, notes) for trend, cost, notes in trends]
    if both and not late():
        candidates = [_weighed(weighed, one) for one in candidates]
    best = max(candidates, key=lambda one: one.score)
    if len(loud.places) > len(few.places) and not both and not late():
        best = _refined(loud, best)
    if len(loud.places) >= TWO_LENGTHS_NEED and not late():
        two = _two_lengths(loud, best)
        best = max((best, _weighed(weighed, two) if both else two), key=lambda one: one.score)
    count = len((weighed if both else loud).places)
    if count < len(rows.places):
        note = f"settings chosen on {count} of {len(rows.places)} rows, drawn evenly"
        return best.trend, best.kernel, (*best.notes, note)
    return best.trend, best.kernel, best.notes


def _trends(rows: Rows, site: Site, mean: MeanName) -> list[tuple[Trend, float, tuple[str, ...]]]:
    """Candidate means, their cost, and notes.

    The cost is the number of parameters that the covariance leaves out, less the prior odds of a
    law: near the rows both predict alike, and far from them powers fall.
    """
    constant: tuple[Trend, float, tuple[str, ...]] = (trend_of_rows(rows, None), 0.0, ())
    if mean == "constant" or (mean == "auto" and int((~rows.silent).sum()) < LAW_NEEDS):
        return [constant]
    law, notes = law_of(rows, site)
    trend = trend_of_rows(rows, law)
    odds = LAW_ODDS if law.exponent >= LEAST_FALL else 0.0
    by_distance = trend, 4 if notes else 1 - odds, notes  # its floor, and a place that was sought
    return [by_distance] if mean == "distance" else [constant, by_distance]


def _views(rows: Rows, trend: Trend) -> tuple[Tensor, Tensor, Tensor]:
    """Distances (n, n) [m], terms (n, P) and values less the mean (n, 1) [dB]."""
    places = torch.from_numpy(rows.places)
    values = torch.from_numpy(rows.decibels) - trend.mean(places)
    return apart(places, places), trend.terms(places), values[:, None]


def _by_left_out(
    starts: list[Kernel], distance: Tensor, terms: Tensor, values: Tensor
) -> tuple[float, Kernel]:
    bounds = bounds_of(len(starts[0].lengths), distance.numpy())
    return by_left_out(starts, distance, terms, values, bounds, LOOKS, SETTLED)


def _one_length(rows: Rows, trend: Trend, cost: float, notes: tuple[str, ...]) -> _Candidate:
    distance, terms, values = _views(rows, trend)
    scale = float(np.median(distance.numpy())) or float(distance.max()) or 1.0
    if len(values) < 3 or not values.any() or not distance.any():
        amplitude = max(float(values.square().mean()), 1e-12)
        return _Candidate(0.0, trend, Kernel.of_one(scale, 1e-2, amplitude), cost, notes)
    starts = [Kernel.of_one(scale * share, 0.1) for share in SHARES]
    value, kernel = _by_left_out(starts, distance, terms, values)
    return _Candidate(-value - cost, trend, kernel, cost, notes)


def _refined(rows: Rows, one: _Candidate) -> _Candidate:
    """The same with settings of more rows."""
    value, kernel = _by_left_out([one.kernel], *_views(rows, one.trend))
    return replace(one, score=-value - one.cost, kernel=kernel)


def _two_lengths(rows: Rows, one: _Candidate) -> _Candidate:
    """The same mean with two lengths, for two more parameters."""
    length, noise = one.kernel.lengths[0], one.kernel.noise
    starts = [Kernel((length * a, length * b), (0.5, 0.5), noise) for a, b in SPLITS]
    value, kernel = _by_left_out(starts, *_views(rows, one.trend))
    return replace(one, score=-value - one.cost - 2, kernel=kernel, cost=one.cost + 2)


def _weighed(rows: Rows, one: _Candidate) -> _Candidate:
    """The same with settings of largest evidence, silent rows among the rest."""
    distance, terms, values = _views(rows, one.trend)
    silent = torch.from_numpy(rows.silent)
    most = max(AMPLITUDES_DB2[1], 4 * float(values[~silent].square().mean()))
    bounds = bounds_of(len(one.kernel.lengths), distance.numpy())
    bounds.append((math.log(AMPLITUDES_DB2[0]), math.log(most)))

    def objective(at: Tensor) -> Tensor:
        gram = at[-1].exp() * gram_of(at[:-1], distance, terms)
        return Evidence.apply(gram, values[:, 0], silent) / len(values)  # type: ignore[no-untyped-call]

    start = np.append(one.kernel.parameters(), math.log(one.kernel.amplitude))
    best, value = walked(objective, [start], bounds, EVIDENCE_LOOKS, EVIDENCE_SETTLED)
    kernel = Kernel.of(best[:-1], math.exp(best[-1]))
    return replace(one, score=-value * len(values) - one.cost, kernel=kernel)


def _description(trend: Trend, kernel: Kernel) -> str:
    """One line of the settings."""
    parts = [f"{length:.4g} m" for length in kernel.lengths]
    if len(parts) == 2:
        parts = [f"{part} ({share:.0%})" for part, share in zip(parts, kernel.shares, strict=True)]
    law = trend.law
    mean = "a constant" if law is None else f"a distance law of exponent {law.exponent:.3g}"
    word = "length" if len(parts) == 1 else "lengths"
    return f"{word} {' and '.join(parts)}, noise {kernel.noise:.3g} of the signal's variance, about {mean}"
