"""Adam (D. P. Kingma and J. Ba, ICLR 2015) on a handful of tensors whose slopes are known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

FIRST, SECOND = 0.8, 0.95  # decays: short memories, for tens of steps
SLOW_AFTER, SLOW = 0.6, 0.3  # smaller steps for the last 40 %

Slopes = Callable[[int, list[Tensor]], tuple[float, list[Tensor]]]


def descend(values: list[Tensor], rates: list[Tensor], steps: int, slopes: Slopes) -> list[Tensor]:
    """The best values met.

    Args:
        values: where to start.
        rates: step sizes, broadcast against the values.
        steps: at least 0.
        slopes: step number and values to the objective and its derivatives.
    """
    first, second = [torch.zeros_like(v) for v in values], [torch.zeros_like(v) for v in values]
    best, lowest = values, math.inf
    for step in range(steps + 1):
        objective, gradient = slopes(step, values)
        if objective < lowest:
            lowest, best = objective, values
        if step == steps:
            break
        pace = 1.0 if step < SLOW_AFTER * steps else SLOW
        moved = []
        for i, g in enumerate(gradient):
            first[i] = FIRST * first[i] + (1 - FIRST) * g
            second[i] = SECOND * second[i] + (1 - SECOND) * g * g
            mean = first[i] / (1 - FIRST ** (step + 1))
            size = (second[i] / (1 - SECOND ** (step + 1))).sqrt() + 1e-9
            moved.append(values[i] - pace * rates[i] * mean / size)
        values = moved
    return best
