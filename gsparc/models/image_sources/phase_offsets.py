"""Unknown phase and timing offsets of snapshots: y = h exp(j phi) exp(-j 2 pi (f - f_c) tau).

Measured channels have an unknown phase each, often an unknown delay too. With several tones or antennas
sources remain identifiable: phi and tau are estimated against the prediction of the sources found so far,
starting from the line of sight, and removed before the next search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Offsets = Literal["none", "phase", "phase_timing"]
DELAYS = 512  # tried over one period of the tones, then refined by a parabola


@dataclass(frozen=True)
class OffsetEstimate:
    """Offsets of S snapshots: phase (S,) [rad], delay (S,) [s]."""

    phase: np.ndarray
    delay: np.ndarray

    def removed(self, target: np.ndarray, frequency_hz: np.ndarray, carrier_hz: float) -> np.ndarray:
        """Return targets (S, A, K) without their offsets."""
        phasor = 2 * np.pi * (frequency_hz - carrier_hz) * self.delay[:, None] - self.phase[:, None]
        return (target * np.exp(1j * phasor)[:, None]).astype(target.dtype)


def estimate(
    target: np.ndarray,
    predicted: np.ndarray,
    frequency_hz: np.ndarray,
    carrier_hz: float,
    timing: bool,
    mask: np.ndarray | None = None,
) -> OffsetEstimate:
    """Return the offsets that maximise the correlation of snapshots with their predictions.

    Args:
        target, predicted: (S, A, K) complex.
        frequency_hz: (K,) [Hz]; the delay is sought within one period of their smallest spacing.
        carrier_hz: frequency at which a delay leaves the phase unchanged [Hz].
        timing: estimate a delay, too.
        mask: like target, True where measured; None for everywhere.
    """
    product = target * predicted.conj()
    per_tone = (product if mask is None else np.where(mask, product, 0)).sum(1)  # (S, K)
    delay = np.zeros(len(target))
    if timing and len(frequency_hz) > 1:
        period = 1 / np.diff(np.sort(frequency_hz)).min()
        tried = (np.arange(DELAYS) / DELAYS - 0.5) * period
        phasor = np.exp(2j * np.pi * np.outer(frequency_hz - carrier_hz, tried))
        correlation = np.abs(per_tone @ phasor)
        best = correlation.argmax(1)
        before, at, after = (correlation[np.arange(len(best)), (best + s) % DELAYS] for s in (-1, 0, 1))
        # Negative at a maximum; a flat correlation has no top.
        curvature = np.minimum(before - 2 * at + after, -1e-30)
        delay = tried[best] + 0.5 * (before - after) / curvature * (period / DELAYS)
    phasor = np.exp(2j * np.pi * (frequency_hz - carrier_hz) * delay[:, None])
    return OffsetEstimate(np.angle((per_tone * phasor).sum(1)), delay)
