"""Final refinement: phases and all other parameters under the process of gains of constant phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import JITTER, steering
from gsparc.models.image_sources.phased_gp import (
    PhasedPosterior,
    PhasedScene,
    add_source,
    given,
    shares,
    stacked,
)
from gsparc.models.image_sources.refine import SPREAD, Cost, Late, descend, never, with_cost
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.physics.mirror_planes import images


def refine(
    rows: Rows,
    phased: PhasedScene,
    steps: int,
    noise_floor: float = JITTER,
    prior: Callable[[Tensor], Tensor] | None = None,
    late: Late = never,
    cost: Cost | None = None,
) -> PhasedScene:
    """The best phased scene of `steps` steps, or until `late`; `prior`: negative log, of phases (K,)."""

    def objective(values: list[Tensor], correlation: Tensor) -> tuple[float, list[Tensor]]:
        nll, gradient = _likelihood(rows, phased, values, correlation, noise_floor)
        if prior is not None:
            with torch.enable_grad():
                phase = values[4].detach().requires_grad_()
                cost = prior(phase)
                gradient[4] = gradient[4] + torch.autograd.grad(cost, phase)[0]
            nll += cost.item()
        return nll, gradient

    scene, (phase,) = descend(rows, phased.scene, steps, with_cost(objective, cost), phased.phase, late=late)
    return replace(phased, scene=scene, phase=phase)


def _likelihood(
    rows: Rows, phased: PhasedScene, values: list[Tensor], correlation: Tensor, noise_floor: float
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and its derivatives by transmitter, planes, amplitudes, noise, phases."""
    sequences, n = phased.scene.sequences, len(rows)
    transmitter, planes, phase = (values[i].detach().requires_grad_() for i in (0, 1, 4))
    sources = images(rows.static_ends(transmitter), planes, sequences)
    waves = steering(rows, sources) * torch.polar(torch.ones(()), phase)
    waves = waves * phased.scene.visible_share(rows.position)
    scaled = waves.detach() * values[2].exp()
    noise = values[3].exp()
    covariance = torch.zeros(2, n, 2, n)
    for k in range(len(sequences)):
        add_source(covariance, scaled[:, k], phased.quadrature, correlation[k])
    covariance.view(2 * n, 2 * n).diagonal().add_((noise + noise_floor) / 2)
    conditioned = given(covariance, rows.target)
    slope = conditioned.slope
    blocks = slope.view(2, n, 2, n)
    weighted = torch.empty_like(scaled)
    for k in range(len(sequences)):
        pair = torch.stack(stacked(scaled[:, k]), 1) * shares(phased.quadrature)
        by = (blocks * correlation[k][None, :, None, :]).view(2 * n, 2 * n) @ pair
        # p = (Re, Im) and q = (-Im, Re): the derivatives by Re and Im collect both
        weighted[:, k] = torch.complex(by[:n, 0] + by[n:, 1], by[n:, 0] - by[:n, 1])
    by_amplitude = (scaled.conj() * weighted).sum(0).real
    by_noise = noise * slope.diagonal().sum() / 4
    leaves = [transmitter, planes, phase]
    *places, by_phase = torch.autograd.grad(waves, leaves, weighted * values[2].exp(), materialize_grads=True)
    return conditioned.nll, [*places, by_amplitude, by_noise, by_phase]


def learn_visibility(
    rows: Rows, phased: PhasedScene, steps: int, start: KernelVisibility, noise_floor: float = JITTER,
    late: Late = never,
) -> PhasedScene:  # fmt: skip
    """Parameters of the visibility kernel and `quadrature` by likelihood.

    The prior is about `start` and the present `quadrature` (which stays at 1) in logarithms and logits.

    Args:
        rows: a few hundred are enough.
        phased: start.
        steps: of Adam.
        start: centre of the prior.
        noise_floor: known variance of the noise, in units of the rows' power.
        late: asked before every step; none follows when it says so.
    """
    n, scene, free = len(rows), phased.scene, phased.quadrature < 1
    centre = start.parameters(0.005, phased.quadrature)
    value = scene.visibility.parameters(0.005, phased.quadrature).requires_grad_()
    width = torch.tensor([SPREAD, SPREAD, SPREAD, 2 * SPREAD])
    optimizer = torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.95))

    def current() -> PhasedScene:
        kernel = KernelVisibility.of(value.detach()).plain()
        kept = float(torch.sigmoid(value.detach()[3])) if free else 1.0
        return replace(phased, scene=replace(scene, visibility=kernel), quadrature=kept)

    for _ in range(steps):
        if late():
            break
        posterior = PhasedPosterior(rows, current(), noise_floor)
        slope = posterior.conditioned.slope
        scaled = posterior.waves * scene.log_amplitude.exp()
        share = (torch.sigmoid(value[3]) if free else torch.ones(())) / 2
        loss = ((value - centre) / width).square().sum() / 2
        for k, source in enumerate(scene.sources):
            along, across = (_folded(slope, z, n) for z in stacked(scaled[:, k]))
            correlation = KernelVisibility.of(value).correlation(rows.places, source)
            gain = (1 - share) * (along * correlation).sum() + share * (across * correlation).sum()
            loss = loss + gain / 2
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return current()


def _folded(slope: Tensor, z: Tensor, n: int) -> Tensor:
    """`sum_ab G_ab z_a z_b` over the real and imaginary halves, (n, n)."""
    weighted = slope * z[:, None] * z
    return weighted[:n, :n] + weighted[:n, n:] + weighted[n:, :n] + weighted[n:, n:]
