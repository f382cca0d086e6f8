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

from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import Clutter
from gsparc.models.image_sources.gp_likelihood import JITTER, CircularGains, Posterior, Scene
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.processes.conditioned import Conditioned


@final
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


def shares(quadrature: Tensor | float) -> Tensor:
    """Variance along and across a gain's phase, (2,)."""
    return torch.tensor([1 - quadrature / 2, quadrature / 2])


class PhasedGains(CircularGains):
    """The same of gains of fixed phases, of 2 n real numbers; waves are turned by these."""

    def __init__(self, rows: Rows, quadrature: Tensor | float) -> None:
        self.target, n = rows.target, len(rows)
        self.quadrature, self._sum = quadrature, torch.zeros(2, n, 2, n)

    @property
    def matrix(self) -> Tensor:
        """(2 n, 2 n) float32."""
        return self._sum.view(2 * len(self.target), -1)

    def add(self, scaled: Tensor, correlation: Tensor) -> None:
        """Add one source, with waves s_k w_k."""
        pair = torch.stack(stacked(scaled), 1)
        product = (pair * shares(self.quadrature)) @ pair.T
        self._sum.addcmul_(product.view_as(self._sum), correlation[None, :, None, :])

    def given(self, noise: Tensor | float) -> Conditioned:
        """The rows' targets, half of the noise in either part."""
        self.matrix.diagonal().add_(noise / 2)
        return Conditioned.of(self.matrix, stacked(self.target)[0])

    def by_waves(self, slope: Tensor, scaled: Tensor, correlation: Tensor) -> Tensor:
        """See `CircularGains`."""
        n, found = len(scaled), torch.empty_like(scaled)
        blocks = slope.view(2, n, 2, n)
        for k, one in enumerate(correlation):
            pair = torch.stack(stacked(scaled[:, k]), 1) * shares(self.quadrature)
            by = (blocks * one[None, :, None, :]).view(2 * n, 2 * n) @ pair
            # p = (Re, Im) and q = (-Im, Re): the derivatives by Re and Im collect both
            found[:, k] = torch.complex(by[:n, 0] + by[n:, 1], by[n:, 0] - by[:n, 1])
        return found

    def by_noise(self, slope: Tensor) -> Tensor:
        """See `CircularGains`."""
        return slope.diagonal().sum() / 4

    def by_correlation(self, slope: Tensor, scaled: Tensor) -> Tensor:
        """See `CircularGains`; differentiable in `quadrature`."""
        n, share = len(scaled), torch.as_tensor(self.quadrature) / 2
        weighted = ((slope * z[:, None] * z).view(2, n, 2, n).sum((0, 2)) for z in stacked(scaled))
        along, across = weighted
        return ((1 - share) * along + share * across) / 2


class PhasedPosterior(Posterior):
    """Posterior of a phased scene's gains given rows; `waves` are w_k."""

    def __init__(self, rows: Rows, phased: PhasedScene, noise_floor: float = JITTER) -> None:
        super().__init__(rows, phased.scene, noise_floor)
        self.phased = phased

    @cached_property
    def waves(self) -> Tensor:
        """w_k at the rows, (n, K) complex64."""
        return self.phased.waves(self.rows)

    def gains(self) -> PhasedGains:
        """Of no source yet."""
        return PhasedGains(self.rows, self.phased.quadrature)

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
