"""Candidates are fitted with groups of rows held out, in a race on these, and weighed by them."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from gsparc.data.inner_folds import NOT_TESTED, InnerFolds
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.closed_form import ClosedForm, LeftOutRows, rows_left_out
from gsparc.models.image_sources.ensemble import reached_noise_floor
from gsparc.models.mixture.candidates import Candidate
from gsparc.models.predicting import factors_to_measured
from gsparc.models.stack import LEAST_HELD, error_products, to_real_entries, weigh
from gsparc.models.terms import EffectSettings
from gsparc.physics.decibels import TINY_POWER
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
    noise = 0.0
    if data.noise_variance is not None:
        energy = mean_square(data.batch(rows).target)
        noise = float(np.mean(data.noise_variance[rows])) / max(energy, TINY_POWER)
    # Searches come last: they race against the best before them, and end where they fall behind.
    fields: dict[str, ClosedForm] = {}
    reports: dict[str, FitReport] = {}
    race: Race | None = None

    def add_to_curve(what: str, error: float) -> None:
        context.log_curve(watch.seconds, what, error)

    for name in sorted(parts, key=OPEN_ENDED.__contains__):
        if name in SEARCHES and race and reached_noise_floor([race.error], noise, 1):
            text = "init=%s is left out: another solution has an NMSE of %.4f on held-out rows"
            log.info(text, name, race.error)
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


def leave_out_groups(
    member: ClosedForm, data: Measurements, rows: np.ndarray, groups: Sequence[np.ndarray]
) -> LeftOutRows | None:
    """Return predictions of every group of rows by a member conditioned on rows (n,)
    without that group.

    Its parameters stay those of all rows. None without groups. The member stays as it is.
    """
    if not groups:
        return None
    answers, clone = [], copy.copy(member)
    for group in groups:
        clone.condition(data, np.setdiff1d(rows, group))
        answers.append(clone.predict(data.batch(group)))
    mean, variance = (
        torch.cat([getattr(answer, name) for answer in answers]) for name in ("mean", "variance")
    )
    number = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    return LeftOutRows(np.concatenate(groups), mean, variance, number)


def weigh_candidates(
    members: Mapping[str, ClosedForm], data: Measurements, val: np.ndarray, cut: InnerFolds | None
) -> dict[str, float]:
    """Return weights of members where positive, by rows which none of them was conditioned on.

    Args:
        members: one or more; one alone needs no rows.
        data: measurements.
        val: (v,) rows that none learned from, which are compared beside those that all left out by
            groups.
        cut: of the groups; None only for one member.
    """
    first = next(iter(members))
    if len(members) == 1:
        return {first: 1.0}
    left_out = [member.held for member in members.values()]
    # Only rows that every member was without can be compared
    rows = rows_left_out(members.values())
    predicted = [method.predict(data.batch(val)).mean for method in members.values()]
    if len(rows):
        pairs = zip(left_out, predicted, strict=True)
        predicted = [
            torch.cat([answers.mean_at(rows), mean])
            for answers, mean in pairs
            if answers is not None
        ]
    rows, target = np.concatenate([rows, val]), data.site.target
    if len(rows) < LEAST_HELD:
        log.info("%d rows are too few to weigh solutions by: init=%s alone", len(rows), first)
        return {first: 1.0}
    if data.site.unknown_factor != "none":  # errors are counted after it
        predicted = [mean * factors_to_measured(mean, data, rows) for mean in predicted]
    measured = target.in_error_unit(data.batch(rows).target)
    assert cut is not None
    single = cut.unit.max() + 1 + np.arange(len(cut.unit))  # of validation rows that no group has
    unit = np.where(cut.unit == NOT_TESTED, single, cut.unit)[rows]
    others = len(rows) / (len(rows) - 1)  # a row about the mean of the rest
    plain = to_real_entries(others * (measured - measured.mean(0))).square().mean(1).numpy()
    products = error_products([target.in_error_unit(mean) for mean in predicted], measured)
    # A search that raced to its end is worth what it gains, surely or not: .269 for .323 of the
    # power on many tones, .0347 for .0371 at several antennas.
    searched = any(name in SEARCHES for name in members)
    weights = weigh(products, unit, target.loss, sure=0.0 if searched else 1.0, plain=plain)
    power = max(float(to_real_entries(measured).square().mean()), TINY_POWER)
    for name, error, weight in zip(members, products.mean(0).diagonal(), weights, strict=True):
        text = "%d held-out rows: %s has an NMSE of %.3f, weight %.2f"
        log.info(text, len(rows), name, error / power, weight)
    return {name: float(weight) for name, weight in zip(members, weights, strict=True) if weight}


def _training_groups(cut: InnerFolds, train: np.ndarray) -> tuple[np.ndarray, ...]:
    """Training rows (n,) of each group."""
    result = [np.intersect1d(fold.test, train) for fold in cut.folds]
    return tuple(group for group in result if 0 < len(group) < len(train))
