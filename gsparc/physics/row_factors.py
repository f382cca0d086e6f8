"""What a receiver multiplies all of one packet by: a phase, a delay, a gain that nobody knows.

Wi-Fi cards start a packet at a sample of their own (a delay, a slope of the phase over
subcarriers), with an oscillator of their own (a phase) and a gain of their own (S. Sen et al., "You
are facing the Mona Lisa: spot localization using PHY layer information", MobiSys 2012; M.
Kotaru et al., "SpotFi", SIGCOMM 2015).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

UnknownFactor = Literal["none", "phase", "phase+delay", "phase+delay+gain"]
UNKNOWN_FACTORS: tuple[UnknownFactor, ...] = get_args(UnknownFactor)
FINE = 8  # delays tried within one over the bandwidth
MOST_DELAYS = 1024
AT_ONCE = 4_096  # rows whose delays are tried together: memory


def describe_factor(unknown_factor: UnknownFactor) -> str:
    """Say in words what is free, for messages: `a phase and a delay`.

    >>> describe_factor("phase+delay+gain")
    'a phase, a delay and a gain'
    """
    parts = [f"a {part}" for part in unknown_factor.split("+")]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def resolvable_delays(tones: np.ndarray) -> np.ndarray:
    """Return delays (T,) [s] that tones (K,) [Hz] tell apart, evenly spaced about 0.

    >>> delays = resolvable_delays(np.array([0.0, 1e6, 2e6]))
    >>> len(delays), float(delays[-1])
    (17, 5e-07)
    """
    tones = np.sort(tones)
    width, gaps = tones[-1] - tones[0], np.diff(tones)
    if width <= 0:
        return np.zeros(1)
    step = 1 / (FINE * width)
    # Tones df apart cannot tell delays that differ by 1 / df: half of that on either side.
    half = min(int(0.5 / (gaps[gaps > 0].min() * step)), MOST_DELAYS // 2)
    return step * np.arange(-half, half + 1)


def align_factors(
    values: np.ndarray, reference: np.ndarray, tones: np.ndarray, unknown_factor: UnknownFactor
) -> np.ndarray:
    """Return factors (n, K) that turn rows to their references best; 1 where nothing is free.

    The delay is the largest of the correlation over tones, between samples by a parabola.

    >>> reference = np.ones((1, 2, 8), complex)  # of one row: two antennas, eight tones
    >>> factor = align_factors(1j * reference, reference, np.arange(8) * 1e6, "phase")
    >>> bool(np.allclose(factor[:, None] * 1j * reference, reference))
    True

    Args:
        values: (n, A, K) complex, 0 where nothing was measured.
        reference: (n, A, K) complex.
        tones: (K,) [Hz].
        unknown_factor: what of a row is free.
    """
    if unknown_factor == "none":
        return np.ones((len(values), len(tones)), np.complex128)
    if len(values) > AT_ONCE:
        parts = np.array_split(np.arange(len(values)), -(-len(values) // AT_ONCE))
        return np.concatenate(
            [align_factors(values[part], reference[part], tones, unknown_factor) for part in parts]
        )
    product = (values * reference.conj()).sum(1)
    slope = np.zeros(len(values))
    delays = resolvable_delays(tones) if unknown_factor != "phase" else np.zeros(1)
    if len(delays) > 2:
        steering = np.exp(2j * np.pi * delays[:, None] * (tones - tones.mean()))
        size = np.abs(product @ steering.T)
        rows, best = np.arange(len(size)), size.argmax(1).clip(1, len(delays) - 2)
        before, peak, after = (size[rows, best + by] for by in (-1, 0, 1))
        # The vertex of a parabola through the largest and both neighbours; never flat,
        # so that it exists.
        curvature = np.minimum(before - 2 * peak + after, -np.finfo(float).tiny)
        slope = delays[best] + (0.5 * (before - after) / curvature).clip(-1, 1) * (
            delays[1] - delays[0]
        )
    turned = np.exp(2j * np.pi * slope[:, None] * (tones - tones.mean()))
    overlap = (product * turned).sum(1)
    factor = turned * np.exp(-1j * np.angle(overlap))[:, None]
    if unknown_factor == "phase+delay+gain":
        power = (np.abs(values) ** 2).sum((1, 2))
        # The gain of least squares; a row of zeros keeps 1.
        factor *= np.divide(np.abs(overlap), power, out=np.ones_like(power), where=power > 0)[
            :, None
        ]
    return factor
