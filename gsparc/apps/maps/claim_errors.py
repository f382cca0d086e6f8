"""Errors of a claim as a process over places, from rows: where it is in doubt, what share holds.

Everything here depends on the process being right; no verdict comes from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import ndtr

from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.level_field import fit_level_field
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior
from gsparc.processes.uncertainty import central_interval

LEARNED_ON, SAMPLED = 600, 600  # rows, and places that a share is drawn over
DRAWS, BLOCK = 1000, 4096
SPREAD_DB = 9.0  # of measured levels about a planned one, before any row


@dataclass(frozen=True)
class ClaimErrors:
    """Claimed less measured levels, given rows.

    Attributes:
        posterior: of the errors about their mean, in units of the kernel's amplitude.
        mean, mean_variance: of all errors [dB, dB^2].
    """

    posterior: Exact
    mean: float
    mean_variance: float

    @classmethod
    def from_rows(cls, place: np.ndarray, error: np.ndarray) -> ClaimErrors:
        """Learn from errors (n,) [dB] at places (n, 2) [m]."""
        rows = covering_rows(place, LEARNED_ON, 0)
        at, value = place[rows], error[rows]
        kernel = fit_level_field(at, value, np.zeros(len(at))).kernel
        factor = Factor.from_gram(kernel.gram(torch.from_numpy(at)))
        both = torch.from_numpy(np.column_stack([np.ones(len(at)), value]))
        white = factor.whiten(both).numpy()
        precision = float(white[:, 0] @ white[:, 0])
        mean = float(white[:, 0] @ white[:, 1]) / precision
        values = torch.from_numpy(value - mean)[:, None]
        posterior = Exact.from_values(Prior(kernel), torch.from_numpy(at), values)
        return cls(posterior, mean, kernel.amplitude / precision)

    def chance_below(self, place: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Return how likely measured levels at places (n, 2) are lower than claimed by more than
        margins (n,) [dB].
        """
        parts = []
        for start in range(0, len(place), BLOCK):
            answer = self.posterior.answer(torch.from_numpy(place[start : start + BLOCK]))
            kernel = self.posterior.prior.kernel
            variance = kernel.amplitude * answer.variance + self.mean_variance
            over = answer.mean[:, 0] + self.mean - torch.from_numpy(margin[start : start + BLOCK])
            parts.append(ndtr((over / variance.sqrt()).numpy()))
        return np.concatenate(parts)

    def share(
        self, place: np.ndarray, margin: np.ndarray, level: float = 0.9
    ) -> tuple[float, float, float]:
        """Return the share of places (n, 2) that hold, and the ends of its interval.

        A place holds where its level is not lower than claimed by more than a margin (n,) [dB].
        """
        random = np.random.default_rng(0)
        some = random.permutation(len(place))[:SAMPLED]
        at, kernel = torch.from_numpy(place[some]), self.posterior.prior.kernel
        covariance = self.posterior.covariance(at).numpy() + self.mean_variance
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0))
        noise = np.sqrt(kernel.noise * kernel.amplitude)
        middle = self.posterior.answer(at).mean[:, 0].numpy() + self.mean - margin[some]
        error = middle + random.standard_normal((DRAWS, len(some))) @ root.T
        held = ndtr(-error / max(noise, 1e-9)).mean(1)
        return float(held.mean()), *central_interval(held, level)


def doubts_before_rows(margin: np.ndarray) -> np.ndarray:
    """Return how likely a place fails whose claim is above what is needed by margins (n,) [dB],
    before any row.
    """
    return np.asarray(ndtr(-margin / SPREAD_DB))
