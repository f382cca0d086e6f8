"""Adam (D. P. Kingma and J. Ba, ICLR 2015) on a few tensors whose gradients are known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

BETA1, BETA2 = 0.8, 0.95  # decay rates of the moments, for tens of steps
DECAY_AFTER, DECAY = 0.6, 0.3  # smaller steps for the last 40 %

Objective = Callable[[int, list[Tensor]], tuple[float, list[Tensor]]]


def descend(values: list[Tensor], rates: list[Tensor], steps: int, objective: Objective) -> list[Tensor]:
    """The best values found.

    Args:
        values: where to start.
        rates: step sizes, broadcast against the values.
        steps: at least 0.
        objective: step number and values to the objective and its derivatives.
    """
    first, second = [torch.zeros_like(v) for v in values], [torch.zeros_like(v) for v in values]
    best, lowest = values, math.inf
    for step in range(steps + 1):
        value, gradient = objective(step, values)
        if value < lowest:
            lowest, best = value, values
        if step == steps:
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
    return best
