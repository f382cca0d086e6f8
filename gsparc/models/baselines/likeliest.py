"""The likeliest process of powers: its mean law, lengths and noise, from rows heard and silent.

One process without what is known of numbers before any row: what `model=gp` maps powers by.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from gsparc.data.schema import Site
from gsparc.models.baselines.distance_law import fit_site_law
from gsparc.processes.fit_kernel import LOOKS, fit_kernel_by_evidence, fit_kernel_by_left_out
from gsparc.processes.kernel import (
    Kernel,
    median_distance,
)
from gsparc.processes.nearest import choose_kernel_by_nearest
from gsparc.processes.places import has_both_ends
from gsparc.processes.powers import (
    PowerProcess,
    PowerRows,
    condition_on_powers,
    rows_in_doubt,
    trend_about_rows,
)
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Trend
from gsparc.training.effort import Effort

MeanName = Literal["auto", "constant", "distance"]
MEANS: tuple[MeanName, ...] = get_args(MeanName)

CHOSEN_ON = Effort.chosen_on
COMPARED_ON = 500  # of them, constant and distance law; with little effort
WEIGHED_ON = 400  # the same where some rows were silent: each look factors several
LAW_NEEDS = 8  # rows that were heard, for a distance law
LAW_ODDS = 3.0  # logarithm of the prior odds of a law over a constant about a known place: 20 to 1
LEAST_FALL = 1.0  # exponent of a law that these odds speak for: below it, rows show no distance law
TWO_LENGTHS_NEED = 100  # rows that were heard
SHARES = (0.02, 0.1, 0.4)  # starting lengths, of the median distance
SPLITS = ((0.3, 1.5), (0.15, 4.0))  # starting pairs of lengths, of the one length that fits best
# Further pairs, of the median distance: the best one length may be short
WIDE = ((0.03, 0.3), (0.03, 1.5))
REFINED = 8  # looks at all rows after such at few
EVIDENCE_LOOKS = 30


def fit_power_process(
    rows: PowerRows, site: Site, mean: MeanName = "auto", seed: int = 0
) -> tuple[PowerProcess, tuple[str, ...]]:
    """Return a process of largest leave-one-out likelihood, and what must be said of it.

    Where some rows were silent, settings are those of largest evidence
    as expectation propagation has it.

    Args:
        rows: at least one.
        site: where the still end is.
        mean: the prior mean; `auto` chooses.
        seed: of the rows that are drawn where there are too many.
    """
    best = likeliest_candidate(rows, site, mean, seed)
    process, more = condition_on_powers(rows, best.prior, seed)
    return process, (best.description, *best.notes, *more)


def likeliest_candidate(
    rows: PowerRows, site: Site, mean: MeanName = "auto", seed: int = 0
) -> KernelCandidate:
    """Return what `fit_power_process` conditions on rows."""
    return choose_candidate(rows, _candidate_laws(rows, site, mean), seed, CHOSEN_ON)


class MeanLaw(NamedTuple):
    """A prior mean, what it costs [nats], and what must be said of it."""

    trend: Trend
    cost: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class KernelCandidate:
    """A prior, its log likelihood less `cost` for fitted parameters,
    and what must be said of it.
    """

    score: float
    trend: Trend
    kernel: Kernel
    cost: float
    notes: tuple[str, ...] = ()

    @property
    def prior(self) -> Prior:
        """Both."""
        return Prior(self.kernel, self.trend)

    @property
    def description(self) -> str:
        """One line of the settings."""
        law = self.trend.law
        mean = "a constant" if law is None else f"a distance law of exponent {law.exponent:.3g}"
        return f"{self.kernel.description}, mean: {mean}"


def choose_candidate(
    rows: PowerRows, trends: list[MeanLaw], seed: int, max_rows: int, compared_on: int = COMPARED_ON
) -> KernelCandidate:
    """Return the best of mean laws (each with its cost and notes), with its kernel.

    `compared_on`: rows that laws and kernels are compared on,
    of `max_rows` that the kernel is chosen on.
    """
    many = len(rows.places) > CHOSEN_ON and not rows.silent.any()
    best = _choose_on_part(
        rows, trends, seed, min(max_rows, compared_on) if many else max_rows, compared_on
    )
    return _refine_kernel(rows, best, seed, max_rows) if many else best


def _refine_kernel(
    rows: PowerRows, best: KernelCandidate, seed: int, max_rows: int
) -> KernelCandidate:
    """The same mean with the kernel that rows, all heard, say near its own."""
    # None need, or can, be the nearest
    if len(rows.places) <= CHOSEN_ON or not best.kernel.is_isotropic:
        part = rows.draw_subset(min(max_rows, CHOSEN_ON), seed)
        return _search_kernel(part, best, [best.kernel], limit=REFINED)
    # Given these, all tell
    kernel, how = choose_kernel_by_nearest(best.prior, rows.means_at_places(), seed)
    return replace(best, kernel=kernel, notes=(*best.notes, f"then {how}"))


def _choose_on_part(
    rows: PowerRows, trends: list[MeanLaw], seed: int, max_rows: int, compared_on: int
) -> KernelCandidate:
    """Mean, lengths and noise, chosen on a part of many rows."""
    loud = rows.heard_rows.draw_subset(max_rows, seed)
    few = loud.draw_subset(compared_on, seed)
    weighed = rows.draw_subset(min(WEIGHED_ON, max_rows), seed)
    both = weighed.silent.any() and not weighed.silent.all()
    candidates = [_fit_one_length(few, *law) for law in trends]
    scores = [candidate.score for candidate in candidates]
    if both:
        weighed = rows_in_doubt(weighed, candidates[-1].prior)
        scores = [_fit_by_evidence(weighed, candidate, REFINED).score for candidate in candidates]
    best = candidates[int(np.argmax(scores))]
    if len(few.places) >= TWO_LENGTHS_NEED:
        scale = median_distance(few.view(best.trend).apart)
        two = _search_kernel(few, best, _two_length_starts(scale, best.kernel), 2.0)
        best = max(best, two, key=lambda one: one.score)
        if has_both_ends(few.places):
            ends = _search_kernel(few, best, _end_starts(scale, best.kernel), 4.0)
            best = max(best, ends, key=lambda one: one.score)
    if len(loud.places) > len(few.places):
        # A look at all rows costs several at few: what was found on these is near already.
        best = _search_kernel(loud, best, [best.kernel], limit=REFINED)
    if both:  # one walk: each look factors several covariances
        best = _fit_by_evidence(weighed, best, EVIDENCE_LOOKS)
    count = len((weighed if both else loud).places)
    note = (f"settings chosen on {count} of {len(rows.places)} rows",) * (count < len(rows.places))
    return replace(best, notes=best.notes + note)


def _candidate_laws(rows: PowerRows, site: Site, mean: MeanName) -> list[MeanLaw]:
    """Candidate means, their cost, and notes.

    The cost is the number of parameters that the covariance leaves out, less the prior odds of a
    law: near the rows both predict alike, and far from them powers fall.
    """
    constant = MeanLaw(trend_about_rows(rows, None), 0.0, ())
    if mean == "constant" or (mean == "auto" and int((~rows.silent).sum()) < LAW_NEEDS):
        return [constant]
    law, notes = fit_site_law(rows, site)
    trend = trend_about_rows(rows, law)
    odds = LAW_ODDS if law.exponent >= LEAST_FALL else 0.0
    # Its floor, and a place that was sought
    by_distance = MeanLaw(trend, 4 if notes else 1 - odds, notes)
    return [by_distance] if mean == "distance" else [constant, by_distance]


def _fit_one_length(
    rows: PowerRows,
    trend: Trend,
    cost: float,
    notes: tuple[str, ...],
) -> KernelCandidate:
    view = rows.view(trend)
    scale = median_distance(view.apart)
    if len(view.values) < 3 or not view.values.any() or not view.apart.any():
        amplitude = max(float(view.values.square().mean()), 1e-12)
        return KernelCandidate(0.0, trend, Kernel.from_length(scale, 1e-2, amplitude), cost, notes)
    starts = [Kernel.from_length(scale * share, 0.1) for share in SHARES]
    value, kernel = fit_kernel_by_left_out(starts, [view])
    return KernelCandidate(-value - cost, trend, kernel, cost, notes)


def _search_kernel(
    rows: PowerRows,
    base: KernelCandidate,
    starts: list[Kernel],
    cost: float = 0.0,
    limit: int = LOOKS,
) -> KernelCandidate:
    """The same mean with settings of more rows, or with two lengths, for more parameters."""
    value, kernel = fit_kernel_by_left_out(starts, [rows.view(base.trend, starts[0])], looks=limit)
    return replace(base, score=-value - base.cost - cost, kernel=kernel, cost=base.cost + cost)


def _two_length_starts(scale: float, kernel: Kernel) -> list[Kernel]:
    """Two lengths to start from, near the best one and apart from it;
    `scale` is a median distance [m].
    """
    fit, noise = kernel.length, kernel.noise
    near = [Kernel.from_lengths((fit * a, fit * b), (0.5, 0.5), noise) for a, b in SPLITS]
    return near + [Kernel.from_lengths((scale * a, scale * b), (0.3, 0.7), noise) for a, b in WIDE]


def _end_starts(scale: float, kernel: Kernel) -> list[Kernel]:
    """Shadows of the path and of each end, or gains of each place,
    where one was found for both together.
    """
    lengths = (kernel.length, SHARES[0] * scale)
    return [Kernel.of_ends(kernel.lengths[-1], length, kernel.noise) for length in lengths]


def _fit_by_evidence(rows: PowerRows, base: KernelCandidate, limit: int) -> KernelCandidate:
    """The same with settings of largest evidence, silent rows among the rest;
    without looks as they are.
    """
    value, kernel = fit_kernel_by_evidence(base.kernel, [rows.view(base.trend, base.kernel)], limit)
    return replace(base, score=-value * len(rows.places) - base.cost, kernel=kernel)
