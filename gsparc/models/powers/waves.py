"""Plane waves from everywhere as a basis of coherent fields at measured places,
and powers fitted by them.

Powers alone leave phases unknown: a fit is one of many, found by damped least squares from a random
start (Levenberg 1944, Marquardt 1963) on decibels, whose errors are Student's t (K. L. Lange et
al., "Robust statistical modeling using the t distribution", JASA 84 (1989)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import blas, eigh

from gsparc.models.channels.kernels import fibonacci_sphere
from gsparc.physics.decibels import RELATIVE_DB, to_decibels
from gsparc.processes.factor import Factor, NotDefiniteError
from gsparc.processes.stored import Stored

WAVES = 800  # on the sphere: twelve wavelengths of places are resolved
KEPT = 1e-3  # eigenvalues kept, of the largest
DEGREES = 4.0  # of freedom of the errors
SCALE_DB = 2.0  # of the errors at first
LEAST_DB = 0.5
ALIKE = 3.0  # rows that err together, as neighbours do: each counts a third
FLOOR = 3e-4  # power that no interference takes away, of the mean power
# Powers added to hide nulls at first, one stage after the other
HIDDEN = (0.1, 0.03, 0.01, 0.003, 0.0)
STEPS = 8  # of a stage, twice as many of the last
DAMPED = 4.0  # factor of the damping after a step that was none
TRIES, SETTLED = 4, 1e-4


@dataclass(frozen=True)
class PlaneWaveBasis(Stored):
    """Coherent fields of unit mean power at the places that they were made for.

    Attributes:
        waves: (M, 3) wave vectors [rad/m].
        mixture: (M, r) complex128, of the plane waves in each column.
    """

    waves: np.ndarray
    mixture: np.ndarray

    def plane_waves(self, places: np.ndarray) -> np.ndarray:
        """Return the plane waves (n, M) at places (n, 3) [m]."""
        return np.exp(1j * (places @ self.waves.T))

    def columns(self, places: np.ndarray) -> np.ndarray:
        """Return (n, r) complex128 at places (n, 3) [m]."""
        return self.plane_waves(places) @ self.mixture


def make_basis(places: np.ndarray, wavelength: float) -> PlaneWaveBasis:
    """Return combinations of plane waves, from everywhere alike, that places (n, 3) tell apart.

    A prior of equal powers from all sides is a field of correlation sin(kd) / (kd).
    """
    waves = 2 * math.pi / wavelength * fibonacci_sphere(WAVES).numpy()
    plane = PlaneWaveBasis(waves, np.eye(WAVES)).plane_waves(places)
    # One triangle of a Hermitian product: half the multiplications of all of it.
    values, vectors = eigh(blas.zherk(1 / len(places), plane, trans=2), lower=False)
    large = values > KEPT * values[-1]
    return PlaneWaveBasis(waves, vectors[:, large] / math.sqrt(values[large].sum()))


def field_db(field: np.ndarray) -> np.ndarray:
    """Return powers [dB] of complex fields of any shape, with the floor."""
    return to_decibels(np.abs(field) ** 2 + FLOOR)


def fit_wave_weights(
    columns: np.ndarray, decibels: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return complex weights (r,) of columns (n, r) whose powers are (n,)
    [dB about their mean power].

    A weight's prior is complex normal of variance 1.
    """
    count, single = columns.shape[1], columns.astype(np.complex64)
    weights: np.ndarray = rng.standard_normal((count, 2)) @ np.array([1, 1j]) / math.sqrt(2)
    weights /= math.sqrt(float((np.abs(columns @ weights) ** 2).mean()))
    scale, damping = SCALE_DB, 1e-2
    for hidden in HIDDEN:
        now = _Misfit.from_waves(columns, decibels, weights, hidden, scale)
        scale = now.error_scale()
        now = _Misfit.from_waves(columns, decibels, weights, hidden, scale)
        for _ in range(STEPS if hidden else 2 * STEPS):
            result = _step_and_damping(columns, single, decibels, now, hidden, scale, damping)
            if result is None:
                break
            better, damping = result
            settled, now = now.value - better.value < SETTLED * now.value, better
            if settled:
                break
        weights = now.weights
    return weights


@dataclass(frozen=True)
class _Misfit:
    """A negative log posterior at some weights, and what it is made of."""

    weights: np.ndarray
    field: np.ndarray
    power: np.ndarray
    error: np.ndarray
    value: float

    @classmethod
    def from_waves(
        cls,
        columns: np.ndarray,
        decibels: np.ndarray,
        weights: np.ndarray,
        hidden: float,
        scale: float,
    ) -> _Misfit:
        field = columns @ weights
        power = np.abs(field) ** 2 + FLOOR + hidden
        error = to_decibels(power) - decibels
        value = 0.5 * (DEGREES + 1) * float(np.log1p(error**2 / (DEGREES * scale**2)).sum())
        return cls(
            weights, field, power, error, value + ALIKE * float((np.abs(weights) ** 2).sum())
        )

    def error_scale(self) -> float:
        """Return that of the errors [dB], by a few steps of expectation maximisation."""
        result = SCALE_DB
        for _ in range(5):
            share = (DEGREES + 1) / (DEGREES + (self.error / result) ** 2)
            result = max(math.sqrt(float((share * self.error**2).mean())), LEAST_DB)
        return result


def _step_and_damping(
    columns: np.ndarray,
    single: np.ndarray,
    decibels: np.ndarray,
    now: _Misfit,
    hidden: float,
    scale: float,
    damping: float,
) -> tuple[_Misfit, float] | None:
    """A better place and the next damping; None where none was found."""
    count = columns.shape[1]
    # Single precision: a step need not be exact, its worth is judged in double.
    slope = (2 * RELATIVE_DB * now.field.conj() / now.power).astype(np.complex64)[:, None] * single
    jacobian = np.concatenate([slope.real, -slope.imag], 1)
    share = ((DEGREES + 1) / (DEGREES * scale**2 + now.error**2)).astype(np.float32)
    normal = ((jacobian.T * share) @ jacobian).astype(np.float64)
    right = (jacobian.T @ (share * now.error.astype(np.float32))).astype(np.float64)
    right += 2 * ALIKE * np.concatenate([now.weights.real, now.weights.imag])
    middle, diagonal = float(normal.diagonal().mean()), np.diag_indices(2 * count)
    normal[diagonal] += 2 * ALIKE
    for _ in range(TRIES):
        damped = normal.copy()
        damped[diagonal] += damping * middle
        try:
            factor = Factor.from_gram(torch.from_numpy(damped), "raise")
        except NotDefiniteError:  # rounding: more damping mends it
            damping *= DAMPED
            continue
        by = -factor.solve(torch.from_numpy(right)[:, None])[:, 0].numpy()
        new = _Misfit.from_waves(
            columns, decibels, now.weights + by[:count] + 1j * by[count:], hidden, scale
        )
        if new.value < now.value:
            return new, max(damping / 3, 1e-5)
        damping *= DAMPED
    return None
