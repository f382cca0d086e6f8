"""Where static ends really are: one offset for all of them, by the direct wave's likelihood."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.channels.covariance import Shape, Values, direct_wave
from gsparc.models.channels.evidence import Compressed
from gsparc.models.channels.probe import Probe, summed_gains

REACH = 1.0  # wavelengths to either side that are looked at, and the prior's standard deviation
COARSE = 4  # steps to either side
REFINED = 3  # halvings of the step


def best_offset(
    parts: tuple[Compressed, ...], shape: Shape, values: Values, wavelength: float
) -> Tensor | None:
    """The offset (3,) float64 [m] of largest likelihood on a grid that is refined, or None for none better.

    Beside the direct wave all terms are held as they are, its varying gain left out.
    """
    power, names = values.power.clone(), shape.names
    level = float(shape.of("direct", power).sum() + shape.of("direct_smooth", power).sum())
    for number, name in enumerate(names):
        if name in ("direct", "direct_smooth"):
            power[number] = 1e-12
    probes = [Probe.of(part, power) for part in parts]

    def gain(offsets: Tensor) -> Tensor:
        def waves(probe: Probe, chunk: Tensor) -> Tensor:
            moved = (replace(values, offset=offset) for offset in offsets[chunk])
            return torch.stack([direct_wave(shape, at, probe.group.slot, probe.group.places) for at in moved])

        prior = -0.5 * (offsets / (REACH * wavelength)).square().sum(1)
        return prior + summed_gains(probes, len(offsets), waves, (level,))[:, 0]

    step = REACH * wavelength / COARSE
    axis = torch.arange(-COARSE, COARSE + 1, dtype=torch.float64) * step
    best = torch.zeros(3, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis, axis)
    for _ in range(1 + REFINED):
        score = gain(best + grid)
        best = best + grid[score.argmax()]
        step = step / 2
        near = torch.tensor([-step, 0.0, step], dtype=torch.float64)
        grid = torch.cartesian_prod(near, near, near)
    none, found = gain(torch.stack([torch.zeros(3, dtype=torch.float64), best])).tolist()
    return best if math.isfinite(found) and found > none else None
