"""Powers of noise that is correlated over the order of rows, by likelihood with all other terms held.

They are found on a stretch of rows, since correlation over the order needs neighbours in it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, thinned
from gsparc.models.channels.evidence import Compressed, minimised, slope, solved
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Drift, Noise
from gsparc.models.channels.terms.compressed import Dense

STRETCH = 400  # rows looked at
COLUMNS = 3  # groups looked at
STEPS = 15
SHARES = (0.3, 1.0, 0.3)  # of the white noise, where fast and slow drift and noise start
LOWEST, HIGHEST = math.log(1e-5), 5.0  # logarithms of shares of the white noise


def contiguous_rows(groups: tuple[Group, ...]) -> tuple[Group, ...]:
    """Return at most `COLUMNS` groups, of `STRETCH` rows that follow each other."""
    stretches = []
    for group in thinned(groups, COLUMNS):
        order = torch.argsort(group.order, stable=True)
        start = max(len(order) - STRETCH, 0) // 2
        stretches.append(group.take(order[start : start + STRETCH]))
    return tuple(stretches)


def with_drift(
    groups: tuple[Group, ...], signals: list[Tensor], prior: ChannelPrior
) -> tuple[ChannelPrior, float]:
    """Return the terms with correlated noise, and what evidence gains on `groups` [nats].

    Args:
        groups: see `contiguous_rows`.
        signals: covariances (n, n) of theirs.
        prior: without correlated noise.
    """
    level = float(prior[Noise].power)
    drift = Drift(prior.frame, level * torch.ones(2, dtype=torch.float64))
    parts = []
    for group, signal in zip(groups, signals, strict=True):
        eye = torch.eye(len(group), dtype=torch.float64)
        held = Dense(signal[None]), Dense(drift.correlations(group, group).to(torch.complex128))
        parts.append(Compressed.of(group, eye, held, torch.eye(4, dtype=torch.float64)))
    one, none = torch.ones(1, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    before = sum(solved(part, torch.cat([one, none, prior[Noise].power])).nll for part in parts)

    def objective(logs: Tensor) -> tuple[float, Tensor]:
        power, total, gradient = torch.cat([one, level * logs.exp()]), 0.0, torch.zeros_like(logs)
        for part in parts:
            at = solved(part, power)
            total, gradient = total + at.nll, gradient + slope(part, power, at)[1:]
        return total, gradient

    start = torch.tensor(SHARES, dtype=torch.float64).log()
    shares, least = minimised(objective, start, [(LOWEST, HIGHEST)] * 3, STEPS)
    power = level * shares.exp()
    return prior.changed(Drift(prior.frame, power[:2]), Noise(prior.frame, power[2:])), before - least
