"""What static ends have in common, for one that nothing was learned from but its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.multipath.waves.columns import Group, Slot
from gsparc.multipath.waves.covariance import Shape, Values, direct_wave, prior


@dataclass(frozen=True)
class Common:
    """Gain of the direct wave and level of ends, each times the distance to the places' middle.

    Attributes:
        gain: () complex128 [m], the ends' mean: small where their phases are unrelated.
        steady, spread: [m^2] squared size of the true mean, and the variance of `gain` about it.
        level: [m^2] power that covariances are in units of.
    """

    gain: Tensor
    steady: float
    spread: float
    level: float

    @staticmethod
    def of(shape: Shape, values: Values, known: Sequence[tuple[Group, Tensor, float]]) -> Common:
        """From groups, their inverse covariances times targets (n, D), and scales."""
        gains, levels = [], []
        for group, alpha, scale in known:
            away = _away(shape, values, group.slot)
            wave = torch.zeros(len(group), dtype=torch.complex128)
            if shape.direct:
                wave = direct_wave(shape, values, group.slot, group.places)
                wave = wave * shape.of("direct", values.power)
            gains.append(away * (wave.conj() @ alpha).mean())
            levels.append(scale * away**2)
        each = torch.stack(gains)
        count, gain = len(each), each.mean()
        whole, mean = float(each.abs().square().mean()), float(gain.abs().square())
        steady = max((count * mean - whole) / (count - 1), 0.0) if count > 1 else 0.0
        return Common(gain, steady, (whole - steady) / count, float(torch.stack(levels).mean()))

    def at(self, shape: Shape, values: Values, slot: Slot, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean (n,) complex128 of a slot's entries, their variance (n,), and that before learning."""
        away = _away(shape, values, slot)
        before = self.level / away**2 * prior(shape, values, slot, places)
        if not shape.direct:
            return torch.zeros(len(places), dtype=torch.complex128), before, before
        wave = direct_wave(shape, values, slot, places) / away
        after = before + (self.spread - self.steady) * wave.abs().square()
        return self.gain * wave, after.clamp_min(0), before


def _away(shape: Shape, values: Values, slot: Slot) -> Tensor:
    """Distance () [m] of the end to the places' middle; 1 where no wave of it is known."""
    if not shape.direct:
        return torch.ones((), dtype=torch.float64)
    return torch.linalg.vector_norm(slot.end + values.offset - shape.middle)
