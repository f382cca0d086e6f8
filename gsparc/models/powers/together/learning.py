"""Settings of largest leave-one-out likelihood, pooled over ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.models.powers.extinction import Blockers
from gsparc.models.powers.together.law import SiteLaw
from gsparc.models.powers.together.posterior import End, Factored, left_out_of, weights_of
from gsparc.models.powers.together.prior import LENGTHS, OWN, Prior
from gsparc.models.powers.together.rows import Heard
from gsparc.processes.factor import NotPositiveDefiniteError
from gsparc.processes.worker import stop_when_late
from gsparc.training.time_budget import TimeBudget

LOOKS = 40
STARTS = (0.1, 1.0)  # lengths, of the median distance between places
PARTS = (0.35, 0.35, 0.2)  # of the variance, at first: of these lengths, and of the noise
SPANS = (1e-3, 3.0)  # bounds of a length, of that distance
SCALES = 0.5  # deviation of the logarithm of an end's variances
DEPARTS = 0.7  # deviation of the logarithm of each of an end's settings
VARIANCES_DB2 = (1e-4, 1e4)
FLAT = 1e-6  # a step that gains less, per row [nats], is the last
BAD = 1e12  # in place of a likelihood where no Cholesky factor exists


def start(rows: Heard, law: SiteLaw, stations: int, seed: int) -> Prior:
    """A prior to learn from, without shared terms: its lengths and variances follow from the rows."""
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
    own = [math.log(max(share * middle, 1e-3)) for share in STARTS]
    own += [math.log(share * whole) for share in PARTS]
    return Prior(
        law,
        torch.tensor(own, dtype=torch.float64),
        torch.zeros(stations, OWN, dtype=torch.float64),
        torch.zeros((), dtype=torch.float64),
        torch.zeros((), dtype=torch.float64),
        torch.zeros((), dtype=torch.float64),
        torch.zeros(0, 3, dtype=torch.float64),
        Blockers.none(),
    )


def with_inducing(prior: Prior, rows: Heard, most: int, seed: int) -> Prior:
    """The same with the shared process known at so many places of rows, drawn evenly."""
    places = np.unique(rows.moving, axis=0)
    drawn = np.random.default_rng(seed).permutation(len(places))[:most]
    return replace(prior, inducing=torch.from_numpy(places[np.sort(drawn)]))


def learn_shared(
    prior: Prior, rows: Heard, looks: int = LOOKS, budget: TimeBudget | None = None
) -> tuple[Prior, float]:
    """Settings that all ends have alike, but for a scale of each one's variances; the density per row [nats].

    Rows where nothing was heard are left aside.
    """
    ends = _ends(prior, rows)
    count = sum(len(end.values) for end in ends)
    by_end = torch.tensor([0.0] * LENGTHS + [1.0] * (OWN - LENGTHS), dtype=torch.float64)
    first = {"own": prior.own, "scales": prior.departures[:, -1]}

    def at(values: dict[str, Tensor]) -> Prior:
        scales = values["scales"][:, None] * by_end
        return replace(prior, own=values["own"], departures=scales)

    def loss(values: dict[str, Tensor]) -> Tensor:
        price = 0.5 * (values["scales"] / SCALES).square().sum()
        return (left_out_loss(at(values), ends) + price) / count

    best, value = _walk(loss, first, _bounds(first, rows), looks, budget)
    return at(best), -value


def learn_ends(prior: Prior, rows: Heard, looks: int = LOOKS, budget: TimeBudget | None = None) -> Prior:
    """Settings of each end by itself, as its own rows want them away from all ends'."""
    departures = prior.departures.clone()
    low, high = np.array(_bounds({"own": prior.own}, rows)["own"]).T
    for end in _ends(prior, rows):
        number = end.station

        def loss(values: dict[str, Tensor], end: End = end, number: int = number) -> Tensor:
            apart = values["own"] - prior.own
            now = replace(
                prior.without(),
                departures=departures.index_put((torch.tensor([number]),), apart),
            )
            price = 0.5 * (apart / DEPARTS).square().sum()
            return (left_out_loss(now, [end]) + price) / len(end.values)

        first = {"own": prior.settings_of(number)}
        best, _ = _walk(loss, first, {"own": list(zip(low, high, strict=True))}, looks, budget)
        departures[number] = best["own"] - prior.own
    return replace(prior, departures=departures)


def _walk(
    loss: Callable[[dict[str, Tensor]], Tensor],
    first: dict[str, Tensor],
    bounds: dict[str, list[tuple[float, float]]],
    looks: int,
    budget: TimeBudget | None,
) -> tuple[dict[str, Tensor], float]:
    """Where `loss` is least, walked to from `first`, and its value there."""
    sizes = [value.numel() for value in first.values()]

    def named(values: Tensor) -> dict[str, Tensor]:
        parts = zip(first.items(), values.split(sizes), strict=True)
        return {name: part.reshape(value.shape) for (name, value), part in parts}

    def objective(at: np.ndarray) -> tuple[float, np.ndarray]:
        x = torch.from_numpy(at).requires_grad_()
        try:
            value = loss(named(x))
        except NotPositiveDefiniteError:  # in float64: as bad as it gets
            return BAD, np.zeros_like(at)
        (slope,) = torch.autograd.grad(value, x)
        return float(value.detach()), slope.numpy()

    def stop(_: np.ndarray) -> None:
        stop_when_late()
        if budget is not None and budget.over():
            raise StopIteration

    limits = [limit for name in first for limit in bounds[name]]
    low, high = np.array(limits).T
    begin = np.clip(torch.cat([value.reshape(-1) for value in first.values()]).numpy(), low, high)
    found = minimize(
        objective, begin, jac=True, method="L-BFGS-B", bounds=limits, callback=stop,
        options={"maxfun": looks, "ftol": FLAT},
    )  # fmt: skip
    return named(torch.from_numpy(found.x)), float(found.fun)


def _ends(prior: Prior, rows: Heard) -> list[End]:
    loud = rows.at(np.flatnonzero(~rows.silent)) if not rows.silent.all() else rows
    return [End.of(loud, number, prior) for number in loud.stations]


def left_out_loss(prior: Prior, ends: list[End]) -> Tensor:
    """Negative log density () [nats] of all rows, each given all others, with autograd."""
    factored = [Factored.of(end, prior) for end in ends]
    shared, mean = weights_of(factored)
    total = prior.own.new_zeros(())
    for one in factored:
        error, variance = left_out_of(one, shared, mean)
        total = total + 0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi)).sum()
    return total


def _bounds(first: dict[str, Tensor], rows: Heard) -> dict[str, list[tuple[float, float]]]:
    """Of settings by their names."""
    few = torch.from_numpy(np.unique(rows.moving, axis=0)[:: max(1, len(rows.rows) // 4_000)])
    apart = torch.pdist(few)
    middle = max(float(apart.median()), 1e-3) if len(apart) else 1.0
    length = (math.log(SPANS[0] * middle), math.log(SPANS[1] * middle))
    variance = (math.log(VARIANCES_DB2[0]), math.log(VARIANCES_DB2[1]))
    found: dict[str, list[tuple[float, float]]] = {}
    for name, value in first.items():
        found[name] = [(-2.0, 2.0) if name == "scales" else variance] * value.numel()
    if "own" in found:
        found["own"][:LENGTHS] = [length] * LENGTHS
    return found
