"""Maximise the marginal likelihood over planes, amplitudes and noise, and over the visibility kernel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsparc.multipath.adam import descend
from gsparc.multipath.gp_likelihood import (
    JITTER,
    Factor,
    Posterior,
    Scene,
    add_covariance,
    correlations,
    steering,
)
from gsparc.multipath.rows import Rows
from gsparc.multipath.visibility_kernel import KernelVisibility, View
from gsparc.physics.mirror_planes import images

# Steps between evaluations of the visibility kernel: sources move millimetres, it varies over decimetres.
REFRESH = 16


@dataclass(frozen=True)
class StepSizes:
    """Step sizes of Adam.

    Attributes:
        offset: of a plane along its normal [m].
        normal: of a plane's unit normal.
        transmitter: [m]; small, its position is measured.
        logarithm: of amplitudes and noise.
    """

    offset: float = 0.004
    normal: float = 0.0012
    transmitter: float = 0.0004
    logarithm: float = 0.05


def rates(step_sizes: StepSizes) -> list[Tensor]:
    """Step sizes of transmitter, planes, log amplitudes and log noise."""
    return [
        torch.tensor(step_sizes.transmitter, dtype=torch.float64),
        torch.tensor([*[step_sizes.normal] * 3, step_sizes.offset], dtype=torch.float64),
        torch.tensor(step_sizes.logarithm),
        torch.tensor(step_sizes.logarithm),
    ]


def refine(
    rows: Rows, scene: Scene, steps: int, step_sizes: StepSizes = StepSizes(), noise_floor: float = JITTER
) -> Scene:
    """The best scene of `steps` steps."""
    correlation = torch.empty(0)

    def objective(step: int, values: list[Tensor]) -> tuple[float, list[Tensor]]:
        nonlocal correlation
        if step % REFRESH == 0:
            correlation = correlations(rows, images(values[0], values[1], scene.words), scene.visibility)
        return _likelihood(rows, scene, values, correlation, noise_floor)

    start = [scene.transmitter, scene.planes, scene.log_amplitude, torch.tensor(scene.log_noise)]
    best = descend(start, rates(step_sizes), steps, objective)
    return replace(
        scene, transmitter=best[0], planes=best[1], log_amplitude=best[2], log_noise=float(best[3])
    )


def _likelihood(
    rows: Rows, scene: Scene, values: list[Tensor], correlation: Tensor, noise_floor: float
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and its gradient: `d nll = trace(G dK)`, `G = R K^-1 - alpha alpha^H`."""
    transmitter, planes = (v.detach().requires_grad_() for v in values[:2])
    waves = steering(rows, images(transmitter, planes, scene.words)) * scene.visible_share(rows.position)
    scaled = waves.detach() * values[2].exp()
    noise = values[3].exp()
    n = len(rows)
    real, imag = torch.zeros(n, n), torch.zeros(n, n)
    for k in range(len(scene.words)):
        add_covariance(real, imag, scaled[:, k], correlation[k])
    real.diagonal().add_(noise + noise_floor)
    factor = Factor.of(torch.complex(real, imag), rows.target)
    slope = rows.target.shape[1] * factor.inverse - factor.alpha @ factor.alpha.mH
    slope_re, slope_im = slope.real.contiguous(), slope.imag.contiguous()
    weighted = torch.empty_like(scaled)  # (G * C_k) s_k a_k
    for k in range(len(scene.words)):
        pair = torch.stack([scaled[:, k].real, scaled[:, k].imag], 1)
        a = (slope_re * correlation[k]) @ pair
        b = (slope_im * correlation[k]) @ pair
        weighted[:, k] = torch.complex(a[:, 0] - b[:, 1], a[:, 1] + b[:, 0])
    by_amplitude = 2 * (scaled.conj() * weighted).sum(0).real
    by_noise = noise * slope_re.diagonal().sum()
    by_wave = 2 * weighted * values[2].exp()
    by_place = torch.autograd.grad(waves, [transmitter, planes], by_wave, allow_unused=True)
    zeros = [torch.zeros_like(transmitter), torch.zeros_like(planes)]
    places = [z if g is None else g for g, z in zip(by_place, zeros, strict=True)]
    return factor.nll, [*places, by_amplitude, by_noise]


def learn_visibility(
    rows: Rows, scene: Scene, steps: int, start: KernelVisibility, spread: float = 0.5
) -> Scene:
    """Parameters of the visibility kernel by likelihood, with a log-normal prior about `start`.

    Without the prior the lengths collapse to explain the power of sources not found yet.

    Args:
        rows: a few hundred are enough.
        steps: of Adam.
        start: centre of the prior.
        spread: standard deviation of the prior in logarithms (and the logit of `constant`).
    """
    kernel = scene.visibility
    centre, value = _logarithms(start), _logarithms(kernel).requires_grad_()
    optimizer = torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.95))
    for _ in range(steps):
        current = replace(scene, visibility=_kernel(value.detach()))
        posterior = Posterior(rows, current)
        factor = posterior.factor
        slope = rows.target.shape[1] * factor.inverse - factor.alpha @ factor.alpha.mH
        scaled = posterior.waves * scene.log_amplitude.exp()
        optimizer.zero_grad()
        for k, source in enumerate(current.sources):
            view = View.of(rows.position, source)
            weight = (slope.conj() * scaled[:, k, None] * scaled[:, k].conj()).real
            (weight * _kernel(value).correlation(view, view)).sum().backward()
        ((value - centre).square().sum() / spread**2).backward()
        optimizer.step()
    return replace(scene, visibility=KernelVisibility(*(float(v) for v in _parameters(value.detach()))))


def _logarithms(kernel: KernelVisibility) -> Tensor:
    constant = min(max(float(kernel.constant), 0.02), 0.995)
    return torch.tensor(
        [math.log(constant / (1 - constant)), math.log(kernel.angle), math.log(kernel.length)]
    )


def _parameters(value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return torch.sigmoid(value[0]), value[1].exp(), value[2].exp()


def _kernel(value: Tensor) -> KernelVisibility:
    return KernelVisibility(*_parameters(value))
