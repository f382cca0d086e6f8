"""Maximise the marginal likelihood over planes, amplitudes, noise, phases, and the visibility kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import PhasedGains, Posterior
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import BETAS, KernelVisibility, Scene, correlations, steering
from gsparc.physics.mirror_planes import images
from gsparc.processes.worker import out_of_time

# Steps between evaluations of the visibility kernel: sources move millimetres, it varies over decimetres.
REFRESH = 16
DECAY_AFTER, DECAY = 0.6, 0.3  # smaller steps for the last 40 %
TRANSMITTER_STEP = 0.0004  # [m]; small, its position is measured
PLANE_STEP = (0.0012, 0.0012, 0.0012, 0.004)  # of a plane's unit normal, and along it [m]
STEP = 0.05  # of logarithms of amplitudes and noise, and of phases [rad]
SPREAD = 0.5  # prior standard deviation of a visibility kernel's logarithms and logit

# Negative log prior [nats] of transmitter, planes (P, 4), log amplitudes (K,), log noise and phases (K,).
Cost = Callable[[list[Tensor]], Tensor]


def refine(rows: Rows, scene: Scene, steps: int, cost: Cost | None = None) -> Scene:
    """Return the best scene of `steps` of Adam (D. P. Kingma and J. Ba, ICLR 2015), or until `out_of_time`.

    Args:
        rows: measurements.
        scene: the start; its phases move where gains have them.
        steps: at least 0.
        cost: a negative log prior, added to the negative log likelihood.
    """
    values = [scene.transmitter, scene.planes, scene.log_amplitude, torch.tensor(scene.log_noise)]
    values += [] if scene.phase is None else [scene.phase]
    rates = [torch.tensor(step, dtype=torch.float64) for step in (TRANSMITTER_STEP, PLANE_STEP)]
    rates += [torch.tensor(STEP)] * (len(values) - 2)
    first, second = [torch.zeros_like(v) for v in values], [torch.zeros_like(v) for v in values]
    best, lowest, correlation = values, math.inf, torch.empty(0)
    for step in range(steps + 1):
        if step % REFRESH == 0:
            correlation = correlations(rows, images(values[0], values[1], scene.sequences), scene.visibility)
        value, gradient = _likelihood(rows, scene, values, correlation)
        if cost is not None:
            leaves = [v.detach().requires_grad_() for v in values]
            with torch.enable_grad():
                more = cost(leaves)
                slopes = torch.autograd.grad(more, leaves, materialize_grads=True)
            value, gradient = value + more.item(), [g + s for g, s in zip(gradient, slopes, strict=True)]
        if value < lowest:
            lowest, best = value, values
        if step == steps or out_of_time():
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
    transmitter, planes, *phases = (v.detach().requires_grad_() for v in (*values[:2], *values[4:]))
    waves = steering(rows, images(rows.static_ends(transmitter), planes, scene.sequences))
    for phase in phases:
        waves = waves * torch.polar(torch.ones(()), phase)
    waves = waves * scene.visible_share(rows.position)
    scaled, noise = waves.detach() * values[2].exp(), values[3].exp()
    gains = Posterior(rows, scene).gains()
    for k, one in enumerate(correlation):
        gains.add(scaled[:, k], one)
    conditioned = gains.given(noise + scene.noise_floor)
    by_waves = gains.by_waves(conditioned.slope, scaled, correlation)
    by_amplitude = (scaled.conj() * by_waves).sum(0).real
    leaves = [transmitter, planes, *phases]
    by_place, by_plane, *by_phase = torch.autograd.grad(
        waves, leaves, by_waves * values[2].exp(), materialize_grads=True
    )
    by_noise = noise * gains.by_noise(conditioned.slope)
    return conditioned.nll, [by_place, by_plane, by_amplitude, by_noise, *by_phase]


def learn_visibility(rows: Rows, scene: Scene, steps: int, centre: KernelVisibility) -> Scene:
    """Fit the visibility kernel by likelihood until `out_of_time`, with a log-normal prior about `centre`.

    Without the prior the lengths collapse to explain the power of sources not found yet. Of gains with phases
    `quadrature` is learned as well, unless it is 1: its prior is about the present one.

    Args:
        rows: a few hundred are enough.
        scene: the start.
        steps: of Adam.
        centre: of the prior.
    """
    shares, least, wide = ((), 0.02, 1.0) if scene.phase is None else ((scene.quadrature,), 0.005, 2**0.5)
    about, value = (kernel.parameters(least, *shares) for kernel in (centre, scene.visibility))
    width = SPREAD * torch.tensor([1.0, 1.0, 1.0, 2.0])[: len(value)] * wide
    optimizer = torch.optim.Adam([value.requires_grad_()], lr=0.1, betas=BETAS)

    def current() -> Scene:
        trial = replace(scene, visibility=KernelVisibility.of(value.detach()).plain())
        if scene.quadrature == 1:
            return trial
        return replace(trial, quadrature=float(torch.sigmoid(value.detach()[3])))

    for _ in range(steps):
        if out_of_time():
            break
        posterior = Posterior(rows, current())
        slope, gains = posterior.conditioned.slope, posterior.gains()
        if isinstance(gains, PhasedGains) and gains.quadrature < 1:
            gains.quadrature = torch.sigmoid(value[3])
        scaled = posterior.waves * scene.log_amplitude.exp()
        loss = ((value - about) / width).square().sum()
        for k, source in enumerate(scene.sources):
            correlation = KernelVisibility.of(value).correlation(rows.places, source)
            loss = loss + (gains.by_correlation(slope, scaled[:, k]) * correlation).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return current()
