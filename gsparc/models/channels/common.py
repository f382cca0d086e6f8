"""What static ends have in common, for one that nothing was learned from but its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import At, Group, Slot
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Direct


@dataclass(frozen=True)
class Common:
    """The gain of the direct wave, 0 where there is none, and the level of ends.

    Attributes:
        gain: () complex128 [m], the ends' mean times distances to the places' middle.
        explained: () [m^2] what knowing it takes from the power.
        level: [m^2] power that covariances are in units of.
    """

    gain: Tensor
    explained: Tensor
    level: float

    @staticmethod
    def of(prior: ChannelPrior, known: Sequence[tuple[Group, Tensor, float]]) -> Common:
        """Estimate from groups, their inverse covariances times targets (n, D), and scales."""
        direct, gains, levels = prior.get(Direct), [], []
        for group, alpha, scale in known:
            away = _away(prior, group.slot)
            levels.append(scale * float(away) ** 2)
            if direct is not None:
                gains.append(away * direct.power[0] * (direct.wave(group).conj() @ alpha).mean())
        each, count = (
            torch.stack(gains) if gains else torch.zeros(len(known), dtype=torch.complex128),
            len(known),
        )
        gain, whole = each.mean(), each.abs().square().mean()
        # Unbiased: of n ends |mean|^2 is too large by a variance / n.
        steady = ((count * gain.abs().square() - whole) / max(count - 1, 1)).clamp_min(0)
        return Common(gain, steady - (whole - steady) / count, sum(levels) / count)

    def at(self, prior: ChannelPrior, at: At) -> tuple[Tensor, Tensor, Tensor]:
        """Mean (n,) complex128 of a slot's entries, their variance (n,), and that before learning."""
        direct, away = prior.get(Direct), _away(prior, at.slot)
        before = self.level / away**2 * prior.variance(at)
        wave = (
            torch.zeros(len(at.places), dtype=torch.complex128) if direct is None else direct.wave(at) / away
        )
        return self.gain * wave, (before - self.explained * wave.abs().square()).clamp_min(0), before


def _away(prior: ChannelPrior, slot: Slot) -> Tensor:
    """Distance () [m] of the end to the places' middle; 1 where no wave of it is known."""
    direct = prior.get(Direct)
    return torch.ones((), dtype=torch.float64) if direct is None else direct.away(slot)
