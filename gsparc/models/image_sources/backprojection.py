"""Find the source that would explain most of the residual: back-projection over a box,
then gradient ascent.

The gain in log likelihood of a source at p, its amplitude free, grows with the matched filter

    score(p) = |a(p)^H K^-1 y|^2 / (a(p)^H K^-1 a(p))

summed over outputs; K is the covariance of the sources found so far,
so that the residual need not be formed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsparc.models.apart import keep_apart
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import BETAS, spherical_waves
from gsparc.physics.draws import sample_in_box
from gsparc.physics.waves import LIGHT, NEAR_M
from gsparc.processes.worker import raise_if_cancelled

BLOCK = 1024  # candidates at a time, so that a block stays in cache
# Points drawn in the box, scored exactly, moved by ascent
CANDIDATES, EXACT, POLISHED = 150_000, 1_500, 40
STEPS, STEP_M = 25, 0.02  # of the ascent


# Positions (m, 3) of sources to those of their antennas (E, m, 3) [m].
ImagesOfAntennas = Callable[[Tensor], Tensor]


def score_candidates(posterior: GainPosterior, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Score (m,) of candidate positions (m, 3) float64 [m], and the amplitude (m,) each would have.

    Where the static end has E antennas, candidates are the images of each, (E, m, 3).
    """
    waves, conditioned = spherical_waves(posterior.rows, candidates), posterior.conditioned
    matched = (waves.mH @ conditioned.weights).abs().square().sum(1)
    power = (conditioned.factor.root @ waves).abs().square().sum(0)
    gained = matched / power
    return gained / conditioned.weights.shape[1], (
        gained / power / conditioned.weights.shape[1]
    ).sqrt()


def rough_gains(rows: Rows, candidates: Tensor, alpha: Tensor) -> Tensor:
    """Return `|a^H alpha|^2 / |a|^2` (m,), ranges in float32:
    good to a thousandth of a cycle in a building.

    Candidates are (m, 3), or (E, m, 3) as in `likelihood_gain`.
    """
    middle = rows.position.mean(0)
    per_metre = (rows.frequency / LIGHT).float()
    element = torch.zeros(len(rows), dtype=torch.long) if rows.element is None else rows.element
    images = candidates[None] if rows.element is None else candidates
    parts = [(torch.nonzero(element == e).flatten(), image) for e, image in enumerate(images)]
    scores = []
    for start in range(0, candidates.shape[-2], BLOCK):
        raise_if_cancelled()
        count = len(parts[0][1][start : start + BLOCK])
        real, imag = torch.zeros(2, count, alpha.shape[1])
        power = torch.zeros(count)
        for mine, points in parts:
            block = (points[start : start + BLOCK] - middle).float()
            places = (rows.position[mine] - middle).float()
            squared = torch.addmm(places.square().sum(1), block, places.T, alpha=-2)
            distance = squared.add_(block.square().sum(1)[:, None]).clamp_min_(NEAR_M**2).sqrt_()
            cycles = distance * per_metre[mine]
            phase = cycles.sub_(cycles.round()).mul_(2 * math.pi)
            loss = distance.reciprocal_()
            cosine, sine = phase.cos().mul_(loss), phase.sin_().mul_(loss)
            real_part, imaginary_part = alpha.real[mine], alpha.imag[mine]
            real += cosine @ real_part - sine @ imaginary_part
            imag += cosine @ imaginary_part + sine @ real_part
            power += loss.square_().sum(1)
        scores.append((real.square() + imag.square()).sum(1) / power)
    return torch.cat(scores)


def find_sources_in_box(
    posterior: GainPosterior,
    box: Tensor,
    min_distance: float,
    limit: int,
    generator: torch.Generator,
    images: ImagesOfAntennas,
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return the best `limit` new sources in a box (2, 3) float64 [m],
    at least `min_distance` [m] apart.

    Each is its place (3,) float64 [m], score () and amplitude (), the best first.
    `images` gives the images of the static end's antennas, as `likelihood_gain` takes them.
    """
    low, high = box
    candidates = sample_in_box(low, high, CANDIDATES, generator)
    rough = rough_gains(posterior.rows, images(candidates), posterior.conditioned.weights)
    candidates = candidates[rough.topk(min(EXACT, len(rough))).indices]
    exact = torch.cat(
        [score_candidates(posterior, images(part))[0] for part in candidates.split(BLOCK)]
    )
    best = candidates[exact.topk(min(POLISHED, len(exact))).indices]
    polished = best.clone().requires_grad_()
    optimizer = torch.optim.Adam([polished], betas=BETAS)
    for step in range(STEPS):  # each to its own maximum, as the score's logarithms are summed
        raise_if_cancelled()
        optimizer.param_groups[0]["lr"] = STEP_M * (1 - 0.8 * step / STEPS)
        optimizer.zero_grad()
        (-score_candidates(posterior, images(polished))[0].log().sum()).backward()
        optimizer.step()
    polished = polished.detach()
    scores, amplitude = score_candidates(posterior, images(polished))
    chosen = select_separated(polished, scores, min_distance, limit)
    return list(zip(polished[chosen], scores[chosen], amplitude[chosen], strict=True))


def select_separated(
    position: Tensor,
    scores: Tensor,
    min_distance: float,
    limit: int,
    threshold: float = 0.0,
    known: Tensor | None = None,
) -> list[int]:
    """Return indices of the best scores (n,) of at least `threshold`,
    `min_distance` [m] apart by positions.

    Also from those that are `known` (K, 3).
    """
    if known is not None:
        scores = scores * (torch.cdist(position, known).amin(1) > min_distance)
    order = (i for i in scores.argsort(descending=True).tolist() if scores[i] >= threshold)
    return keep_apart(
        order, lambda i, j: bool((position[i] - position[j]).norm() <= min_distance), limit
    )
