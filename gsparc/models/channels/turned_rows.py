"""What stands beside the process of channels whose rows were turned to their neighbours.

Errors of such channels are counted after a phase (and delay) of the row's own is taken out. The
mean of a process, taken before, is too weak for that, the more the farther rows are: coherent sums
of what is not coherent fade. And turning rows of one neighbourhood to each other asks less
than turning all rows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch

from gsparc.data.blocks import row_blocks
from gsparc.data.query import Query
from gsparc.models.baselines.idw import InverseDistance
from gsparc.models.channels.complex_gp import ComplexGP
from gsparc.models.closed_form import ClosedForm
from gsparc.models.method import Prediction
from gsparc.physics.decibels import TINY_POWER
from gsparc.physics.row_factors import UnknownFactor, align_factors
from gsparc.processes.few_rows import covering_rows

COHERENT = 0.5  # share of the variance that a free phase finds again
ROUNDS = 2  # of turning neighbours to their mean
TRIED = 1_000  # rows that tell how far neighbours are off


class FullPowerGP(ComplexGP):
    """The process, its mean at the power that is expected once a phase
    of the row's own is taken out.
    """

    name = "full_power_gp"

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        prediction = super().predict(query)
        assert prediction.variance is not None
        power = prediction.mean.abs().square().flatten(1).mean(1).clamp_min(TINY_POWER)
        level = (1 + COHERENT * prediction.variance / power).sqrt()
        return replace(
            prediction, mean=prediction.mean * level.view(-1, *[1] * (prediction.mean.dim() - 1))
        )


class TurnedNeighbours(InverseDistance, ClosedForm):
    """The mean of the nearest rows, turned to each other, by the square of the inverse distance."""

    name = "turned_neighbours"
    stored: ClassVar[tuple[str, ...]] = (*InverseDistance.stored, "scale")
    count_gaussians = 0  # type: ignore[assignment]
    scale: float  # squared errors of rows left out, over what their neighbours differ by

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        notes = super()._learn(positions, targets)
        self.scale = 1.0
        if len(positions) > 2:
            sample_rows = covering_rows(positions, TRIED, 0)
            mean, spread = self._turn_nearest(positions[sample_rows], skip=1)
            turned = (
                mean
                * align_factors(mean, targets[sample_rows], self._tones, self._unknown_factor)[
                    :, None
                ]
            )
            missed = (np.abs(turned - targets[sample_rows]) ** 2).mean()
            self.scale = float(missed / max(spread.mean(), TINY_POWER))
        return notes

    @property
    def _tones(self) -> np.ndarray:
        """Frequencies (K,) [Hz]; alike where they are unknown, as then no delay can be told."""
        tones, count = self.fitted_site.subcarriers_hz, self.shape[1]
        return np.zeros(count) if tones is None or len(tones) != count else np.asarray(tones)

    @property
    def _unknown_factor(self) -> UnknownFactor:
        """Without the gain: rows were brought to one level before."""
        return "phase" if self.fitted_site.unknown_factor == "phase" else "phase+delay"

    def _turn_nearest(self, queries: np.ndarray, skip: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Means (q, A, K) of the nearest rows but the first `skip`,
        and what these differ by (q,).
        """
        means, spread = np.empty((len(queries), *self.shape), np.complex128), np.empty(len(queries))
        count = min(self.neighbours, len(self.positions) - skip)
        for part in row_blocks(means):
            distance, row = self.tree.query(queries[part], k=np.arange(1 + skip, 1 + skip + count))
            weight = 1 / np.maximum(distance, self.NEAR) ** self.power
            weight = (weight / weight.sum(1, keepdims=True))[..., None, None]
            near = self.targets[row].astype(np.complex128)
            mean = near[:, 0]
            for _ in range(ROUNDS):
                onto = np.repeat(mean[:, None], count, 1).reshape(-1, *self.shape)
                turns = align_factors(
                    near.reshape(-1, *self.shape), onto, self._tones, self._unknown_factor
                )
                near = near * turns.reshape(len(mean), count, 1, len(self._tones))
                mean = (weight * near).sum(1)
            means[part] = mean
            spread[part] = (weight * np.abs(near - mean[:, None]) ** 2).sum(1).mean((1, 2))
        return means, spread

    def _look_up(self, queries: np.ndarray) -> Prediction:
        mean, spread = self._turn_nearest(queries)
        nearest = self.tree.query(queries)[0]
        unknown = torch.from_numpy(-np.expm1(-nearest / self.spacing)).float()
        variance = torch.from_numpy(self.scale * spread).float()
        return Prediction(torch.from_numpy(mean.astype(np.complex64)), variance, unknown)
