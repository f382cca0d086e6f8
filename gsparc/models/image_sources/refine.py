"""Maximise the marginal likelihood over planes, amplitudes, noise, phases, and the visibility kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import PhasedGains, Posterior
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import (
    BETAS,
    KernelVisibility,
    Scene,
    spherical_waves,
    visibility_correlations,
)
from gsparc.physics.mirror_planes import images
from gsparc.processes.worker import late

# Steps between evaluations of the visibility kernel: sources move millimetres, it varies over decimetres.
REFRESH = 16
ROUND_STEPS, POLISHING_STEPS = 12, 20  # after a change of some sources, and of all
VISIBILITY_STEPS = 10  # of `learn_visibility`
DECAY_AFTER, DECAY = 0.6, 0.3  # smaller steps for the last 40 %
TRANSMITTER_STEP = 0.0004  # [m]; small, its position is measured
NORMAL_STEP, OFFSET_STEP = 0.0012, 0.004  # of a plane's unit normal, and along it [m]
STEP = 0.05  # of logarithms of amplitudes and noise, and of phases [rad]
SPREAD = 0.5  # prior standard deviation of a visibility kernel's logarithms and logit

# Negative log prior [nats] of transmitter, planes (P, 4), log amplitudes (K,), log noise and phases (K,).
Cost = Callable[[list[Tensor]], Tensor]


def refine_scene(rows: Rows, scene: Scene, steps: int, cost: Cost | None = None) -> Scene:
    """Return the best scene of `steps` of Adam (D. P. Kingma and J. Ba, ICLR 2015), or until `late`.

    Args:
        rows: measurements.
        scene: the start; its phases move where gains have them.
        steps: at least 0.
        cost: a negative log prior, added to the negative log likelihood.
    """
    values = [scene.transmitter, scene.planes, scene.log_amplitude, torch.tensor(scene.log_noise)]
    values += [] if scene.phase is None else [scene.phase]
    normal, offset = scene.planes.split((3, 1), 1)
    plane_steps = torch.cat([torch.full_like(normal, NORMAL_STEP), torch.full_like(offset, OFFSET_STEP)], 1)
    rates: list[Tensor | float] = [TRANSMITTER_STEP, plane_steps, *[STEP] * (len(values) - 2)]
    first, second = [torch.zeros_like(v) for v in values], [torch.zeros_like(v) for v in values]
    best, lowest, correlation = values, math.inf, torch.empty(0)
    for step in range(steps + 1):
        if step % REFRESH == 0:
            correlation = visibility_correlations(
                rows, images(values[0], values[1], scene.sequences), scene.visibility
            )
        value, gradient = _likelihood(rows, scene, values, correlation)
        if cost is not None:
            leaves = [v.detach().requires_grad_() for v in values]
            with torch.enable_grad():
                more = cost(leaves)
                slopes = torch.autograd.grad(more, leaves, materialize_grads=True)
            value, gradient = value + more.item(), [g + s for g, s in zip(gradient, slopes, strict=True)]
        if value < lowest:
            lowest, best = value, values
        if step == steps or late():
            break
        decay = 1.0 if step < DECAY_AFTER * steps else DECAY
        moved = []
        for i, g in enumerate(gradient):
            first[i] = BETAS[0] * first[i] + (1 - BETAS[0]) * g
            second[i] = BETAS[1] * second[i] + (1 - BETAS[1]) * g * g
            mean = first[i] / (1 - BETAS[0] ** (step + 1))
            size = (second[i] / (1 - BETAS[1] ** (step + 1))).sqrt() + 1e-9
            moved.append(values[i] - decay * rates[i] * mean / size)
        values = moved
    transmitter, planes, log_amplitude, log_noise, *phase = best
    return replace(
        scene, transmitter=transmitter, planes=planes, log_amplitude=log_amplitude,
        log_noise=float(log_noise), phase=phase[0] if phase else None,
    )  # fmt: skip


def _likelihood(
    rows: Rows, scene: Scene, values: list[Tensor], correlation: Tensor
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and its derivatives by the values: `d nll = trace(G dK)`."""
    transmitter, planes, log_amplitude, log_noise, *phases = values
    transmitter, planes, *phases = (v.detach().requires_grad_() for v in (transmitter, planes, *phases))
    amplitude, noise = log_amplitude.exp(), log_noise.exp()
    waves = spherical_waves(rows, images(rows.static_ends(transmitter), planes, scene.sequences))
    for phase in phases:
        waves = waves * torch.polar(torch.ones(()), phase)
    waves = waves * scene.visible_share(rows.position)
    scaled = waves.detach() * amplitude
    gains = Posterior(rows, scene).gains()
    for k, one in enumerate(correlation):
        gains.add(scaled[:, k], one)
    conditioned = gains.condition(noise + scene.noise_floor)
    by_waves = gains.slope_by_waves(conditioned.slope, scaled, correlation)
    by_amplitude = (scaled.conj() * by_waves).sum(0).real
    leaves = [transmitter, planes, *phases]
    by_place, by_plane, *by_phase = torch.autograd.grad(
        waves, leaves, by_waves * amplitude, materialize_grads=True
    )
    by_noise = noise * gains.slope_by_noise(conditioned.slope)
    return conditioned.nll, [by_place, by_plane, by_amplitude, by_noise, *by_phase]


def learn_visibility(
    rows: Rows, scene: Scene, centre: KernelVisibility, steps: int = VISIBILITY_STEPS
) -> Scene:
    """Fit the visibility kernel by likelihood until `late`, with a log-normal prior about `centre`.

    Without the prior the lengths collapse to explain the power of sources not found yet. Of gains with phases
    `quadrature` is learned as well, unless it is 1: its prior is about the present one.

    Args:
        rows: a few hundred are enough.
        scene: the start.
        centre: of the prior.
        steps: of Adam.
    """
    shares, least, wide = ((), 0.02, 1.0) if scene.phase is None else ((scene.quadrature,), 0.005, 2**0.5)
    about, value = (kernel.parameters(least, *shares) for kernel in (centre, scene.visibility))
    width = SPREAD * torch.tensor([1.0, 1.0, 1.0, 2.0])[: len(value)] * wide
    optimizer = torch.optim.Adam([value.requires_grad_()], lr=0.1, betas=BETAS)

    def current() -> Scene:
        trial = replace(scene, visibility=KernelVisibility.of(value.detach()).plain())
        if scene.quadrature == 1:
            return trial
        return replace(trial, quadrature=float(torch.sigmoid(value.detach()[-1])))

    for _ in range(steps):
        if late():
            break
        posterior = Posterior(rows, current())
        slope, gains = posterior.conditioned.slope, posterior.gains()
        if isinstance(gains, PhasedGains) and gains.quadrature < 1:
            gains.quadrature = torch.sigmoid(value[-1])
        scaled = posterior.waves * scene.log_amplitude.exp()
        loss = ((value - about) / width).square().sum()
        for k, source in enumerate(scene.sources):
            correlation = KernelVisibility.of(value).correlation(rows.places, source)
            loss = loss + (gains.slope_by_correlation(slope, scaled[:, k]) * correlation).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return current()
