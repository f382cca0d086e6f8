"""Candidates are fitted with groups of rows held out, and weighed by these."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from gsparc.data import heeded
from gsparc.data.inner_folds import NOT_TESTED, InnerFolds
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.image_sources.ensemble import CONVERGED_ERROR
from gsparc.models.method import Method
from gsparc.models.mixture import weights as solution_weights
from gsparc.models.mixture.candidates import Candidate
from gsparc.models.mixture.weights import LEAST_HELD, HeldOutPair, in_error_unit
from gsparc.models.splat.left_out_images import LeftOut
from gsparc.models.terms import EffectSettings
from gsparc.training.context import FitContext, FitReport
from gsparc.training.race import FellBehind, Race, mean_square
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

MOST_HELD = 1_000  # validation rows that the process is weighed on: memory
GROUPS = 3  # of training rows, that solutions are weighed by
OPEN_ENDED = ("sources", "bearings", "scene")  # candidates that take what effort they are given
SEARCHES = ("sources",)  # of them, those that race
NEAR = 0.1  # share of the energy that another solution misses, below which few searches are enough beside it
BESIDE = 2  # searches then, of the usual effort


def fit_candidates(
    parts: Mapping[str, Candidate], init: InitSettings, effects: EffectSettings, data: Measurements,
    fold: Fold, context: FitContext, watch: Stopwatch, cut: InnerFolds | None,
) -> tuple[dict[str, ClosedForm], dict[str, FitReport], dict[str, set[str]]]:  # fmt: skip
    """Fit candidates; return them, what each cost, and which settings each read.

    Where they are several, training rows are cut into groups as the test was cut, and each solution
    predicts every group from the others (`ClosedForm.held`): errors to weigh them by.

    Args:
        parts: candidates by name, which have settings `init`.
        fold: validation rows are solved for, too, where nothing is weighed.
        watch: of the fit.
        cut: how training rows are cut; None of one initialiser.

    Raises:
        ValueError: the only initialiser, or the one asked for, cannot solve this.
    """
    several = cut is not None
    rows = fold.train if several else np.sort(np.concatenate([fold.train, fold.val]))
    groups = () if cut is None else _training_groups(cut, fold.train)
    # Searches come last: they race against the best before them, and end where they fall behind.
    fields: dict[str, ClosedForm] = {}
    reports: dict[str, FitReport] = {}
    read: dict[str, set[str]] = {}
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
            with heeded.set_apart() as read[name]:
                field = parts[name](settings, effects.visibility is not False, within)
                report = field.fit(data, Fold(rows, rows[:0], rows[:0]), within)
            if not field.asks_visibility:
                read[name].discard("model.effects.visibility")
            fields[name] = field
            if name not in OPEN_ENDED:
                field.held = _predict_groups(field, data, rows, groups)
            if field.held is not None:
                target = in_error_unit(data.batch(field.held.rows).target, data.site)
                mean = in_error_unit(field.held.mean, data.site)
                one = Race.from_mean(field.held.rows, mean, target, add_to_curve)
                add_to_curve(name, mean_square(one.missed))
                race = one if race is None or one.error < race.error else race
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
    return fields, reports, read


def _why_not_searched(race: Race | None) -> str | None:
    """Why no search is begun: another solution is as near as searches come; else None."""
    if race is None or race.error > CONVERGED_ERROR:
        return None
    return f"another solution has an NMSE of {race.error:.4f} on held-out rows"


def weigh_candidates(
    solutions: dict[str, ClosedForm], data: Measurements, fold: Fold, cut: InnerFolds | None
) -> dict[str, tuple[ClosedForm, float]]:
    """Return solutions with their weights where positive, by rows which they were not conditioned on.

    Those are validation rows, and training rows as `cut`; one solution needs neither.
    """
    if not solutions:
        raise ValueError("no candidate could solve this: the lines above say why")
    first = next(iter(solutions))
    if len(solutions) == 1:
        return {first: (solutions[first], 1.0)}
    left_out = [field.held for field in solutions.values() if field.held is not None]
    rows = np.zeros(0, np.int64)
    if len(left_out) == len(solutions):
        # Only rows that every solution was without can be compared.
        rows = np.asarray(functools.reduce(np.intersect1d, [one.rows for one in left_out]), np.int64)
    batch = data.batch(fold.val)
    predicted = []
    for field in solutions.values():
        mean = field.predict(batch).mean
        if len(rows):
            assert field.held is not None
            order = {row: place for place, row in enumerate(field.held.rows.tolist())}
            mean = torch.cat([field.held.mean[[order[row] for row in rows.tolist()]], mean])
        predicted.append(in_error_unit(mean, data.site))
    rows = np.concatenate([rows, fold.val])
    if len(rows) < LEAST_HELD:
        log.info("%d rows are too few to weigh solutions by: init=%s alone", len(rows), first)
        return {first: (solutions[first], 1.0)}
    target = in_error_unit(data.batch(rows).target, data.site)
    assert cut is not None
    single = cut.unit.max() + 1 + np.arange(len(cut.unit))  # of validation rows that no group has
    unit = np.where(cut.unit == NOT_TESTED, single, cut.unit)[rows]
    # A search that went on has errors of its own: here a mixture need not be surely better, too.
    sure = 0.0 if set(solutions).intersection(SEARCHES) else 1.0
    weights = solution_weights.stacking_weights(predicted, target, unit, sure)
    for name, one, weight in zip(solutions, predicted, weights, strict=True):
        log.info(
            "%d held-out rows: %s has an NMSE of %.3f, weight %.2f", len(rows), name,
            1 - solution_weights.explained_variance(one, target, False), weight,
        )  # fmt: skip
    return {name: (solutions[name], w) for name, w in zip(solutions, weights, strict=True) if w > 0}


def _training_groups(cut: InnerFolds, train: np.ndarray) -> tuple[np.ndarray, ...]:
    """Training rows (n,) of each group."""
    result = [np.intersect1d(one.test, train) for one in cut.folds]
    return tuple(group for group in result if 0 < len(group) < len(train))


def _predict_groups(
    field: ClosedForm, data: Measurements, rows: np.ndarray, groups: tuple[np.ndarray, ...]
) -> LeftOutRows | None:
    """Rows of every group, predicted from the others with the parameters of all; None without groups."""
    if not groups:
        return None
    answers = []
    for group in groups:
        field.condition(data, np.setdiff1d(rows, group))
        batch = data.batch(group)
        answers.append(field.predict(batch))
    # Back to all rows, of which the last group is still missing.
    field.condition(data, rows)
    mean, variance = (torch.cat([getattr(one, name) for one in answers]) for name in ("mean", "variance"))
    return LeftOutRows(np.concatenate(groups), mean, variance)


def weigh_process(
    field: Method, data: Measurements, fold: Fold, left_out: LeftOut | None, distance: float | None
) -> tuple[tuple[GaussianProcess, float] | None, float | None]:
    """Return what a plain process on whole targets is worth beside a field, by rows neither learned from.

    Those are validation rows and, of spectra, training rows that both predict without their neighbours:
    a dozen rows alone decide by chance.

    Args:
        field: fitted on the same rows, without a process.
        data: measurements.
        fold: training and validation rows.
        left_out: training rows of spectra as the field's start predicts them, before any step.
        distance: of validation rows from the nearest training row [m].

    Returns:
        The process with its weight in the mean, None where it gains nothing; and the share of the variance
        of validation rows that the field explains, where that was found.
    """
    spectra = data.site.kind == "spectrum"
    left_out = left_out if spectra else None
    process = GaussianProcess()
    process.fit(data, Fold(fold.train, fold.val[:0], fold.val[:0]), FitContext())
    if not field.count_components() or (left_out is None and len(fold.val) < LEAST_HELD):
        few = f"{len(fold.val)} held-out rows do not tell whether Gaussians gain"
        log.info("%s: a Gaussian process alone", few if field.count_components() else "no Gaussians")
        return (process, 1.0), None
    rows, explained, weight = [], None, 0.0
    val = fold.val[:: -(-len(fold.val) // MOST_HELD)] if len(fold.val) else fold.val
    if len(val):
        batch = data.batch(val)
        means = (method.predict(batch).mean for method in (field, process))
        own, plain, target = (in_error_unit(values, data.site) for values in (*means, batch.target))
        explained = solution_weights.explained_variance(own, target, data.site.kind != "csi")
        if spectra:
            rows.append(
                HeldOutPair(*(part.detach().double().flatten(1).numpy() for part in (own, plain, target)))
            )
        else:
            weight = solution_weights.stacking_weights([own, plain], target, np.arange(len(val)))[1]
    if left_out is not None:
        rows.append(_held_out_pair(left_out, distance))
        if explained is None:
            own, target = (torch.from_numpy(part) for part in (rows[-1].own, rows[-1].target))
            explained = solution_weights.explained_variance(own, target, True)
    if spectra:
        weight = solution_weights.share_of_second(rows)
    log.info(
        "%d held-out rows, %d training rows without their neighbours: weight of a Gaussian process %.2f",
        len(val), 0 if left_out is None else len(left_out.centres), weight,
    )  # fmt: skip
    return ((process, weight) if weight > 0 else None), explained


def _held_out_pair(left_out: LeftOut, distance: float | None) -> HeldOutPair:
    """Training rows as far from what is left as held-out rows are, as field and process predict them."""
    gap = left_out.nearest_gap(distance)
    own, target = left_out.predictions_and_targets(gap, left_out.predicted)
    return HeldOutPair(own, left_out.predictions_and_targets(gap, left_out.predict_by_process())[0], target)
