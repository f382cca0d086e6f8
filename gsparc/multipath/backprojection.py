"""Find the source that would explain most of the residual: back-projection over a box, then gradient ascent.

The gain in log likelihood of a source at p, its amplitude free, grows with the matched filter

    score(p) = |a(p)^H K^-1 y|^2 / (a(p)^H K^-1 a(p))

summed over outputs; K is the covariance of the sources found so far, so that the residual need not be formed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.multipath.gp_likelihood import Factor, steering
from gsparc.multipath.rows import Rows
from gsparc.physics.waves import LIGHT, NEAR_M

BLOCK = 1024  # candidates at a time, so that a block stays in cache


@dataclass(frozen=True)
class Detections:
    """New sources, best first: position (m, 3) float64 [m], score (m,), amplitude (m,)."""

    position: Tensor
    score: Tensor
    amplitude: Tensor


def score(rows: Rows, candidates: Tensor, factor: Factor) -> tuple[Tensor, Tensor]:
    """Score (m,) of candidate positions (m, 3) float64 [m], and the amplitude (m,) each would have."""
    return score_waves(steering(rows, candidates), factor)


def score_waves(waves: Tensor, factor: Factor) -> tuple[Tensor, Tensor]:
    """The same of any waves (n, m) complex64."""
    matched = (waves.mH @ factor.alpha).abs().square().sum(1)
    power = (factor.root @ waves).abs().square().sum(0)
    gained = matched / power
    return gained / factor.alpha.shape[1], (gained / power / factor.alpha.shape[1]).sqrt()


def quick_score(rows: Rows, candidates: Tensor, alpha: Tensor) -> Tensor:
    """`|a^H alpha|^2 / |a|^2` (m,), ranges in float32: good to a thousandth of a cycle in a building."""
    middle = rows.position.mean(0)
    places, points = (rows.position - middle).float(), (candidates - middle).float()
    length = places.square().sum(1)
    per_metre = (rows.frequency / LIGHT).float()
    real, imag = alpha.real.contiguous(), alpha.imag.contiguous()
    scores = []
    for block in points.split(BLOCK):
        squared = torch.addmm(length, block, places.T, alpha=-2).add_(block.square().sum(1)[:, None])
        distance = squared.clamp_min_(NEAR_M**2).sqrt_()
        cycles = distance * per_metre
        phase = cycles.sub_(cycles.round()).mul_(2 * math.pi)
        loss = distance.reciprocal_()
        cosine, sine = phase.cos().mul_(loss), phase.sin_().mul_(loss)
        matched = (cosine @ real - sine @ imag).square() + (cosine @ imag + sine @ real).square()
        scores.append(matched.sum(1) / loss.square_().sum(1))
    return torch.cat(scores)


@dataclass(frozen=True)
class Effort:
    """Effort of a search.

    Attributes:
        candidates: random points in the box.
        exact: of them scored exactly.
        polished: of those moved by gradient ascent.
        steps: of the ascent.
        step_m: its step size [m].
    """

    candidates: int = 150_000
    exact: int = 1_500
    polished: int = 40
    steps: int = 25
    step_m: float = 0.02


def search_box(
    rows: Rows,
    factor: Factor,
    box: Tensor,
    min_distance: float,
    limit: int,
    generator: torch.Generator,
    effort: Effort = Effort(),
) -> Detections:
    """The best `limit` new sources in a box (2, 3) float64 [m], at least `min_distance` [m] apart."""
    drawn = torch.rand(effort.candidates, 3, generator=generator, dtype=torch.float64)
    candidates = box[0] + (box[1] - box[0]) * drawn
    rough = quick_score(rows, candidates, factor.alpha)
    candidates = candidates[rough.topk(min(effort.exact, len(rough))).indices]
    exact = torch.cat([score(rows, part, factor)[0] for part in candidates.split(512)])
    best = candidates[exact.topk(min(effort.polished, len(exact))).indices]
    rates = [effort.step_m * (1 - 0.8 * step / effort.steps) for step in range(effort.steps)]
    (polished,) = ascend([best], lambda position: score(rows, position, factor)[0], rates)
    scores, amplitude = score(rows, polished, factor)
    chosen = pick_apart(polished, scores, min_distance, limit)
    return Detections(polished[chosen], scores[chosen], amplitude[chosen])


def ascend(values: list[Tensor], scores: Callable[..., Tensor], rates: list[float]) -> list[Tensor]:
    """Values (m, ...) after steps of Adam of `rates` on the sum of log scores, each to its own maximum."""
    leaves = [value.clone().requires_grad_() for value in values]
    optimizer = torch.optim.Adam(leaves, betas=(0.8, 0.95))
    for rate in rates:
        optimizer.param_groups[0]["lr"] = rate
        optimizer.zero_grad()
        (-scores(*leaves).log().sum()).backward()
        optimizer.step()
    return [leaf.detach() for leaf in leaves]


def pick_apart(
    position: Tensor, scores: Tensor, min_distance: float, limit: int, threshold: float = 0.0
) -> list[int]:
    """Indices of the best scores (n,) of at least `threshold`, positions (n, 3) `min_distance` [m] apart."""
    chosen: list[int] = []
    for i in scores.argsort(descending=True).tolist():
        if scores[i] < threshold or len(chosen) == limit:
            break
        if all((position[i] - position[j]).norm() > min_distance for j in chosen):
            chosen.append(i)
    return chosen
