"""Noise that is correlated over the order of rows: clocks, temperature and bodies drift while rows are taken.

Its powers are found with those of all other terms held, on a stretch of rows, since correlation over the
order needs neighbours in it. At queries nothing of it is known.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.models.channels.columns import Group, thinned
from gsparc.models.channels.covariance import Values, temporal
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.worker import stop_when_late

STRETCH = 400  # rows looked at
COLUMNS = 3  # groups looked at
STEPS = 15
SHARES = (0.3, 0.3, 1.0)  # of the white noise, where noise, fast and drift start
LOWEST = 1e-5  # of the white noise


def contiguous_rows(groups: tuple[Group, ...]) -> tuple[Group, ...]:
    """At most `COLUMNS` groups, of `STRETCH` rows that follow each other."""
    stretches = []
    for group in thinned(groups, COLUMNS):
        order = torch.argsort(group.order, stable=True)
        start = max(len(order) - STRETCH, 0) // 2
        stretches.append(group.take(order[start : start + STRETCH]))
    return tuple(stretches)


def with_drift(groups: tuple[Group, ...], signals: list[Tensor], values: Values) -> tuple[Values, float]:
    """The terms with correlated noise, and what evidence gains on `groups` [nats].

    Args:
        groups: see `contiguous_rows`.
        signals: covariances (n, n) of theirs, see `covariance.signals`.
        values: without correlated noise.
    """
    noise = float(values.of("noise")[0])
    eye = [torch.eye(len(group), dtype=torch.float64) for group in groups]
    terms = [[one, *temporal(values.envelope, group)] for one, group in zip(eye, groups, strict=True)]
    before = sum(
        _likelihood(signal, [one], np.array([noise]), group)[0]
        for signal, one, group in zip(signals, eye, groups, strict=True)
    )

    def objective(logs: np.ndarray) -> tuple[float, np.ndarray]:
        power = np.exp(logs)
        both = [
            _likelihood(signal, three, power, group)
            for signal, three, group in zip(signals, terms, groups, strict=True)
        ]
        return sum(nll for nll, _ in both), np.sum([slope for _, slope in both], axis=0) * power

    start = np.log(noise * np.array(SHARES))
    bounds = [(math.log(noise * LOWEST), math.log(noise) + 5)] * 3
    optimum = minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": STEPS},
        callback=stop_when_late,
    )
    power = torch.cat([values.power.clone(), torch.zeros(2, dtype=torch.float64)])
    fresh = replace(values, correlated=True, power=power)
    for name, level in zip(("noise", "fast", "drift"), np.exp(optimum.x), strict=True):
        power[fresh.where(name)] = float(level)
    return fresh, before - float(optimum.fun)


def _likelihood(
    signal: Tensor, terms: list[Tensor], power: np.ndarray, group: Group
) -> tuple[float, np.ndarray]:
    """Negative log likelihood with the scale profiled, and its slope by the terms' powers."""
    covariance = signal + sum(float(level) * term for level, term in zip(power, terms, strict=True))
    given = Conditioned.of(covariance, group.target)
    count, outputs = group.target.shape
    nll = outputs * (count * math.log(given.scale) + float(given.factor.log_determinant))
    weight = outputs * given.factor.inverse - given.weights @ given.weights.mH / given.scale
    return nll, np.array([float((term * weight.mT).sum().real) for term in terms])
