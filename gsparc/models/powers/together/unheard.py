"""What the site shares, as strong as it predicts stations that were left out.

Where a station was heard its own process takes most of what shared terms could say, so the likelihood of its
rows hardly tells how strong they are. Each station by turns is predicted from the others, all strengths at
once: the ends' factorisations do not change, only the small system of the shared weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.models.powers.groups import Gain, compared
from gsparc.models.powers.together.learning import with_inducing
from gsparc.models.powers.together.posterior import NEVER, End, Factored
from gsparc.models.powers.together.prior import Prior, grid
from gsparc.models.powers.together.rows import Heard, thinned
from gsparc.processes.factor import Factor
from gsparc.training.time_budget import TimeBudget

LEAST_ENDS = 3
ROWS = 3_600  # of all stations
MOST_EACH = 300
PLACES = 300  # that the shared process is known at
CELLS = (16, 600)  # Gaussians of the grid, fewest and most
ROWS_A_CELL = 8
LENGTHS = (0.7, 2.0)  # of the shared process, of an end's shorter one
PLACE, CLOUD = (0.0, 0.03, 0.1, 0.2), (0.0, 0.006, 0.02, 0.06)  # variances, of an end's own
USUAL = (0.1, 0.02)  # of these, while the law's bend is tried
BEND_DB = 7.0  # a decade from the middle
WIDEST = 4.0  # factor that variances are corrected by at most
TINY = 1e-12


@dataclass(frozen=True)
class Unheard:
    """The prior for stations that were never heard.

    Attributes:
        prior: with shared terms as strong as left-out stations want them; possibly with none.
        inflation: of its variances, as left-out stations ask for.
        gain: what shared terms gain at left-out stations, each after one constant; None if not tried.
    """

    prior: Prior
    inflation: float
    gain: Gain | None


def for_unheard(
    rows: Heard, prior: Prior, sure: float, seed: int, budget: TimeBudget | None = None
) -> Unheard:
    """The strengths of least squared error at left-out stations, each after one constant.

    Args:
        rows: of all stations.
        prior: without shared terms.
        sure: standard errors that the gain over none must exceed.
        seed: of rows and places drawn.
        budget: no further length is tried when it is over.
    """
    loud = rows.at(np.flatnonzero(~rows.silent))
    count = len(loud.stations)
    if count < LEAST_ENDS:
        return Unheard(prior, 1.0, None)
    few = thinned(loud, min(MOST_EACH, max(ROWS // count, 1)), seed)
    ends = torch.from_numpy(np.concatenate([few.moving, few.still]))
    one = torch.zeros((), dtype=torch.float64)
    cells = min(max(len(few.rows) // ROWS_A_CELL, CELLS[0]), CELLS[1])
    full = replace(
        with_inducing(prior, few, PLACES, seed), log_cloud=one, log_shared=one,
        blockers=grid(ends.amin(0), ends.amax(0), cells), bend_db=1.0,
    )  # fmt: skip
    whole = float(prior.variance(NEVER))
    bend, none = 0.0, np.zeros(0)
    best: tuple[float, Prior, np.ndarray, float] | None = None
    for share in LENGTHS:
        if best is not None and budget is not None and budget.over():
            break
        views = _views(few, now := replace(full, log_length=prior.own[0] + math.log(share)))
        if best is None:
            none, _ = _left_out(views, _with(now, 0.0, 0.0, 0.0))
            place, cloud = (strength * whole for strength in USUAL)
            usual = [_left_out(views, _with(now, place, cloud, b))[0] for b in (0.0, BEND_DB)]
            bend = BEND_DB if (usual[1] ** 2).mean() < (usual[0] ** 2).mean() else 0.0
        for place, cloud in ((p, c) for p in PLACE for c in CLOUD):
            if best is not None and not place and share != LENGTHS[0]:
                continue  # without the shared process its length means nothing
            strong = _with(now, place * whole, cloud * whole, bend)
            errors, ratio = _left_out(views, strong)
            value = float((errors**2).mean())
            if best is None or value < best[0]:
                best = value, strong, errors, ratio
    assert best is not None
    gain = compared(best[2] ** 2, none**2, np.sort(few.station))  # errors come station by station
    if gain.exceeds(sure):
        return Unheard(best[1], _clipped(best[3]), gain)
    bare = prior.without()
    return Unheard(bare, _clipped(_left_out(_views(few, bare), bare)[1]), gain)


@dataclass(frozen=True)
class _View:
    """One end as the left-out prediction sees it, for shared terms of variance 1."""

    end: End
    own: Tensor  # (n,) variance of a measurement that the shared terms leave [dB^2]
    columns: Tensor
    gram: Tensor
    right: Tensor


def _views(rows: Heard, prior: Prior) -> list[_View]:
    found = []
    with torch.no_grad():
        for number in rows.stations:
            end = End.of(rows, number, prior)
            one = Factored.of(end, prior)
            columns, _ = prior.shared(end.moving, end.decades, end.shadows)
            own = prior.law.terms(end.decades).square().sum(1) + prior.variance(NEVER)
            gram, right = one.whitened.T @ one.whitened, one.whitened.T @ one.values
            found.append(_View(end, own, columns, gram, right))
    return found


def _with(prior: Prior, place: float, cloud: float, bend: float) -> Prior:
    """The prior with shared terms of such variances [dB^2] and bend [dB]; those of none are left out."""
    strong = replace(prior.without(place=not place, cloud=not cloud), bend_db=bend)
    log = torch.tensor([math.log(max(place, TINY)), math.log(max(cloud, TINY))], dtype=torch.float64)
    return replace(strong, log_shared=log[0], log_cloud=log[1])


def _left_out(views: list[_View], prior: Prior) -> tuple[np.ndarray, float]:
    """Errors (n,) [dB] at each station predicted from the others, after its own constant, in order.

    Returns:
        The errors, and the mean square of errors without that constant over their predicted variances.
    """
    width, cells = views[0].columns.shape[1], views[0].end.shadows.shape[1]
    place = max(width - cells - 1, 0)
    strength = torch.zeros(width, dtype=torch.float64)
    if len(prior.inducing):
        strength[:place] = prior.log_shared.mul(0.5).exp()
    if len(prior.blockers):
        strength[place : place + cells] = prior.log_cloud.mul(0.5).exp()
    if prior.bend_db:
        strength[-1] = prior.bend_db
    used = strength > 0
    scale = strength[used]
    every = sum((view.gram for view in views), torch.zeros_like(views[0].gram))
    right = sum((view.right for view in views), torch.zeros_like(views[0].right))
    errors, ratios = [], []
    for view in views:
        gram = (every - view.gram)[used][:, used]
        precision = torch.eye(int(used.sum()), dtype=torch.float64) + scale[:, None] * gram * scale
        factor = Factor.of(precision)
        mean = factor.solved((scale * (right - view.right)[used])[:, None])[:, 0]
        columns = view.columns[:, used] * scale
        error = view.end.values - columns @ mean
        unknown = factor.whitened(columns.T).square().sum(0)
        ratios.append(float((error.square() / (view.own + unknown)).mean()))
        errors.append((error - error.mean()).numpy())
    return np.concatenate(errors), float(np.mean(ratios))


def _clipped(ratio: float) -> float:
    return min(max(ratio, 1 / WIDEST), WIDEST)
