"""Candidates race on rows that all of them left out: what is surely behind, and hardly gains, ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

HOPELESS = 1.5  # times the error of the best candidate: what missed more had no weight in the end
SURE = 2.0  # standard errors of paired rows
STALLED = 0.8  # of a candidate's error a look ago: what falls less in a round does not catch up


class Behind(ValueError):
    """A candidate ends: another is surely better."""


@dataclass(frozen=True)
class Race:
    """The best candidate so far, for those that follow.

    Attributes:
        rows: (n,) that it left out.
        squared, energy: (n,) its squared errors, and what the targets measure.
        note: is told of each look at a candidate: what, and its mean squared error per entry.
    """

    rows: np.ndarray
    squared: np.ndarray
    energy: np.ndarray
    note: Callable[[str, float], None]

    @classmethod
    def of(cls, rows: np.ndarray, mean: Tensor, target: Tensor, note: Callable[[str, float], None]) -> Race:
        """Return a candidate that predicts `mean` (n, ...) at rows (n,), where `target` was measured."""
        squared, energy = (rowwise(one) for one in (mean - target, target))
        return cls(rows, squared, energy, note)

    @property
    def error(self) -> float:
        """A share of the energy."""
        return float(self.squared.sum() / max(self.energy.sum(), 1e-30))

    def looked(self, what: str, rows: np.ndarray, squared: np.ndarray, before: float = 0.0) -> float:
        """Return the error of another candidate where both left rows out, as a share of their energy.

        Args:
            what: it is, for the learning curve.
            rows: (m,) rows, which it missed by `squared` (m,).
            before: its error a look ago; infinity at the first, 0 at the last.

        Raises:
            Behind: it is `HOPELESS` and `STALLED`.
        """
        _, here, there = np.intersect1d(self.rows, rows, return_indices=True)
        energy, missed = max(self.energy[here].sum(), 1e-30), self.squared[here]
        error, least = float(squared[there].sum() / energy), float(missed.sum() / energy)
        self.note(what, float(squared.mean()))
        apart = squared[there] - missed
        surely = apart.sum() > SURE * apart.std() * math.sqrt(len(apart))
        if surely and error > max(HOPELESS * least, STALLED * before):
            raise Behind(f"{what} miss {error:.3f} of the energy of rows held out, another {least:.3f}")
        return error


def rowwise(values: Tensor) -> np.ndarray:
    """Mean square (n,) float64 of each row of values (n, ...), real or complex."""
    return np.asarray(torch.as_tensor(values).detach().abs().double().square().flatten(1).mean(1))
