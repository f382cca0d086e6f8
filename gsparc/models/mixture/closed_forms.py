"""Closed forms fitted: what initialisers find, weighed, joined, and given all rows, within the seconds."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from gsparc.data import heeded
from gsparc.data.inner_folds import cut_inside
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.channels.field import ChannelField
from gsparc.models.conditional import ConditionalField
from gsparc.models.fields import INITIALISERS
from gsparc.models.mixture import solutions
from gsparc.models.mixture.weights import comparable, explained
from gsparc.models.run_factors import RunFactors
from gsparc.models.terms import EffectSettings
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.time_budget import less_repeatable

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Solved:
    """A field in closed form, and how it was fitted.

    Attributes:
        field: conditioned on all rows.
        started: names of initialisers that have weight in it, joined by +.
        runs: of channels, in the phase and level of the largest run.
        explained: share of the validation rows' variance that Gaussians explain; None without either.
        init_s: seconds until all was weighed [s].
        report: of the fit.
    """

    field: ConditionalField
    started: str
    runs: RunFactors
    explained: float | None
    init_s: float
    report: FitReport


def solve(
    parts: tuple[str, ...], init: InitSettings, effects: EffectSettings,
    data: Measurements, fold: Fold, context: FitContext,
) -> Solved:  # fmt: skip
    """Fit initialisers `parts`, which have settings `init`.

    Raises:
        ValueError: the only initialiser, or the one asked for, cannot solve this.
    """
    budget = context.time_budget()
    end = "" if context.budget_s is None else f", within {context.budget_s:.3g} s"
    log.info("training a Gaussian field with closed-form weights: init=%s%s", " and ".join(parts), end)
    known, several = np.sort(np.concatenate([fold.train, fold.val])), len(parts) > 1
    cut = cut_inside(data, fold, context.split, solutions.GROUPS, context.seed) if several else None
    runs = _runs(data, known, init, context)
    data = runs.aligned(data)
    fields, reports, read = solutions.find(parts, init, effects, data, fold, context, budget, cut)
    members = solutions.weighed(fields, data, fold, cut)
    heeded.count(*(path for name in members for path in read[name]))
    field, started = solutions.joined(members), "+".join(members)
    field.site = data.site
    init_s = budget.counted.wall
    log.info(
        "%s of %d Gaussians from init=%s, terms %s", type(field).__name__, field.count,
        started, ", ".join(field.terms) or "none",
    )  # fmt: skip
    share_explained = _explained(field, data, fold, several)
    if several or share_explained is not None:  # else it is of these rows already
        field.condition(data, known)
    seconds = budget.counted.wall
    if several:
        context.curve(seconds, "final")
    stages = {name: report.seconds for name, report in reports.items()}
    stages["weighing"] = max(init_s - sum(stages.values()), 0.0)
    stages["final weights"] = seconds - init_s
    unused = {name: spent for name, spent in stages.items() if name in reports and name not in members}
    notes = [note for name in members for note in reports[name].notes]
    limited = less_repeatable(budget.limited_by, *(report.limited_by for report in reports.values()))
    report = with_cost(FitReport(seconds, tuple(notes), limited), Cost(stages, unused))
    return Solved(field, started, runs, share_explained, init_s, report)


def with_cost(report: FitReport, cost: Cost) -> FitReport:
    """The report of a fit, whose last line is what it cost."""
    log.info("cost: %s", cost.described(report.limited_by))
    return replace(report, cost=cost)


def _runs(data: Measurements, known: np.ndarray, init: InitSettings, context: FitContext) -> RunFactors:
    """Factors of several runs of channels, by the waves that explain rows (n,); else none."""
    if not RunFactors.several(data, known):
        return RunFactors.none()
    field, _ = INITIALISERS["diffuse"](data, known, init, True, context)
    assert isinstance(field, ChannelField)
    log.info("channels of %d runs: the factor of each was estimated with the waves' field", len(field.runs))
    return field.runs


def _explained(field: ConditionalField, data: Measurements, fold: Fold, apart: bool) -> float | None:
    """See `Solved`; leaves the field conditioned on training rows, as it is already where `apart`."""
    if not (len(fold.val) and field.count):
        return None
    if not apart:
        field.condition(data, fold.train)
    batch = data.batch(fold.val)
    result = field(batch).explained
    assert result is not None
    own, target = (comparable(one, data.site) for one in (result, batch.target))
    return explained(own, target, data.site.kind != "csi")
