"""Settings of largest leave-one-out likelihood, pooled over ends."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.methods.time_budget import TimeBudget
from gsparc.multipath.powers.blockers import Blockers
from gsparc.multipath.powers.together.law import SiteLaw
from gsparc.multipath.powers.together.posterior import End, Factored, left_out_of, weights_of
from gsparc.multipath.powers.together.prior import Prior, grid
from gsparc.multipath.powers.together.rows import Heard

INDUCING = 200  # places that the shared process is known at while settings are learned
CELLS = 256  # Gaussians of the grid
LOOKS = 40
STARTS = (0.1, 1.0)  # lengths, of the median distance between places
SHARED = 0.1  # of the process's variance, at first
SPANS = (1e-3, 3.0)  # bounds of a length, of that distance
SCALES = 0.5  # deviation of the logarithm of an end's variances
VARIANCES_DB2 = (1e-4, 1e4)
BAD = 1e12  # in place of a likelihood where no Cholesky factor exists


def start(rows: Heard, law: SiteLaw, stations: int, seed: int) -> Prior:
    """A prior to learn from: its lengths, variances, places and grid follow from the rows."""
    places = np.unique(rows.moving, axis=0)
    drawn = np.random.default_rng(seed).permutation(len(places))
    few = torch.from_numpy(places[np.sort(drawn[:400])])
    apart = torch.pdist(few)
    middle = float(apart.median()) if len(apart) else 1.0
    loud = ~rows.silent if not rows.silent.all() else rows.silent
    moving, still = torch.from_numpy(rows.moving[loud]), torch.from_numpy(rows.still[loud])
    values = torch.from_numpy(rows.decibels[loud]) - law.mean(law.decades(moving, still))
    station = rows.station[loud]
    for number in np.unique(station):  # levels aside
        values[station == number] -= values[station == number].mean()
    whole = max(float(values.square().mean()), 1e-2)
    ends = torch.from_numpy(np.concatenate([rows.moving, rows.still]))
    log = torch.tensor
    return Prior(
        law,
        torch.tensor([math.log(max(share * middle, 1e-3)) for share in STARTS], dtype=torch.float64),
        torch.full((2,), math.log(0.35 * whole), dtype=torch.float64),
        log(math.log(0.2 * whole), dtype=torch.float64),
        torch.zeros(stations, dtype=torch.float64),
        log(math.log(max(0.3 * middle, 1e-3)), dtype=torch.float64),
        log(math.log(SHARED * whole), dtype=torch.float64),
        log(math.log(SHARED * whole / 4), dtype=torch.float64),
        torch.from_numpy(places[np.sort(drawn[:INDUCING])]),
        grid(ends.amin(0), ends.amax(0), CELLS),
    )


def with_inducing(prior: Prior, rows: Heard, most: int, seed: int) -> Prior:
    """The same with the shared process known at more places, spread over those of rows."""
    if not len(prior.inducing):
        return prior
    places = np.unique(rows.moving, axis=0)
    drawn = np.random.default_rng(seed).permutation(len(places))[:most]
    return replace(prior, inducing=torch.from_numpy(places[np.sort(drawn)]))


def learn(
    prior: Prior, rows: Heard, looks: int = LOOKS, budget: TimeBudget | None = None
) -> tuple[Prior, float]:
    """The prior with settings of largest leave-one-out likelihood, and that per row [nats].

    Rows where nothing was heard are left aside. Prices: a row's worth for an end's own scale.
    """
    loud = rows.at(np.flatnonzero(~rows.silent)) if not rows.silent.all() else rows
    ends = [End.of(loud, number, prior) for number in loud.stations]
    names = learned_names(prior)
    begin = prior.settings()
    shapes = {name: begin[name].shape for name in names}
    first = np.concatenate([begin[name].reshape(-1).numpy() for name in names])
    bounds = _bounds(prior, names, loud)
    count = sum(len(end.values) for end in ends)

    def objective(at: np.ndarray) -> tuple[float, np.ndarray]:
        x = torch.from_numpy(at).requires_grad_()
        try:
            now = replace(prior, **_split(x, shapes))
            value = (left_out_loss(now, ends) + 0.5 * (now.log_scales / SCALES).square().sum()) / count
        except torch.linalg.LinAlgError:  # in float64: as bad as it gets
            return BAD, np.zeros_like(at)
        (slope,) = torch.autograd.grad(value, x)
        return float(value.detach()), slope.numpy()

    def stop(_: np.ndarray) -> None:
        if budget is not None and budget.over():
            raise StopIteration

    low, high = np.array(bounds).T
    found = minimize(
        objective, np.clip(first, low, high), jac=True, method="L-BFGS-B", bounds=bounds,
        options={"maxfun": looks, "ftol": 1e-5}, callback=stop,
    )  # fmt: skip
    best = {name: value.detach() for name, value in _split(torch.from_numpy(found.x), shapes).items()}
    return replace(prior, **best), -float(found.fun)


def left_out_loss(prior: Prior, ends: list[End]) -> Tensor:
    """Negative log density () [nats] of all rows, each given all others, with autograd."""
    factored = [Factored.of(end, prior) for end in ends]
    lower, mean = weights_of(factored)
    total = prior.log_noise.new_zeros(())
    for one in factored:
        error, variance = left_out_of(one, lower, mean)
        total = total + 0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum()
    return total


def learned_names(prior: Prior) -> list[str]:
    """Settings that mean something in this prior."""
    names = ["log_lengths", "log_own", "log_noise", "log_scales"]
    return names + ["log_length", "log_shared"] * bool(len(prior.inducing)) + ["log_cloud"] * bool(
        len(prior.blockers)
    )


def _split(values: Tensor, shapes: dict[str, torch.Size]) -> dict[str, Tensor]:
    sizes = [int(np.prod(shape)) for shape in shapes.values()]
    parts = values.split(sizes)
    return {name: part.reshape(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}


def _bounds(prior: Prior, names: Iterable[str], rows: Heard) -> list[tuple[float, float]]:
    few = torch.from_numpy(np.unique(rows.moving, axis=0)[:: max(1, len(rows.rows) // 400)])
    apart = torch.pdist(few)
    middle = max(float(apart.median()), 1e-3) if len(apart) else 1.0
    length = (math.log(SPANS[0] * middle), math.log(SPANS[1] * middle))
    variance = (math.log(VARIANCES_DB2[0]), math.log(VARIANCES_DB2[1]))
    found = []
    for name in names:
        one = length if "length" in name else (-2.0, 2.0) if name == "log_scales" else variance
        found += [one] * int(np.prod(getattr(prior, name).shape))
    return found


def bare(prior: Prior) -> Prior:
    """The prior without what the site shares beside its law."""
    return replace(prior, inducing=prior.inducing[:0], blockers=Blockers.none())
