"""Descent on the marginal likelihood: planes, amplitudes and noise together, then the visibility law."""

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

# Steps between two evaluations of the visibility: sources move millimetres, it varies in decimetres.
REFRESH = 16


@dataclass(frozen=True)
class Pace:
    """Step sizes of Adam.

    Attributes:
        offset: of a plane along its normal [m].
        normal: of a plane's unit normal.
        transmitter: [m]; small, its place is measured.
        logarithm: of amplitudes and noise.
    """

    offset: float = 0.004
    normal: float = 0.0012
    transmitter: float = 0.0004
    logarithm: float = 0.05


def rates(pace: Pace) -> list[Tensor]:
    """Step sizes of transmitter, planes, log amplitudes and log noise."""
    return [
        torch.tensor(pace.transmitter, dtype=torch.float64),
        torch.tensor([*[pace.normal] * 3, pace.offset], dtype=torch.float64),
        torch.tensor(pace.logarithm),
        torch.tensor(pace.logarithm),
    ]


def refine(rows: Rows, scene: Scene, steps: int, pace: Pace = Pace(), noise_floor: float = JITTER) -> Scene:
    """The best scene met in `steps` steps."""
    seen = torch.empty(0)

    def slopes(step: int, values: list[Tensor]) -> tuple[float, list[Tensor]]:
        nonlocal seen
        if step % REFRESH == 0:
            seen = correlations(rows, images(values[0], values[1], scene.words), scene.visibility)
        return _likelihood(rows, scene, values, seen, noise_floor)

    start = [scene.transmitter, scene.planes, scene.log_amplitude, torch.tensor(scene.log_noise)]
    best = descend(start, rates(pace), steps, slopes)
    return replace(
        scene, transmitter=best[0], planes=best[1], log_amplitude=best[2], log_noise=float(best[3])
    )


def _likelihood(
    rows: Rows, scene: Scene, values: list[Tensor], seen: Tensor, noise_floor: float
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and its gradient: `d nll = trace(G dK)`, `G = R K^-1 - alpha alpha^H`."""
    transmitter, planes = (v.detach().requires_grad_() for v in values[:2])
    waves = steering(rows, images(transmitter, planes, scene.words)) * scene.shade(rows.position)
    scaled = waves.detach() * values[2].exp()
    noise = values[3].exp()
    n = len(rows)
    real, imag = torch.zeros(n, n), torch.zeros(n, n)
    for k in range(len(scene.words)):
        add_covariance(real, imag, scaled[:, k], seen[k])
    real.diagonal().add_(noise + noise_floor)
    factor = Factor.of(torch.complex(real, imag), rows.target)
    slope = rows.target.shape[1] * factor.inverse - factor.alpha @ factor.alpha.mH
    slope_re, slope_im = slope.real.contiguous(), slope.imag.contiguous()
    pulled = torch.empty_like(scaled)  # (G * C_k) s_k a_k
    for k in range(len(scene.words)):
        pair = torch.stack([scaled[:, k].real, scaled[:, k].imag], 1)
        a = (slope_re * seen[k]) @ pair
        b = (slope_im * seen[k]) @ pair
        pulled[:, k] = torch.complex(a[:, 0] - b[:, 1], a[:, 1] + b[:, 0])
    by_amplitude = 2 * (scaled.conj() * pulled).sum(0).real
    by_noise = noise * slope_re.diagonal().sum()
    by_wave = 2 * pulled * values[2].exp()
    by_place = torch.autograd.grad(waves, [transmitter, planes], by_wave, allow_unused=True)
    zeros = [torch.zeros_like(transmitter), torch.zeros_like(planes)]
    places = [z if g is None else g for g, z in zip(by_place, zeros, strict=True)]
    return factor.nll, [*places, by_amplitude, by_noise]


def learn_visibility(
    rows: Rows, scene: Scene, steps: int, start: KernelVisibility, spread: float = 0.5
) -> Scene:
    """The three numbers of a `KernelVisibility` by likelihood, held near `start` by a log-normal prior.

    Without the prior the lengths collapse and explain the power of sources not found yet.

    Args:
        rows: a few hundred are enough.
        scene: with a `KernelVisibility`.
        steps: of Adam.
        start: centre of the prior.
        spread: standard deviation of the prior in logarithms (and the logit of `constant`).
    """
    law = scene.visibility
    if not isinstance(law, KernelVisibility):
        return scene
    centre, value = _logarithms(start), _logarithms(law).requires_grad_()
    optimizer = torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.95))
    for _ in range(steps):
        current = replace(scene, visibility=_law(value.detach()))
        posterior = Posterior(rows, current)
        factor = posterior.factor
        slope = rows.target.shape[1] * factor.inverse - factor.alpha @ factor.alpha.mH
        scaled = posterior.waves * scene.log_amplitude.exp()
        optimizer.zero_grad()
        for k, source in enumerate(current.sources):
            view = View.of(rows.position, source)
            weight = (slope.conj() * scaled[:, k, None] * scaled[:, k].conj()).real
            (weight * _law(value).correlation(view, view)).sum().backward()
        ((value - centre).square().sum() / spread**2).backward()
        optimizer.step()
    return replace(scene, visibility=KernelVisibility(*(float(v) for v in _numbers(value.detach()))))


def _logarithms(law: KernelVisibility) -> Tensor:
    constant = min(max(float(law.constant), 0.02), 0.995)
    return torch.tensor([math.log(constant / (1 - constant)), math.log(law.angle), math.log(law.length)])


def _numbers(value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return torch.sigmoid(value[0]), value[1].exp(), value[2].exp()


def _law(value: Tensor) -> KernelVisibility:
    return KernelVisibility(*_numbers(value))
