"""Noise correlated over the order of rows: clocks,
temperature and bodies drift while rows are taken.

At queries nothing of it is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, SlotPlaces
from gsparc.models.channels.kernels import isotropic_correlation
from gsparc.models.channels.terms.term import ChannelTerm

FAST_ROWS, DRIFT_ROWS = 3.0, 15.0  # rows over which errors are correlated
# Share of the drift that is one of the diffuse field; the rest is of all places alike
DRIFT_FIELD = 0.7


@dataclass(frozen=True)
class Drift(ChannelTerm):
    """Errors over few rows, and over many, of powers (2,)."""

    name = "drift"
    is_signal = False
    is_real = True

    def correlations(self, a: Group, b: Group) -> Tensor:
        """Return those of errors over few rows and over many (2, n, m) float64,
        between rows of a run.
        """
        between = (a.order[:, None] - b.order[None]).abs()
        same = a.run[:, None] == b.run[None]
        waves = isotropic_correlation(a.places, b.places, a.slot.wavenumber, self.frame.envelope)
        fast, slow = (torch.exp(-between / rows) * same for rows in (FAST_ROWS, DRIFT_ROWS))
        return torch.stack([fast, slow * (DRIFT_FIELD * waves + 1 - DRIFT_FIELD)])

    def covariance(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return that (n, m) float64 of training rows, see `Term`;
        0 beside places that were not measured.
        """
        if not (isinstance(a, Group) and isinstance(b, Group)):
            return torch.zeros(len(a.places), len(b.places), dtype=torch.float64)
        return torch.tensordot(self.power, self.correlations(a, b), 1)
