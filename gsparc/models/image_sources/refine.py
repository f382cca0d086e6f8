"""Maximise the marginal likelihood over planes, amplitudes and noise, and over the visibility kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import (
    JITTER,
    Posterior,
    Scene,
    add_covariance,
    correlations,
    steering,
)
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.physics.mirror_planes import images
from gsparc.processes.conditioned import Conditioned

# Steps between evaluations of the visibility kernel: sources move millimetres, it varies over decimetres.
REFRESH = 16
BETA1, BETA2 = 0.8, 0.95  # decay rates of Adam's moments, for tens of steps
DECAY_AFTER, DECAY = 0.6, 0.3  # smaller steps for the last 40 %
TRANSMITTER_STEP = 0.0004  # [m]; small, its position is measured
PLANE_STEP = (0.0012, 0.0012, 0.0012, 0.004)  # of a plane's unit normal, and along it [m]
STEP = 0.05  # of logarithms of amplitudes and noise, and of phases [rad]
SPREAD = 0.5  # prior standard deviation of a visibility kernel's logarithms and logit

Objective = Callable[[list[Tensor], Tensor], tuple[float, list[Tensor]]]
Late = Callable[[], bool]
Cost = Callable[[Tensor, Tensor], Tensor]  # of planes and log amplitudes


def never() -> bool:
    """Of work without an end in time."""
    return False


def descend(
    rows: Rows, scene: Scene, steps: int, objective: Objective, *more: Tensor, late: Late = never
) -> tuple[Scene, list[Tensor]]:
    """The best scene, and the best of `more` parameters [rad], by Adam (D. P. Kingma and J. Ba, ICLR 2015).

    Args:
        rows: measurements.
        scene: start.
        steps: at least 0.
        objective: transmitter, planes, log amplitudes, log noise and `more`, and visibility correlations
            (K, n, n), to the objective and its derivatives.
        more: start of parameters beside the scene's.
        late: asked after every step; none follows when it says so.
    """
    values = [scene.transmitter, scene.planes, scene.log_amplitude, torch.tensor(scene.log_noise), *more]
    rates = [torch.tensor(step, dtype=torch.float64) for step in (TRANSMITTER_STEP, PLANE_STEP)]
    rates += [torch.tensor(STEP)] * (len(values) - 2)
    first, second = [torch.zeros_like(v) for v in values], [torch.zeros_like(v) for v in values]
    best, lowest, correlation = values, math.inf, torch.empty(0)
    for step in range(steps + 1):
        if step % REFRESH == 0:
            correlation = correlations(rows, images(values[0], values[1], scene.sequences), scene.visibility)
        value, gradient = objective(values, correlation)
        if value < lowest:
            lowest, best = value, values
        if step == steps or late():
            break
        decay = 1.0 if step < DECAY_AFTER * steps else DECAY
        moved = []
        for i, g in enumerate(gradient):
            first[i] = BETA1 * first[i] + (1 - BETA1) * g
            second[i] = BETA2 * second[i] + (1 - BETA2) * g * g
            mean = first[i] / (1 - BETA1 ** (step + 1))
            size = (second[i] / (1 - BETA2 ** (step + 1))).sqrt() + 1e-9
            moved.append(values[i] - decay * rates[i] * mean / size)
        values = moved
    found = replace(
        scene, transmitter=best[0], planes=best[1], log_amplitude=best[2], log_noise=float(best[3])
    )
    return found, best[4:]


def refine(
    rows: Rows, scene: Scene, steps: int, noise_floor: float = JITTER, late: Late = never,
    cost: Cost | None = None,
) -> Scene:  # fmt: skip
    """The best scene of `steps` steps, or of those until `late`."""

    def objective(values: list[Tensor], correlation: Tensor) -> tuple[float, list[Tensor]]:
        return _likelihood(rows, scene, values, correlation, noise_floor)

    return descend(rows, scene, steps, with_cost(objective, cost), late=late)[0]


def with_cost(objective: Objective, cost: Cost | None) -> Objective:
    """The objective plus a cost of planes (P, 4) and log amplitudes (K,), a negative log prior [nats]."""
    if cost is None:
        return objective

    def both(values: list[Tensor], correlation: Tensor) -> tuple[float, list[Tensor]]:
        value, gradient = objective(values, correlation)
        with torch.enable_grad():
            leaves = [v.detach().requires_grad_() for v in values[1:3]]
            more = cost(*leaves)
            slopes = torch.autograd.grad(more, leaves)
        gradient[1:3] = [g + slope for g, slope in zip(gradient[1:3], slopes, strict=True)]
        return value + more.item(), gradient

    return both


def _likelihood(
    rows: Rows, scene: Scene, values: list[Tensor], correlation: Tensor, noise_floor: float
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and its gradient: `d nll = trace(G dK)`, `G = R K^-1 - alpha alpha^H`."""
    transmitter, planes = (v.detach().requires_grad_() for v in values[:2])
    sources = images(rows.static_ends(transmitter), planes, scene.sequences)
    waves = steering(rows, sources) * scene.visible_share(rows.position)
    scaled = waves.detach() * values[2].exp()
    noise = values[3].exp()
    n = len(rows)
    real, imag = torch.zeros(n, n), torch.zeros(n, n)
    for k in range(len(scene.sequences)):
        add_covariance(real, imag, scaled[:, k], correlation[k])
    real.diagonal().add_(noise + noise_floor)
    conditioned = Conditioned.of(torch.complex(real, imag), rows.target)
    slope_re, slope_im = (part.contiguous() for part in (conditioned.slope.real, conditioned.slope.imag))
    weighted = torch.empty_like(scaled)  # (G * C_k) s_k a_k
    for k in range(len(scene.sequences)):
        pair = torch.stack([scaled[:, k].real, scaled[:, k].imag], 1)
        a = (slope_re * correlation[k]) @ pair
        b = (slope_im * correlation[k]) @ pair
        weighted[:, k] = torch.complex(a[:, 0] - b[:, 1], a[:, 1] + b[:, 0])
    by_amplitude = 2 * (scaled.conj() * weighted).sum(0).real
    by_noise = noise * slope_re.diagonal().sum()
    by_wave = 2 * weighted * values[2].exp()
    places = torch.autograd.grad(waves, [transmitter, planes], by_wave, materialize_grads=True)
    return conditioned.nll, [*places, by_amplitude, by_noise]


def learn_visibility(
    rows: Rows, scene: Scene, steps: int, start: KernelVisibility, late: Late = never
) -> Scene:
    """Parameters of the visibility kernel by likelihood, with a log-normal prior about `start`.

    Without the prior the lengths collapse to explain the power of sources not found yet.

    Args:
        rows: a few hundred are enough.
        steps: of Adam.
        start: centre of the prior.
        late: asked before every step; none follows when it says so.
    """
    centre, value = start.parameters(0.02), scene.visibility.parameters(0.02).requires_grad_()
    optimizer = torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.95))
    for _ in range(steps):
        if late():
            break
        posterior = Posterior(rows, replace(scene, visibility=KernelVisibility.of(value.detach())))
        slope = posterior.conditioned.slope
        scaled = posterior.waves * scene.log_amplitude.exp()
        optimizer.zero_grad()
        for k, source in enumerate(scene.sources):
            weight = (slope.conj() * scaled[:, k, None] * scaled[:, k].conj()).real
            (weight * KernelVisibility.of(value).correlation(rows.places, source)).sum().backward()
        ((value - centre).square().sum() / SPREAD**2).backward()
        optimizer.step()
    return replace(scene, visibility=KernelVisibility.of(value.detach()).plain())
