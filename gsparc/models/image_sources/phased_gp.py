"""Gains of constant phase: the final process, once the sources are known.

The phase of a reflection is the same at all places; what varies is the visible share of a source. So `g_k(x)
= exp(j phi_k) (u_k(x) + j v_k(x))` with real Gaussian processes u_k and v_k, and nearly all the variance in
u_k: a share `quadrature / 2` is in v_k (1 / 2 would be the circular process of
`gp_likelihood`). In real and imaginary parts, n complex rows are 2 n real numbers of
covariance
    sum_k s_k^2 C_k * [(1 - quadrature / 2) p p^T + quadrature / 2 q q^T] + noise / 2

with p = (Re w_k, Im w_k), q = (-Im w_k, Re w_k), w_k = a_k exp(j phi_k). It halves what must be learned of
each source's visibility; the phases must be known first, so the search itself stays circular.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import Clutter
from gsparc.models.image_sources.gp_likelihood import JITTER, Posterior, Scene
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.processes.conditioned import Conditioned


@dataclass(frozen=True)
class PhasedScene:
    """A scene whose gains have fixed phases.

    Attributes:
        scene: positions, amplitudes, visibility, noise.
        phase: (K,) float32 [rad], phi_k.
        quadrature: in (0, 1], twice the share of a gain's variance in quadrature to its phase; 1 with several
            outputs, which have no common phase.
    """

    scene: Scene
    phase: Tensor
    quadrature: float

    @staticmethod
    def of(rows: Rows, scene: Scene, quadrature: float) -> PhasedScene:
        """Phases of each source's mean gain under the circular process."""
        posterior = Posterior(rows, scene)
        gain = (posterior.waves.mH @ posterior.conditioned.weights).sum(1)
        return PhasedScene(scene, gain.angle(), quadrature if rows.target.shape[1] == 1 else 1.0)

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        scene, kernel = self.scene, self.scene.visibility
        return {
            "transmitter": scene.transmitter,
            "planes": scene.planes,
            "sequences": [list(sequence) for sequence in scene.sequences],
            "log_amplitude": scene.log_amplitude,
            "log_noise": scene.log_noise,
            "visibility": [float(kernel.constant), float(kernel.angle), float(kernel.length)],
            "phase": self.phase,
            "turning": self.quadrature,
            "boxes": scene.clutter.boxes,
            "patches": scene.clutter.patches,
            "patched": list(scene.clutter.plane),
        }

    @staticmethod
    def from_state(state: dict[str, Any]) -> PhasedScene:
        """Inverse of `state`."""
        sequences, kernel = tuple(map(tuple, state["sequences"])), KernelVisibility(*state["visibility"])
        clutter = Clutter(state["boxes"], state["patches"], tuple(state["patched"]))
        sources = (sequences, state["log_amplitude"], float(state["log_noise"]))
        scene = Scene(state["transmitter"], state["planes"], *sources, kernel, clutter)
        return PhasedScene(scene, state["phase"], float(state["turning"]))

    def waves(self, rows: Rows) -> Tensor:
        """w_k at the rows, (n, K) complex64."""
        return self.scene.waves(rows) * torch.polar(torch.ones(()), self.phase)

    def unobstructed(self, rows: Rows) -> Tensor:
        """The same without clutter."""
        return self.scene.unobstructed(rows) * torch.polar(torch.ones(()), self.phase)


def stacked(waves: Tensor) -> tuple[Tensor, Tensor]:
    """p and q, each (2 n, ...) float32, of complex (n, ...)."""
    return torch.cat([waves.real, waves.imag]), torch.cat([-waves.imag, waves.real])


def shares(quadrature: float) -> Tensor:
    """Variance along and across a gain's phase, (2,)."""
    return torch.tensor([1 - quadrature / 2, quadrature / 2])


def add_source(covariance: Tensor, wave: Tensor, quadrature: float, correlation: Tensor) -> None:
    """Add one source to a covariance (2, n, 2, n); `wave` (n,) complex is s_k w_k."""
    pair = torch.stack(stacked(wave), 1)
    covariance.addcmul_(
        ((pair * shares(quadrature)) @ pair.T).view_as(covariance), correlation[None, :, None, :]
    )


def given(covariance: Tensor, target: Tensor) -> Conditioned:
    """Targets (n, R) complex as 2 n real numbers, given their covariance (2, n, 2, n), noise included."""
    size = 2 * len(target)
    return Conditioned.of(covariance.reshape(size, size), stacked(target)[0])


class PhasedPosterior:
    """Posterior of a phased scene's gains given rows."""

    def __init__(self, rows: Rows, phased: PhasedScene, noise_floor: float = JITTER) -> None:
        self.rows, self.phased, self.noise_floor = rows, phased, noise_floor
        self.scene = phased.scene

    @cached_property
    def waves(self) -> Tensor:
        """w_k at the rows, (n, K) complex64."""
        return self.phased.waves(self.rows)

    @cached_property
    def conditioned(self) -> Conditioned:
        """The rows' targets given their covariance."""
        n, scene = len(self.rows), self.scene
        covariance = torch.zeros(2, n, 2, n)
        for k, source in enumerate(scene.sources):
            scaled = self.waves[:, k] * scene.log_amplitude[k].exp()
            correlation = scene.visibility.correlation(self.rows.places, source)
            add_source(covariance, scaled, self.phased.quadrature, correlation)
        noise = math.exp(scene.log_noise) + self.noise_floor
        covariance.view(2 * n, 2 * n).diagonal().add_(noise / 2)
        return given(covariance, self.rows.target)

    @property
    def dual_weights(self) -> Tensor:
        """Dual weights of u_k + j v_k (K, n, R) complex64, before the correlation over places."""
        n, (along, across) = len(self.rows), shares(self.phased.quadrature)
        alpha = torch.complex(*self.conditioned.weights.split(n))
        power = self.scene.log_amplitude.mul(2).exp()
        circular = (self.waves.conj() * power).T[:, :, None] * alpha
        return torch.complex(along * circular.real, across * circular.imag)

    @property
    def mean_gains(self) -> Tensor:
        """Constant part of each source's gain (K, R) complex64."""
        return (
            float(self.scene.visibility.constant)
            * self.dual_weights.sum(1)
            * torch.polar(torch.ones(()), self.phased.phase)[:, None]
        )

    def left_out(self) -> Tensor:
        """Leave-one-receiver-out predictions (n, R) complex64.

        Rasmussen and Williams (2006), eq. 5.12, in blocks.
        """
        n = len(self.rows)
        order = torch.argsort(self.rows.receiver, stable=True)
        counts = torch.unique_consecutive(self.rows.receiver[order], return_counts=True)[1]
        groups = (torch.cat([group, group + n]) for group in order.split(counts.tolist()))
        error, _ = self.conditioned.left_out(groups)
        return self.rows.target - torch.complex(error[:n], error[n:])
