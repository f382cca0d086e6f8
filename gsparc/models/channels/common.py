"""What static ends have in common, for one that nothing was learned from but its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, Slot, SlotPlaces
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Direct
from gsparc.models.channels.terms.spherical import Spherical
from gsparc.models.closed_form import Moments
from gsparc.processes.density import TINY


@dataclass(frozen=True)
class SharedGains:
    """Gains of the direct wave and of images in shared planes (J,), and the level of ends.

    Attributes:
        gain: (J,) complex128 [m], the ends' mean times distances to the places' middle; of images
            the smaller the less sure it is: small where phases are unrelated.
        explained: (J,) [m^2] what knowing it takes from the power.
        level: [m^2] power that covariances are in units of.
    """

    gain: Tensor
    explained: Tensor
    level: float

    @staticmethod
    def from_groups(
        prior: ChannelPrior, known: Sequence[tuple[Group, Tensor, float]]
    ) -> SharedGains:
        """Estimate from groups, their inverse covariances times targets (n, D), and scales."""
        gains, levels = [], []
        for group, alpha, scale in known:
            waves, power, away = _waves_and_powers(prior, group)
            gains.append(away * power * (waves.conj() @ alpha).mean(1))
            levels.append(scale * float(_distance_to_middle(prior, group.slot)) ** 2)
        each = torch.stack(gains)
        count, gain = len(each), each.mean(0)
        whole, mean = each.abs().square().mean(0), gain.abs().square()
        # Unbiased: of n ends |mean|^2 is too large by a variance / n.
        steady = ((count * mean - whole) / max(count - 1, 1)).clamp_min(0)
        spread = (whole - steady) / count
        # Wiener's factor of the mean: its power over that with its error.
        reliability = steady / (steady + spread).clamp_min(TINY)
        explained = steady * reliability
        # The direct wave stays: unsure as its gain may be, its shape is right.
        reliability[:1], explained[:1] = 1.0, steady[:1] - spread[:1]
        return SharedGains(gain * reliability, explained, sum(levels) / count)

    def predict(self, prior: ChannelPrior, at: SlotPlaces) -> Moments:
        """Return the mean (n,) complex128 of a slot's entries, their variance (n,),
        and that before learning.
        """
        before = self.level / _distance_to_middle(prior, at.slot) ** 2 * prior.variance(at)
        waves, _, away = _waves_and_powers(prior, at)
        waves = waves / away[:, None]
        after = before - self.explained @ waves.abs().square()
        return Moments(self.gain @ waves, after.clamp_min(0), before)


def _waves_and_powers(prior: ChannelPrior, at: SlotPlaces) -> tuple[Tensor, Tensor, Tensor]:
    """Waves (J, n) of an end and its images, powers (J,)
    of fixed gains and distances to the middle (J,).
    """
    terms = [term for term in prior.terms if isinstance(term, Spherical)]
    if not terms:
        none = at.places.new_zeros(0)
        return at.places.new_zeros(0, len(at.places), dtype=torch.complex128), none, none
    each = [
        (term.waves(at), term.split_powers[0], term.source_distances(at.slot)) for term in terms
    ]
    waves, power, away = (torch.cat(parts) for parts in zip(*each, strict=True))
    return waves, power, away


def _distance_to_middle(prior: ChannelPrior, slot: Slot) -> Tensor:
    """Distance () [m] of the end to the places' middle; 1 where no wave of it is known."""
    direct = prior.find_term(Direct)
    return (
        torch.ones((), dtype=torch.float64) if direct is None else direct.source_distances(slot)[0]
    )
