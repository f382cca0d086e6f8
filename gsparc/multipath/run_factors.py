"""Complex factors of runs: each run of measurements is the channel times one unknown complex number.

With aligned rows `u_i y_i` a circular Gaussian process of covariance `P C`, the likelihood of the factors
needs the data only as `M_rs = sum over i in r, j in s of conj(y_i) C^-1_ij y_j`: quadratic in u but for the
logarithm of its size, so that each factor has a closed form given the others.
"""

from __future__ import annotations

import numpy as np

SWEEPS = 200
SETTLED = 1e-9


def run_factors(inverse: np.ndarray, target: np.ndarray, run: np.ndarray) -> np.ndarray:
    """What rows must be multiplied by to belong to the largest run, (runs,) complex128 of largest likelihood.

    Args:
        inverse: (n, n) inverse of the rows' covariance.
        target: (n, D) complex.
        run: (n,) int, numbers 0 to runs - 1, each of which occurs.
    """
    count = np.bincount(run)
    return aligning(run_quadratic(inverse, target, run), target.shape[1] * count)


def run_quadratic(inverse: np.ndarray, target: np.ndarray, run: np.ndarray) -> np.ndarray:
    """M (runs, runs) complex128 of the module's text, of arguments as in `run_factors`."""
    member = np.eye(int(run.max()) + 1)[run]
    return member.T @ (inverse * (target.conj() @ target.T)) @ member


def aligning(quadratic: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The factors (runs,) from M (runs, runs), of one process or summed over many, and each run's numbers.

    Args:
        size: (runs,) complex numbers measured in each, above 0; the largest has factor 1.
    """
    scale = np.sqrt(size)
    # The eigenvector of least residual power is right but for the logarithm, and near enough to start from.
    factors = np.linalg.eigh(quadratic / np.outer(scale, scale))[1][:, 0] / scale
    factors = np.where(np.abs(factors) > 1e-6 * np.abs(factors).max(), factors, np.abs(factors).max())
    own = quadratic.diagonal().real
    for _ in range(SWEEPS):
        before = factors.copy()
        power = float((factors.conj() @ quadratic @ factors).real) / size.sum()
        for r in range(len(size)):
            others = own[r] * factors[r] - quadratic[r] @ factors
            pull = abs(others)
            length = (pull + np.sqrt(pull**2 + 4 * own[r] * power * size[r])) / max(2 * own[r], 1e-300)
            factors[r] = length * (others / pull if pull > 0 else 1.0)
        if np.abs(factors - before).max() <= SETTLED * np.abs(factors).max():
            break
    return factors / factors[size.argmax()]
