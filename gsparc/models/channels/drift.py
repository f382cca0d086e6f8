"""Powers of noise that is correlated over the order of rows,
by likelihood with all other terms held.

They are found on a stretch of rows, since correlation over the order needs neighbours in it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, thin_groups
from gsparc.models.channels.evidence import BasisGroup, fit_terms, solve_group
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Drift, Noise

STRETCH = 400  # rows looked at
COLUMNS = 3  # groups looked at
STEPS = 15
SHARES = (0.3, 1.0, 0.3)  # of the white noise, where fast and slow drift and noise start


def sample_stretches(groups: tuple[Group, ...]) -> tuple[Group, ...]:
    """Return at most `COLUMNS` groups, of `STRETCH` rows that follow each other."""
    stretches = []
    for group in thin_groups(groups, COLUMNS):
        order = torch.argsort(group.order, stable=True)
        start = max(len(order) - STRETCH, 0) // 2
        stretches.append(group.select_rows(order[start : start + STRETCH]))
    return tuple(stretches)


def fit_drift(
    groups: tuple[Group, ...], signals: list[Tensor], prior: ChannelPrior
) -> tuple[ChannelPrior, float]:
    """Return the terms with correlated noise, and what evidence gains on `groups` [nats].

    Args:
        groups: see `sample_stretches`.
        signals: covariances (n, n) of theirs.
        prior: without correlated noise.
    """
    level, frame = float(prior[Noise].power), prior.frame
    start = level * torch.tensor(SHARES, dtype=torch.float64)
    drift, noise, parts = Drift(frame, start[:2]), Noise(frame, start[2:]), []
    for group, signal in zip(groups, signals, strict=True):
        eye = torch.eye(len(group), dtype=torch.float64)
        pieces = signal[None], drift.correlations(group, group).to(torch.complex128)
        # No parameter of these terms changes the signal.
        parts.append(
            BasisGroup.from_group(group, eye, pieces, torch.eye(1 + len(SHARES)).double()[:, 1:])
        )
    white = torch.tensor([1.0, 0.0, 0.0, level], dtype=torch.float64)
    before = sum(solve_group(part, white).nll for part in parts)
    fitted, least = fit_terms(parts, (drift, noise), 0.0, STEPS)
    return prior.with_terms(*fitted), before - least
