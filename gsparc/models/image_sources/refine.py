"""Maximise the marginal likelihood over planes, amplitudes, noise, phases,
and the visibility kernel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import GainPosterior, PhasedGains
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import BETAS, KernelVisibility, SourceScene
from gsparc.processes.worker import out_of_steps

# Steps between evaluations of the visibility kernel: sources move millimetres,
# it varies over decimetres.
REFRESH = 16
ROUND_STEPS, POLISHING_STEPS = 12, 20  # after a change of some sources, and of all
VISIBILITY_STEPS = 10  # of `learn_visibility`
DECAY_AFTER, DECAY = 0.6, 0.3  # smaller steps for the last 40 %
TRANSMITTER_STEP = 0.0004  # [m]; small, its position is measured
NORMAL_STEP, OFFSET_STEP = 0.0012, 0.004  # of a plane's unit normal, and along it [m]
STEP = 0.05  # of logarithms of amplitudes and noise, and of phases [rad]
SPREAD = 0.5  # prior standard deviation of a visibility kernel's logarithms and logit

Cost = Callable[[SourceScene], Tensor]  # negative log prior [nats] of a scene


def refine_scene(
    rows: Rows, scene: SourceScene, steps: int, cost: Cost | None = None
) -> SourceScene:
    """Return the best scene of `steps` of Adam (D. P. Kingma and J. Ba, ICLR 2015),
    or until `out_of_steps`.

    Args:
        rows: measurements.
        scene: the start; its phases move where gains have them.
        steps: at least 0.
        cost: of planes, log amplitudes and phases, added to the negative log likelihood.
    """
    values = [scene.transmitter, *scene.planes.split((3, 1), 1)]
    values += [scene.log_amplitude, torch.tensor(scene.log_noise)]
    values = [v.clone() for v in (*values, *([] if scene.phase is None else [scene.phase]))]
    rates = [TRANSMITTER_STEP, NORMAL_STEP, OFFSET_STEP, STEP, STEP, STEP]
    groups = [{"params": [v], "lr": rate} for v, rate in zip(values, rates, strict=False)]
    optimizer = torch.optim.Adam(groups, betas=BETAS, eps=1e-9)
    best, lowest, correlation = scene, math.inf, torch.empty(0)
    for step in range(steps + 1):
        if step == math.ceil(DECAY_AFTER * steps):
            for group in optimizer.param_groups:
                group["lr"] *= DECAY
        if step % REFRESH == 0:
            seen = (
                scene.visibility.correlation(rows.places, source)
                for source in _scene_at(scene, values).sources
            )
            correlation = torch.stack([*seen])
        value, gradient = _cost_and_gradient(rows, scene, values, correlation, cost)
        if value < lowest:
            lowest, best = value, _scene_at(scene, [v.clone() for v in values])
        if step == steps or out_of_steps():
            break
        for v, slope in zip(values, gradient, strict=True):
            v.grad = slope
        optimizer.step()
    return best


def _scene_at(scene: SourceScene, values: list[Tensor]) -> SourceScene:
    """The scene of other transmitter, normals, offsets, log amplitudes, log noise and phases,
    if any.
    """
    transmitter, normal, offset, log_amplitude, log_noise, *phase = values
    return replace(
        scene,
        transmitter=transmitter,
        planes=torch.cat([normal, offset], 1),
        log_amplitude=log_amplitude,
        log_noise=log_noise.item(),
        phase=phase[0] if phase else None,
    )


def _cost_and_gradient(
    rows: Rows,
    scene: SourceScene,
    values: list[Tensor],
    correlation: Tensor,
    cost: Cost | None = None,
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and prior, and derivatives by the values: `d nll = trace(G dK)`."""
    leaves = [v.detach().requires_grad_() for v in values]
    moved = _scene_at(scene, leaves)
    waves = moved.unobstructed_waves(rows) * scene.visible_share(rows.position)
    amplitude, noise = moved.log_amplitude.detach().exp(), math.exp(moved.log_noise)
    scaled, gains = waves.detach() * amplitude, GainPosterior(rows, scene).empty_covariance()
    for k, block in enumerate(correlation):
        gains.add_source(scaled[:, k], block)
    conditioned = gains.add_noise_and_condition(noise + scene.noise_floor)
    by_waves = gains.grad_waves(conditioned.nll_gradient, scaled, correlation)
    by_amplitude = (scaled.conj() * by_waves).sum(0).real
    slopes = torch.autograd.grad(waves, leaves, by_waves * amplitude, materialize_grads=True)
    by_place, by_normal, by_offset, _, _, *by_phase = slopes
    by_noise = noise * gains.grad_noise(conditioned.nll_gradient)
    gradient = [by_place, by_normal, by_offset, by_amplitude, by_noise, *by_phase]
    if cost is None:
        return conditioned.nll, gradient
    more = cost(moved)
    by_cost = torch.autograd.grad(more, leaves, materialize_grads=True)
    return conditioned.nll + more.item(), [g + s for g, s in zip(gradient, by_cost, strict=True)]


def learn_visibility(
    rows: Rows, scene: SourceScene, centre: KernelVisibility, steps: int = VISIBILITY_STEPS
) -> SourceScene:
    """Fit the visibility kernel by likelihood until `out_of_steps`,
    with a log-normal prior about `centre`.

    Without the prior the lengths collapse to explain the power of sources not found yet. Of gains
    with phases `quadrature` is learned as well, unless it is 1: its prior is about the present one.

    Args:
        rows: a few hundred are enough.
        scene: the start.
        centre: of the prior.
        steps: of Adam.
    """
    shares, least, wide = (
        ((), 0.02, 1.0) if scene.phase is None else ((scene.quadrature,), 0.005, 2**0.5)
    )
    about, value = (kernel.to_parameters(least, *shares) for kernel in (centre, scene.visibility))
    width = SPREAD * torch.tensor([1.0, 1.0, 1.0, 2.0])[: len(value)] * wide
    optimizer = torch.optim.Adam([value.requires_grad_()], lr=0.1, betas=BETAS)

    def current_scene() -> SourceScene:
        trial = replace(
            scene, visibility=KernelVisibility.from_parameters(value.detach()).to_floats()
        )
        if scene.quadrature == 1:
            return trial
        return replace(trial, quadrature=float(torch.sigmoid(value.detach()[-1])))

    for _ in range(steps):
        if out_of_steps():
            break
        posterior = GainPosterior(rows, current_scene())
        slope, gains = posterior.conditioned.nll_gradient, posterior.empty_covariance()
        if isinstance(gains, PhasedGains) and gains.quadrature < 1:
            gains.quadrature = torch.sigmoid(value[-1])
        scaled = posterior.waves * scene.log_amplitude.exp()
        loss = ((value - about) / width).square().sum()
        for k, source in enumerate(scene.sources):
            correlation = KernelVisibility.from_parameters(value).correlation(rows.places, source)
            loss = loss + (gains.grad_correlation(slope, scaled[:, k]) * correlation).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return current_scene()
