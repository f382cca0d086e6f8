"""Gaussian process on whole images against the vector GP, both on the same held-out spectra."""

from __future__ import annotations

import numpy as np

from gsparc.array.cross_validation import LeftOut, predict_left_out
from gsparc.methods.gp import choose_kernel

WEIGHTS = np.linspace(0, 1, 21)  # candidates of the ensemble weight


def compared(left: LeftOut) -> tuple[float, float]:
    """Loss in PSNR [dB] of a Gaussian process on images to the array model, and its best ensemble weight.

    On the same samples, gaps and pixels; the kernel is chosen on all samples.
    """
    mean = left.images.mean(0)
    vectors, lengths, _ = np.linalg.svd(left.images - mean, full_matrices=False)
    kernel = choose_kernel(left.positions, vectors * lengths, len(mean))
    inverse = np.linalg.inv(kernel.gram(left.positions))
    distance = np.linalg.norm(left.positions[:, None] - left.positions[None], axis=-1)
    predicted = mean + predict_left_out(inverse, left.images - mean, distance, left.centres, left.gaps)[0]
    error = [left.mismatch_db((1 - w) * left.predicted + w * predicted) for w in WEIGHTS]
    return error[-1] - error[0], float(WEIGHTS[int(np.argmin(error))])
