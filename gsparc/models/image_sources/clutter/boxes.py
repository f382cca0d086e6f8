"""Find the box that would explain most of the residual: random candidates,
then an evolution strategy.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import MARGIN, share_past_boxes
from gsparc.models.image_sources.clutter.residual import UnexplainedRows
from gsparc.physics.draws import sample_in_box, sample_log_uniform

THINNEST = MARGIN  # [m]: thinner ones block nothing
SMALLEST, LARGEST = 0.15, 2.0  # [m] sides of random boxes
# Of random boxes: shares that are thin plates, that do not stand on the floor
TABLES, FLOOR = 0.35, 0.6
PARENTS, CHILDREN = 12, 6  # of the evolution strategy; children of each parent and round
# First standard deviation of a mutation [m], and factor from round to round
SPREAD, FALL = 0.3, 0.82
HALVED = (4, 8)  # rounds after which only the better half is kept
STRONGEST = 24  # number of sources that a box is searched with


def maximise_by_evolution(
    parents: Tensor,
    score: Callable[[Tensor], Tensor],
    repair: Callable[[Tensor], Tensor],
    generator: torch.Generator,
    rounds: int = 14,
) -> tuple[Tensor, float]:
    """Return the best descendant (d,) of parents (m, d) of a (mu, lambda) strategy,
    and its score.
    """
    best, spread = score(parents), SPREAD
    for number in range(rounds):
        born = parents.repeat_interleave(CHILDREN, 0)
        which = torch.rand(born.shape, generator=generator) < 0.5
        born = repair(born + spread * torch.randn(born.shape, generator=generator) * which)
        scores, chosen = score(born).view(len(parents), -1).max(1)
        better = scores > best
        heirs = born.view(len(parents), -1, born.shape[1])[torch.arange(len(parents)), chosen]
        parents = torch.where(better[:, None], heirs, parents)
        best, spread = torch.maximum(best, scores), spread * FALL
        if number in HALVED:
            top = (
                best.topk(max(len(best) // 2, 3)).indices
                if len(best) > 3
                else torch.arange(len(best))
            )
            parents, best = parents[top], best[top]
    first = int(best.argmax())
    return parents[first], float(best[first])


def find_occluding_box(unexplained: UnexplainedRows, draws: int = 1000) -> tuple[Tensor, float]:
    """Return the box (6,) whose shadow explains most, and its gain [nats].

    Args:
        unexplained: what a shadow may explain.
        draws: random boxes, of which the best evolve.
    """
    waves = unexplained.waves * unexplained.scorer.gains
    chosen = waves.abs().square().sum(0).topk(min(STRONGEST, waves.shape[1])).indices
    few, waves = unexplained.paths.select_sequences(chosen), waves[:, chosen]

    def gain_of_boxes(boxes: Tensor) -> Tensor:
        return unexplained.scorer.gains_of_shares(
            boxes, lambda part: share_past_boxes(few, part) - 1, waves
        )

    def clip(boxes: Tensor) -> Tensor:
        return clip_boxes(boxes, unexplained.room)

    starts = clip(_draw_boxes(draws, unexplained.room, unexplained.generator))
    starts = starts[gain_of_boxes(starts).topk(min(PARENTS, draws)).indices]
    return maximise_by_evolution(starts, gain_of_boxes, clip, unexplained.generator)


def clip_boxes(boxes: Tensor, room: Tensor) -> Tensor:
    """Return boxes (m, 6) cut to the room; of one outside, low corners lie above high ones."""
    low, high = boxes.chunk(2, 1)
    low = torch.minimum(low, high - THINNEST)
    return torch.cat([torch.maximum(low, room[0]), torch.minimum(high, room[1])], 1)


def _draw_boxes(count: int, room: Tensor, generator: torch.Generator) -> Tensor:
    lowest, highest = room
    middle = sample_in_box(lowest, highest, count, generator)
    kind = torch.rand(count, generator=generator)
    size = sample_log_uniform(SMALLEST, LARGEST, middle, generator)
    size[kind < TABLES, 2] = 2 * THINNEST
    low, high = middle - size / 2, middle + size / 2
    low[kind > FLOOR, 2] = room[0, 2]
    return torch.cat([low, high], 1)
