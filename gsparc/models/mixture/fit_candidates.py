"""Candidates are fitted with groups of rows held out, in a race on these."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gsparc.data.inner_folds import InnerFolds
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.closed_form import ClosedForm
from gsparc.models.image_sources.ensemble import CONVERGED_ERROR
from gsparc.models.member_weights import leave_out_groups
from gsparc.models.mixture.candidates import Candidate
from gsparc.models.terms import EffectSettings
from gsparc.training.context import FitContext, FitReport
from gsparc.training.race import FellBehind, Race, mean_square
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

GROUPS = 3  # of training rows, that solutions are weighed by
OPEN_ENDED = ("sources", "bearings", "scene")  # candidates that take what effort they are given
SEARCHES = ("sources",)  # of them, those that race
# Share of the energy that another solution misses, below which few searches are enough beside it
NEAR = 0.1
BESIDE = 2  # searches then, of the usual effort


def fit_candidates(
    parts: Mapping[str, Candidate],
    init: InitSettings,
    effects: EffectSettings,
    data: Measurements,
    fold: Fold,
    context: FitContext,
    watch: Stopwatch,
    cut: InnerFolds | None,
) -> tuple[dict[str, ClosedForm], dict[str, FitReport]]:
    """Fit candidates; return them, and what each cost.

    Where they are several, training rows are cut into groups as the test was cut, and each solution
    predicts every group from the others (`ClosedForm.held`): errors to weigh them by.

    Args:
        parts: candidates by name, which have settings `init`.
        fold: validation rows are solved for, too, where nothing is weighed.
        watch: of the fit.
        cut: how training rows are cut; None of one initialiser.

    Raises:
        ValueError: the only initialiser, the one asked for, or none of them can solve this.
    """
    several = cut is not None
    rows = fold.train if several else np.sort(fold.learned())
    groups = () if cut is None else _training_groups(cut, fold.train)
    # Searches come last: they race against the best before them, and end where they fall behind.
    fields: dict[str, ClosedForm] = {}
    reports: dict[str, FitReport] = {}
    race: Race | None = None

    def add_to_curve(what: str, error: float) -> None:
        context.log_curve(watch.seconds, what, error)

    for name in sorted(parts, key=OPEN_ENDED.__contains__):
        if name in SEARCHES and (why := _why_not_searched(race)):
            log.info("init=%s is left out: %s", name, why)
            continue
        began = watch.seconds
        try:
            leave_out = groups if name in OPEN_ENDED else ()  # these predict the groups themselves
            near = name in SEARCHES and race is not None and race.error < NEAR
            settings = replace(init, searches=min(init.searches, BESIDE)) if near else init
            within = replace(context, leave_out=leave_out, race=race, beside=fields)
            field = parts[name](settings, effects.visibility is not False, within)
            report = field.fit(data, Fold.of_all(rows), within)
            fields[name] = field
            if name not in OPEN_ENDED:
                field.held = leave_out_groups(field, data, rows, groups)
            if field.held is not None:
                target = data.site.target.in_error_unit(data.batch(field.held.rows).target)
                mean = data.site.target.in_error_unit(field.held.mean)
                rival = Race.from_mean(field.held.rows, mean, target, add_to_curve)
                add_to_curve(name, mean_square(rival.missed))
                race = rival if race is None or rival.error < race.error else race
        except ValueError as error:
            if isinstance(error, FellBehind):  # a `ValueError`, too
                reports[name] = FitReport(watch.seconds - began)
            elif len(parts) == 1 or name == init.name:
                raise
            log.info("init=%s is left out: %s", name, error)
            # It is there where the fit went well and rows held out did not.
            fields.pop(name, None)
            continue
        reports[name] = report
    if not fields:
        raise ValueError("no candidate could solve this: the lines above say why")
    return fields, reports


def _why_not_searched(race: Race | None) -> str | None:
    """Why no search is begun: another solution is as near as searches come; else None."""
    if race is None or race.error > CONVERGED_ERROR:
        return None
    return f"another solution has an NMSE of {race.error:.4f} on held-out rows"


def _training_groups(cut: InnerFolds, train: np.ndarray) -> tuple[np.ndarray, ...]:
    """Training rows (n,) of each group."""
    result = [np.intersect1d(fold.test, train) for fold in cut.folds]
    return tuple(group for group in result if 0 < len(group) < len(train))
