"""A process of complex values with a short and a long length, chosen by evidence in units of a wavelength.

Of channels whose rows were turned to be like their neighbours, the carrier's phase is gone: what is left
varies within a fraction of a wavelength where paths interfere, and over many as the strongest does.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from gsparc.processes.density import SETTLED, ProfiledDensity, covariance_of, fit_kernel
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.kernel import Kernel, distances

SHORT, LONG = (0.25, 1.0), (1.0, 300.0)  # wavelengths; next to no field varies within a quarter
START = (0.37, 2.8)
SPANS = 3.0  # spacings between places, that the longer length starts from at least
NOISES = (1e-4, 10.0)  # of the signal's power
LOGIT = 6.0  # of the shares
LEARNED_ON = 400  # rows
LOOKS = 8


def initial_kernel(length: float, spacing: float = 0.0) -> Kernel:
    """Return the kernel before anything was learned.

    `length` is a wavelength, or what stands for it; `spacing` between places, which the longer one spans [m].

    >>> [round(length, 3) for length in initial_kernel(0.1).lengths]
    [0.037, 0.28]
    """
    lengths = START[0] * length, max(START[1] * length, SPANS * spacing)
    return Kernel.from_lengths(lengths, (0.5, 0.5), 0.01)


def fit_two_lengths(places: np.ndarray, values: np.ndarray, length: float, start: Kernel) -> Kernel:
    """Return the kernel of largest evidence near `start`.

    Args:
        places: (n, D) [m].
        values: (n, P) complex.
        length: see `initial_kernel`.
        start: where to begin.
    """
    rows = covering_rows(places, LEARNED_ON, 0)
    at = torch.from_numpy(places[rows])
    # Parts of a circular value are independent and alike: twice as many outputs.
    real = torch.from_numpy(np.concatenate([values[rows].real, values[rows].imag], 1)).double()
    bounds = [
        *((math.log(low * length), math.log(high * length)) for low, high in (SHORT, LONG)),
        (-LOGIT, LOGIT), (math.log(NOISES[0]), math.log(NOISES[1])),
    ]  # fmt: skip
    distance = distances(at, at)
    evidence = lambda kernel: ProfiledDensity.apply(covariance_of(kernel, distance), real)  # noqa: E731
    return fit_kernel(evidence, [start], bounds, LOOKS, SETTLED / real.numel())[1]
