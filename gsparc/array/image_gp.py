"""A Gaussian process on whole images beside an array's vectors, both predicting the same left-out spectra."""

from __future__ import annotations

import numpy as np

from gsparc.array.cross_validation import LeftOut, without
from gsparc.methods.gp import choose_kernel

WEIGHTS = np.linspace(0, 1, 21)


def compared(left: LeftOut) -> tuple[float, float]:
    """How far a process of images is behind what was predicted [dB], and its best weight in their mean.

    On the same samples, gaps and pixels; its kernel is chosen on all of them.
    """
    mean = left.images.mean(0)
    vectors, lengths, _ = np.linalg.svd(left.images - mean, full_matrices=False)
    kernel = choose_kernel(left.positions, vectors * lengths, len(mean))
    inverse = np.linalg.inv(kernel.gram(left.positions))
    distance = np.linalg.norm(left.positions[:, None] - left.positions[None], axis=-1)
    said = mean + without(inverse, left.images - mean, distance, left.centres, left.gaps)[0]
    error = [left.mismatch_db((1 - w) * left.drawn + w * said) for w in WEIGHTS]
    return error[-1] - error[0], float(WEIGHTS[int(np.argmin(error))])
