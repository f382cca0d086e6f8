"""Final refinement: phases and all other parameters under the process of gains of constant phase."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.multipath.adam import descend
from gsparc.multipath.gp_likelihood import JITTER, correlations, steering
from gsparc.multipath.phased_gp import PhasedPosterior, PhasedScene, RealFactor, add_source, shares, stacked
from gsparc.multipath.refine import REFRESH, StepSizes, rates
from gsparc.multipath.rows import Rows
from gsparc.multipath.visibility_kernel import KernelVisibility, View
from gsparc.physics.mirror_planes import images

PHASE_STEP = 0.05  # [rad]


def fit_phases(
    rows: Rows,
    phased: PhasedScene,
    start: KernelVisibility,
    rounds: int = 1,
    steps: int = 20,
    noise_floor: float = JITTER,
) -> PhasedScene:
    """Alternate between the visibility kernel's parameters and all others.

    Args:
        rows: of a search.
        phased: from the search.
        start: centre of the prior on the visibility.
        rounds, steps: rounds of `steps` steps each.
        noise_floor: known variance of the noise, in units of the rows' power.
    """
    centre = phased.quadrature
    for _ in range(rounds):
        phased = learn_visibility(rows, phased, steps // 2, start, centre, noise_floor=noise_floor)
        phased = refine(rows, phased, steps, noise_floor)
    return phased


def refine(
    rows: Rows,
    phased: PhasedScene,
    steps: int,
    noise_floor: float = JITTER,
    prior: Callable[[Tensor], Tensor] | None = None,
) -> PhasedScene:
    """The best phased scene of `steps` steps; `prior` is a negative log prior of phases (K,)."""
    scene, correlations_of = phased.scene, torch.empty(0)

    def objective(step: int, values: list[Tensor]) -> tuple[float, list[Tensor]]:
        nonlocal correlations_of
        if step % REFRESH == 0:
            correlations_of = correlations(rows, images(values[0], values[1], scene.words), scene.visibility)
        nll, gradient = _likelihood(rows, phased, values, correlations_of, noise_floor)
        if prior is not None:
            with torch.enable_grad():
                phase = values[4].detach().requires_grad_()
                cost = prior(phase)
                gradient[4] = gradient[4] + torch.autograd.grad(cost, phase)[0]
            nll += cost.item()
        return nll, gradient

    start = [
        scene.transmitter, scene.planes, scene.log_amplitude, torch.tensor(scene.log_noise), phased.phase,
    ]  # fmt: skip
    best = descend(start, [*rates(StepSizes()), torch.tensor(PHASE_STEP)], steps, objective)
    moved = replace(
        scene, transmitter=best[0], planes=best[1], log_amplitude=best[2], log_noise=float(best[3])
    )
    return replace(phased, scene=moved, phase=best[4])


def _likelihood(
    rows: Rows, phased: PhasedScene, values: list[Tensor], correlations_of: Tensor, noise_floor: float
) -> tuple[float, list[Tensor]]:
    """Negative log likelihood and its derivatives by transmitter, planes, amplitudes, noise, phases."""
    words, n = phased.scene.words, len(rows)
    transmitter, planes, phase = (values[i].detach().requires_grad_() for i in (0, 1, 4))
    waves = steering(rows, images(transmitter, planes, words)) * torch.polar(torch.ones(()), phase)
    waves = waves * phased.scene.visible_share(rows.position)
    scaled = waves.detach() * values[2].exp()
    noise = values[3].exp()
    covariance = torch.zeros(2, n, 2, n)
    for k in range(len(words)):
        add_source(covariance, scaled[:, k], phased.quadrature, correlations_of[k])
    covariance.view(2 * n, 2 * n).diagonal().add_((noise + noise_floor) / 2)
    factor = RealFactor.of(covariance, rows.target)
    slope = factor.slope
    blocks = slope.view(2, n, 2, n)
    weighted = torch.empty_like(scaled)
    for k in range(len(words)):
        pair = torch.stack(stacked(scaled[:, k]), 1) * shares(phased.quadrature)
        by = (blocks * correlations_of[k][None, :, None, :]).view(2 * n, 2 * n) @ pair
        # p = (Re, Im) and q = (-Im, Re): the derivatives by Re and Im collect both
        weighted[:, k] = torch.complex(by[:n, 0] + by[n:, 1], by[n:, 0] - by[:n, 1])
    by_amplitude = (scaled.conj() * weighted).sum(0).real
    by_noise = noise * slope.diagonal().sum() / 4
    leaves = [transmitter, planes, phase]
    objective = torch.autograd.grad(waves, leaves, weighted * values[2].exp(), allow_unused=True)
    places = [torch.zeros_like(v) if g is None else g for g, v in zip(objective, leaves, strict=True)]
    return factor.nll, [places[0], places[1], by_amplitude, by_noise, places[2]]


def learn_visibility(
    rows: Rows,
    phased: PhasedScene,
    steps: int,
    start: KernelVisibility,
    quadrature: float,
    spread: float = 0.5,
    noise_floor: float = JITTER,
) -> PhasedScene:
    """Parameters of the visibility kernel and `quadrature` by likelihood, with a prior about `start`.

    Args:
        rows: a few hundred are enough.
        phased: start.
        steps: of Adam.
        start, quadrature: centre of the prior; turning = 1 stays.
        spread: standard deviation of the prior in logarithms and logits (twice that for `quadrature`).
        noise_floor: as in `fit_phases`.
    """
    kernel, n = phased.scene.visibility, len(rows)
    centre = _parameters_of(start, quadrature)
    value = _parameters_of(kernel, phased.quadrature).requires_grad_()
    width = torch.tensor([spread, spread, spread, 2 * spread])
    optimizer = torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.95))
    for _ in range(steps):
        current = _with_parameters(phased, value.detach(), quadrature)
        posterior = PhasedPosterior(rows, current, noise_floor)
        slope = posterior.factor.slope
        scaled = posterior.waves * current.scene.log_amplitude.exp()
        share = (torch.sigmoid(value[3]) if quadrature < 1 else torch.ones(())) / 2
        loss = ((value - centre) / width).square().sum() / 2
        for k, source in enumerate(current.scene.sources):
            view = View.of(rows.position, source)
            p, q = stacked(scaled[:, k])
            along, across = (_folded(slope, z, n) for z in (p, q))
            correlation = _kernel(value).correlation(view, view)
            loss = (
                loss + ((1 - share) * (along * correlation).sum() + share * (across * correlation).sum()) / 2
            )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return _with_parameters(phased, value.detach(), quadrature)


def _folded(slope: Tensor, z: Tensor, n: int) -> Tensor:
    """`sum_ab G_ab z_a z_b` over the real and imaginary halves, (n, n)."""
    weighted = slope * z[:, None] * z
    return weighted[:n, :n] + weighted[:n, n:] + weighted[n:, :n] + weighted[n:, n:]


def _with_parameters(phased: PhasedScene, value: Tensor, quadrature: float) -> PhasedScene:
    kernel = KernelVisibility(*(float(v) for v in (torch.sigmoid(value[0]), value[1].exp(), value[2].exp())))
    kept = float(torch.sigmoid(value[3])) if quadrature < 1 else 1.0
    return PhasedScene(replace(phased.scene, visibility=kernel), phased.phase, kept)


def _parameters_of(kernel: KernelVisibility, quadrature: float) -> Tensor:
    logs = [math.log(kernel.angle), math.log(kernel.length)]
    return torch.tensor([_logit(float(kernel.constant)), *logs, _logit(quadrature)])


def _logit(share: float) -> float:
    share = min(max(share, 0.005), 0.995)
    return math.log(share / (1 - share))


def _kernel(value: Tensor) -> KernelVisibility:
    return KernelVisibility(torch.sigmoid(value[0]), value[1].exp(), value[2].exp())
