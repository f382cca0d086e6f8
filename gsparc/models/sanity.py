"""Whether what was fitted may answer: each member against the next simpler one,
the plain mean the last.

A fit goes wrong in ways that nobody thought of. Rows predicted without their own values tell,
whatever they are: a member that misses them by more than what is simpler does answers nothing.
Asked once for each fit, before anything is printed or saved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from gsparc.base.errors import Severe
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.abilities import HasMembers
from gsparc.models.baselines.mean import Mean
from gsparc.models.checkpoint_content import find_non_finite
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import Method, MethodFactory, Prediction, import_path
from gsparc.models.predicting import factors_to_measured, predict_in_batches
from gsparc.models.stack import to_real_entries
from gsparc.models.target_rows import heard_rows
from gsparc.processes.density import TINY
from gsparc.processes.powers import MOST_ROWS
from gsparc.processes.uncertainty import mean_and_error
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.stopwatch import Stopwatch

JUDGED = 1_000  # rows, of small stations all: one mad answer in 300 is then seen
WILD = 2  # times what the mean misses any row by: all that was measured spans no more
WORK, FEWEST = 1e8, 60  # multiplications that solve for them, and rows where these do not suffice
LEAST = 4  # rows: fewer tell nothing
SURE = 2.0  # standard errors: one was a good fit's at a sixth of stations of five rows
MEAN = "the plain mean"


def judge_fit(
    method: Method, report: FitReport, data: Measurements, fold: Fold
) -> tuple[Method, FitReport]:
    """Return what may answer after a fit, and the report with a sentence of what may not.

    Members in closed form are judged by their training rows, each predicted from the others; what
    trains by gradient by validation rows, as it is in the end. Plain and published methods are what
    others are held against: their figures are their own. Of copies by station each was judged.

    Args:
        method: fitted; members of it may be taken out.
        report: of the fit.
        data, fold: what it was fitted to.
    """
    if method.has_parts or method.is_yardstick:
        return method, report
    watch = Stopwatch()
    with torch.no_grad():
        members: list[tuple[float, Method]] = [(1.0, method)]
        if isinstance(method, ClosedForm):
            members = [*method.weighted_members()]
        learned = method.members_data(data) if isinstance(method, HasMembers) else data
        kept, texts = _refuse_members(members, learned, fold)
        if texts and kept and isinstance(method, HasMembers):
            method.keep_members(kept)
        elif texts:
            name, method = method.name, Mean()
            method.fit(data, fold, FitContext())
            method.name = name
    who = " and ".join(member.name for member in kept) or MEAN
    texts = [f"{text}; {who} answers" for text in texts]
    cost = (
        report.cost + Cost({"rows left out": watch.seconds}) if report.cost.stages else report.cost
    )
    notes = (*map(Severe, texts), *report.notes)
    return method, replace(report, seconds=report.seconds + watch.seconds, notes=notes, cost=cost)


def create_unfitted(factory: MethodFactory, target: str) -> Method:
    """Return an unfitted method of the class that a checkpoint names: of `factory`,
    or what answers for it.

    Raises:
        ValueError: see `MethodFactory.create_as`.
    """
    return Mean() if target == import_path(Mean) else factory.create_as(target)


def _refuse_members(
    members: Sequence[tuple[float, Method]], data: Measurements, fold: Fold
) -> tuple[list[Method], list[str]]:
    """Members that may answer, of such with their weights, and why others do not.

    Plain processes are held against the mean, and what they answer together with those that have
    Gaussians against that. Together, as a mean of two gains where they err apart;
    the worst goes until it does.
    """
    asked = _draw_over_stations(rows := heard_rows(data, fold.learned()), data.stations_of(rows))
    answers = {id(member): _rows_left_out(member, data, fold, asked) for _, member in members}
    rows = reduce(np.intersect1d, [answer.rows for answer in answers.values()])
    rows = _draw_over_stations(rows, data.stations_of(rows))
    means = {name: answer.mean_at(rows) for name, answer in answers.items()}
    kept, texts = list[tuple[float, Method]](), list[str]()
    groups: dict[bool, list[tuple[float, Method]]] = {False: [], True: []}
    for weight, candidate in members:
        wrong = find_non_finite(candidate.state(), "state") or find_non_finite(
            means[id(candidate)], "row left out "
        )
        if wrong:
            texts.append(f"{candidate.name} answers nothing: {wrong} is NaN or infinite")
        else:
            groups[_has_gaussians(candidate)].append((weight, candidate))
    if len(rows) < LEAST:
        return [member for group in groups.values() for _, member in group], texts

    def missed(those: Sequence[tuple[float, Method]]) -> np.ndarray:
        total = sum(weight for weight, _ in those)
        parts = [weight / total * means[id(member)] for weight, member in those]
        return _squared_errors(torch.stack(parts).sum(0), data, rows)

    held = max(answers.values(), key=lambda answer: answer.group is not None)
    simpler, least = MEAN, _errors_of_mean(data, fold, rows, held)
    most = WILD**2 * least.max()  # of a row: a few that are mad have a large standard error
    for group in groups.values():
        while group:
            error = missed([*kept, *group])
            gain, unsure = mean_and_error(error - least, np.arange(len(rows)))
            if gain <= SURE * unsure and error.max() <= most:
                kept, least = [*kept, *group], error
                simpler = " and ".join(member.name for _, member in kept)
                break
            worst = max(group, key=lambda pair: missed([pair]).mean())
            group.remove(worst)
            error, at = missed([worst]), f"at {len(rows)} rows left out"
            ratio = np.sqrt(error.mean() / max(least.mean(), TINY))
            why = f"its rms error is {ratio:.3g} times that of {simpler}"
            if wild := np.count_nonzero(error > most):
                why += (
                    f", and {wild} are missed by more than {WILD} times what {MEAN} misses any by"
                )
            texts.append(f"{worst[1].name} answers nothing: {at} {why}")
    return [member for _, member in kept], texts


def _has_gaussians(method: Method) -> bool:
    """Whether it is more than a plain process."""
    return bool(
        method.count_gaussians if isinstance(method, ClosedForm) else method.count_components()
    )


def _rows_left_out(method: Method, data: Measurements, fold: Fold, rows: np.ndarray) -> LeftOutRows:
    """Rows (n,), maybe others too, as a method predicts them without their own values.

    Validation rows where it does not say.
    """
    if isinstance(method, ClosedForm):
        says = type(method).left_out is not ClosedForm.left_out
        for answer in (method.left_out(rows) if says else None, method.held):
            # Of several tones or antennas some keep one alone.
            if answer is not None and answer.mean.shape[1:] == data.target.shape[1:]:
                return answer
    rows = _draw_over_stations(fold.val, data.stations_of(fold.val))
    if not len(rows):
        return LeftOutRows(rows, torch.zeros(0), torch.zeros(0))
    order, _, parts = zip(*predict_in_batches(method, data, rows), strict=True)
    mean = Prediction.joined(parts).mean
    return LeftOutRows(rows[np.concatenate(order)], mean, mean.new_zeros(len(mean)))


def _draw_over_stations(rows: np.ndarray, station: np.ndarray) -> np.ndarray:
    """At most `JUDGED` of rows (n,), sorted: as many of each station, of small ones all.

    Fewer where a covariance of many has to be solved for each,
    so that it takes no time beside the fit.
    """
    many = np.bincount(station).max(initial=1)
    most = JUDGED if many > MOST_ROWS else int(np.clip(WORK / many**2, FEWEST, JUDGED))
    order = np.random.default_rng(0).permutation(len(rows))
    order = order[np.argsort(station[order], kind="stable")]
    first = np.searchsorted(station[order], station[order])
    turn = np.arange(len(rows)) - first  # within its station
    return np.sort(rows[order[np.argsort(turn, kind="stable")[:most]]])


def _errors_of_mean(
    data: Measurements, fold: Fold, rows: np.ndarray, held: LeftOutRows
) -> np.ndarray:
    """Squared errors (n,) of what others of its station say of each of rows (n,),
    of few of them all rows.

    Others are those that a member had, which `held` tells.
    """
    if held.group is not None:
        error = np.zeros(len(rows))
        for number in np.unique(held.group):
            own, others = (
                np.isin(rows, held.rows[held.group == number]),
                held.rows[held.group != number],
            )
            error[own] = _squared_errors(_mean_at(data, others, rows[own]), data, rows[own])
        return error
    known = heard_rows(data, fold.learned())
    count = np.bincount(data.stations_of(known), minlength=len(data.site.every_station))
    count = np.where(count > 1, count, max(len(known), 2))[data.stations_of(rows)]
    return _squared_errors(_mean_at(data, known, rows), data, rows) * (count / (count - 1)) ** 2


def _mean_at(data: Measurements, known: np.ndarray, rows: np.ndarray) -> Tensor:
    mean = Mean()
    mean.fit(data, Fold.of_all(known), FitContext())
    return mean.predict(data.batch(rows)).mean


def _squared_errors(mean: Tensor, data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Mean squares (n,) of the entries that were measured, in the unit of errors."""
    if data.site.unknown_factor != "none":  # errors are counted after it
        mean = mean * factors_to_measured(mean, data, rows)
    batch, unit = data.batch(rows), data.site.target.in_error_unit
    missed = unit(mean) - unit(batch.target)
    if batch.mask is not None:
        missed = torch.where(batch.mask, missed, torch.zeros_like(missed))
    return to_real_entries(missed).square().mean(1).numpy()
