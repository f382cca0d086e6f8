"""What static ends have in common, for one that nothing was learned from but its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, Slot
from gsparc.models.channels.covariance import Values, prior, waves_of
from gsparc.physics.mirror_planes import images


@dataclass(frozen=True)
class Common:
    """Gains of the direct wave and of images in shared planes (J,), and the level of ends.

    Attributes:
        gain: (J,) complex128 [m], the ends' mean times distances to the places' middle; of images the smaller
            the less sure it is: small where phases are unrelated.
        explained: (J,) [m^2] what knowing it takes from the power.
        level: [m^2] power that covariances are in units of.
    """

    gain: Tensor
    explained: Tensor
    level: float

    @staticmethod
    def of(values: Values, known: Sequence[tuple[Group, Tensor, float]]) -> Common:
        """From groups, their inverse covariances times targets (n, D), and scales."""
        gains, levels = [], []
        for group, alpha, scale in known:
            waves, power, away = _waves(values, group.slot, group.places)
            gains.append(away * power * (waves.conj() @ alpha).mean(1))
            levels.append(scale * float(_away(values, group.slot)) ** 2)
        each = torch.stack(gains)
        count, gain = len(each), each.mean(0)
        whole, mean = each.abs().square().mean(0), gain.abs().square()
        steady = ((count * mean - whole) / max(count - 1, 1)).clamp_min(0)
        spread = (whole - steady) / count
        reliability = steady / (steady + spread).clamp_min(1e-300)
        explained = steady * reliability
        # The direct wave stays: unsure as its gain may be, its shape is right.
        reliability[:1], explained[:1] = 1.0, steady[:1] - spread[:1]
        return Common(gain * reliability, explained, sum(levels) / count)

    def at(self, values: Values, slot: Slot, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean (n,) complex128 of a slot's entries, their variance (n,), and that before learning."""
        before = self.level / _away(values, slot) ** 2 * prior(values, slot, places)
        waves, _, away = _waves(values, slot, places)
        waves = waves / away[:, None]
        after = before - self.explained @ waves.abs().square()
        return self.gain @ waves, after.clamp_min(0), before


def _waves(values: Values, slot: Slot, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Waves (J, n) of an end and its images, their powers (J,) and distances to the middle (J,) [m]."""
    if not values.direct:
        none = places.new_zeros(0)
        return places.new_zeros(0, len(places), dtype=torch.complex128), none, none
    end = slot.end + values.offset
    placed = torch.cat([end[None], images(end, values.planes, values.sequences)])
    away = torch.linalg.vector_norm(placed - values.middle, dim=-1)
    return waves_of(values, slot, places), values.gains()[0], away


def _away(values: Values, slot: Slot) -> Tensor:
    """Distance () [m] of the end to the places' middle; 1 where no wave of it is known."""
    if not values.direct:
        return torch.ones((), dtype=torch.float64)
    return torch.linalg.vector_norm(slot.end + values.offset - values.middle)
