"""True and predicted channels of test positions, on any frequencies of the band."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gsparc.apps.link.adaptation import Band
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.argos import FACTS
from gsparc.models.method import Method, Prediction
from gsparc.models.uplink.interface import SeparatesPaths
from gsparc.physics.row_factors import align_factors
from gsparc.prediction.channels import interpolate_tones
from gsparc.prediction.confidence import Trusted
from gsparc.prediction.left_out import Evidence, score_answers

if TYPE_CHECKING:
    from gsparc.simulate.argos_sim import World

# 32 positions x antennas x fine tones bound what is held at once.
CHUNK = 32


@dataclass(frozen=True)
class BandChannels:
    """One band at n positions.

    Attributes:
        true: (n, A, K) complex64; of simulated streets exact, else interpolated from measured
            tones.
        predicted: (n, A, K) complex64.
        variance: (n,) expected squared error per entry of this very band; NaN where the method
            gives none.
        confidence: (n,) the method's own; NaN where it has none.
        source: where the truth comes from, for the summary.
    """

    true: Tensor
    predicted: Tensor
    variance: Tensor
    confidence: Tensor
    source: str

    def select_positions(self, index: np.ndarray) -> BandChannels:
        """Return some of the positions."""
        at = torch.from_numpy(index)
        return BandChannels(
            self.true[at], self.predicted[at], self.variance[at], self.confidence[at], self.source
        )

    def band(self) -> Band:
        """Return the first antenna's band; what states no variance is taken for exact."""
        return Band(self.true[:, 0], self.predicted[:, 0], self.variance.nan_to_num(0.0))


def predict_channels(
    method: Method,
    data: Measurements,
    rows: np.ndarray,
    frequency_hz: np.ndarray,
    antennas: slice = slice(None),
) -> BandChannels:
    """Return true and predicted channels of rows (n,) at absolute frequencies (K,) [Hz],
    of some of the antennas.

    Raises:
        ValueError: a frequency outside the measured band.
    """
    assert data.site.subcarriers_hz is not None
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for start in range(0, len(rows), CHUNK):
        batch = data.batch(rows[start : start + CHUNK])
        # What separates paths answers at any frequency;
        # others are interpolated between measured tones.
        if isinstance(method, SeparatesPaths) and batch.uplink is not None:
            wanted = torch.from_numpy(frequency_hz)
            answer = method.predict_from_uplink(
                batch.uplink, wanted, batch.noise_variance, antennas
            )
        else:
            answer = method.predict(batch)
            # The variance stays that of measured tones: interpolation is smooth between them.
            mean = interpolate_tones(
                answer.mean[:, antennas], data.site.subcarriers_hz, frequency_hz
            )
            answer = Prediction(mean, answer.variance, answer.unknown)
        none = torch.full((len(batch),), torch.nan)
        variance, confidence = (
            none if x is None else x for x in (answer.variance, answer.confidence)
        )
        parts.append((answer.mean, variance, confidence))
    true, source = true_channels(data, rows, frequency_hz)
    predicted, variance, confidence = map(torch.cat, zip(*parts, strict=True))
    return BandChannels(true[:, antennas], predicted, variance, confidence, source)


def true_channels(
    data: Measurements, rows: np.ndarray, frequency_hz: np.ndarray
) -> tuple[Tensor, str]:
    """Return true channels (n, A, K) in the data's units and frame, and how they were come by."""
    assert data.site.subcarriers_hz is not None
    if data.site.name == "argos-sim" and data.uplink is not None:
        return _of_streets(data, rows, frequency_hz), "rays"
    measured = data.targets(rows)
    return interpolate_tones(measured, data.site.subcarriers_hz, frequency_hz), (
        "measured tones, interpolated"
    )


def band_evidence(band: BandChannels, data: Measurements, fold: Fold, rows: np.ndarray) -> Evidence:
    """Return evidence of `rows`, whose channels `band` holds:
    a fade of this band is no fade of another.
    """
    prediction = Prediction(band.predicted, band.variance, 1 - band.confidence)
    return score_answers(
        prediction, band.true, rows, data.moving[rows], Trusted.from_fold(data, fold)
    )


@lru_cache(maxsize=1)
def _streets(*facts: int) -> World:
    from gsparc.simulate.argos_sim import draw_world

    return draw_world(*facts)


def _of_streets(data: Measurements, rows: np.ndarray, frequency_hz: np.ndarray) -> Tensor:
    """Rays at these frequencies, turned as each snapshot was (phase
    and timing, found on its uplink).
    """
    site, uplink = data.site, data.uplink
    assert uplink is not None and site.uplink_hz is not None and site.antennas is not None
    there = _streets(*(int(data.provenance[name]) for name in FACTS if name in data.provenance))
    heard = uplink[rows].astype(np.complex128) * site.target_scale
    # Simulated streets know the channel, but each snapshot was turned by its own phase and timing.
    clean = there.response(site.uplink_hz, rows)
    coarse = align_factors(heard, clean, site.uplink_hz, "phase+delay")
    # The grid of delays leaves a tenth of a nanosecond:
    # the slope of the remaining phase takes it out.
    rest = (heard * coarse[:, None] * clean.conj()).sum(1)
    away = site.uplink_hz - site.uplink_hz.mean()
    weight = np.abs(rest)
    middle = np.angle(rest.sum(1, keepdims=True))
    # About the middle phase: deviations then stay within +-pi and need no unwrapping.
    angle = np.angle(rest * np.exp(-1j * middle))
    mean = (weight * away).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    # Least squares weighed by power: slope and level of the phase over frequency.
    slope = (weight * (away - mean) * angle).sum(1) / (weight * (away - mean) ** 2).sum(1)
    level = ((weight * angle).sum(1) / weight.sum(1) - slope * mean[:, 0]) + middle[:, 0]
    wanted = there.response(frequency_hz, rows)[:, site.antennas]
    # The phase of a delay is a line over tones, which goes on beyond them as from one to the next.
    first, second = site.uplink_hz[:2]
    step = np.angle(coarse[:, 1:2] / coarse[:, :1]) / (second - first)
    turn = -np.angle(coarse[:, :1]) - step * (frequency_hz - first)
    turn = turn + level[:, None] + slope[:, None] * (frequency_hz - site.uplink_hz.mean())
    turned = wanted * np.exp(1j * turn)[:, None] / site.target_scale
    return torch.from_numpy(turned.astype(np.complex64))
