"""Kernel length and noise of the vector GP by cross-validation
with a gap around each held-out sample.

Plain leave-one-out tests interpolation over millimetres only and picks a length that fails beyond
them. Here each sample is predicted without all others within a gap, for several gaps; the score is
the PSNR of the spectra, averaged over samples and gaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from gsparc.models.array_vectors.vector_gp import align_along_tree, refine_alignment
from gsparc.models.splat.left_out_images import LeftOut, mean_log_error, means_and_variances
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import sample_row_numbers
from gsparc.processes.kernel import Kernel, SmoothRough

GAPS = (0.0, 0.1, 0.2, 0.4)  # wavelengths: spacings that queries have to the nearest sample
PIXELS = 600  # drawn from the grid: the score needs no more
ROWS = 384  # neighbouring samples used: the inverse costs their cube
CENTRES = 160  # of them predicted
STEPS = 36  # evaluations of Nelder-Mead
LENGTHS, NOISE = (0.25, 0.5), 0.005  # to start from: lengths [wavelengths], and the noise
LEAST, LARGEST = (0.02, 1e-4), (5.0, 1.0)  # length and noise
FEW = 4  # samples, of fewer than which none is predicted


@dataclass(frozen=True)
class ChosenKernel:
    """The chosen kernel and its held-out errors.

    Attributes:
        kernel: length and noise.
        unknown: (k,) posterior variance of each held-out prediction, as a share of the prior's.
        error: (k,) mean squared error of its spectrum.
        left_out: the held-out predictions; None for too few samples.
    """

    kernel: Kernel
    unknown: np.ndarray
    error: np.ndarray
    left_out: LeftOut | None = None


def choose_kernel(
    vectors: np.ndarray,
    positions: np.ndarray,
    images: np.ndarray,
    matrix: np.ndarray,
    wavelength: float,
    partner: np.ndarray | None,
    seed: int = 0,
) -> ChosenKernel:
    """Choose the kernel of the least mean logarithm of errors at rows left out;
    return these errors, too.

    Args:
        vectors: (n, M) complex, phases and twins unknown.
        positions: (n, 3) [m].
        images: (n, P) in [0, 1].
        matrix: (M, P) steering.
        wavelength: [m].
        partner: of `index_mirror_elements`.
        seed: of the neighbourhood, the predicted samples and the pixels.
    """
    rng = np.random.default_rng([seed, 3])
    background = images.mean(0, dtype=np.float64)
    if len(positions) > ROWS:
        centre = positions[rng.integers(len(positions))]
        rows = np.argsort(np.linalg.norm(positions - centre, axis=1))[:ROWS]
        vectors, positions, images = vectors[rows], positions[rows], images[rows]
    pixels = rng.choice(images.shape[1], min(PIXELS, images.shape[1]), replace=False)
    samples = _Samples(
        images=images[:, pixels].astype(np.float64),
        matrix=matrix[:, pixels].conj(),
        background=background[pixels] ** 2,
        centres=sample_row_numbers(len(positions), CENTRES, rng),
        gaps=np.array(GAPS) * wavelength,
        distance=cdist(positions, positions),
    )
    aligned = align_along_tree(vectors, positions, partner)

    def kernel_at(parameters: np.ndarray) -> Kernel:
        length, noise = np.exp(np.clip(parameters, np.log(LEAST), np.log(LARGEST)))
        return Kernel.from_length(float(length * wavelength), float(noise), term=SmoothRough)

    def inverse_gram(kernel: Kernel) -> np.ndarray:
        return Factor.from_gram(kernel.gram(torch.from_numpy(positions))).inverse.numpy()

    def held_out_log_error(
        parameters: np.ndarray, start: np.ndarray = aligned, sweeps: int = 4
    ) -> float:
        kernel = kernel_at(parameters)
        inverse = inverse_gram(kernel)
        predicted = samples.predict(
            kernel, inverse, refine_alignment(start, inverse, partner, sweeps)
        )[1]
        return mean_log_error(samples.squared_errors(predicted))  # up to a factor, minus the PSNR

    starts = [np.log([length, NOISE]) for length in LENGTHS]
    # Rows of one place lie within every gap: none is left to predict another.
    if len(positions) < FEW or samples.distance[samples.centres].max() <= samples.gaps.min():
        return ChosenKernel(kernel_at(starts[0]), np.array([0.0, 1.0]), np.array([0.0, 1e-2]))
    first = min(starts, key=held_out_log_error)
    refined = refine_alignment(aligned, inverse_gram(kernel_at(first)), partner)
    optimum = minimize(
        held_out_log_error,
        first,
        args=(refined,),
        method="Nelder-Mead",
        options={
            "maxfev": STEPS,
            "xatol": 0.03,
            "fatol": 1e-3,
            "initial_simplex": first + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, -1.0]]),
        },
    )
    kernel = kernel_at(optimum.x)
    inverse = inverse_gram(kernel)
    unknown, predicted = samples.predict(
        kernel, inverse, refine_alignment(refined, inverse, partner)
    )
    error = samples.squared_errors(predicted)
    seen = ~np.isnan(error)
    left_out = LeftOut(positions, samples.images, samples.centres, samples.gaps, predicted)
    return ChosenKernel(kernel, unknown[seen], error[seen], left_out)


@dataclass(frozen=True)
class _Samples:
    images: np.ndarray
    matrix: np.ndarray
    background: np.ndarray
    centres: np.ndarray
    gaps: np.ndarray
    distance: np.ndarray

    def predict(
        self, kernel: Kernel, inverse: np.ndarray, vectors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the posterior variance (g, c) and spectra (g, c, P) of held-out samples.

        NaN where no other is left.
        """
        mean, variance = means_and_variances(
            inverse, vectors, self.distance, self.centres, self.gaps
        )
        unknown = np.clip(variance - kernel.noise, 0.0, 1.0)
        power = np.abs(mean @ self.matrix) ** 2 + unknown[..., None] * self.background
        return unknown, np.sqrt(power)

    def squared_errors(self, predicted: np.ndarray) -> np.ndarray:
        """Return (g, c) mean squared."""
        return ((predicted - self.images[self.centres]) ** 2).mean(-1)
