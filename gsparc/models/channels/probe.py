"""What one more wave of known shape would gain in likelihood,
and where static ends really are by that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group
from gsparc.models.channels.evidence import BasisGroup, solve_group
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Direct
from gsparc.processes.density import TINY
from gsparc.processes.factor import Factor
from gsparc.processes.left_out import ENTRIES
from gsparc.processes.places import ORIGIN
from gsparc.processes.worker import raise_if_cancelled

REACH = 1.0  # wavelengths to either side that are looked at, and the prior's standard deviation
COARSE = 4  # steps to either side
REFINED = 3  # halvings of the step


@dataclass(frozen=True)
class Probe:
    """A group's inverse covariance for terms of rank one: (1 - B B^T) / noise + F F^H - T T^H.

    Attributes:
        group: whose, with targets of unit mean square.
        basis: B (n, r) complex128, outside of which there is noise alone.
        root: F (n, r) complex128.
        downdate: T (n, t) complex128, of the waves that were added.
        alpha: (n, D) complex128, the inverse times the targets.
        noise, scale: the group's own powers.
    """

    group: Group
    basis: Tensor
    root: Tensor
    downdate: Tensor
    alpha: Tensor
    noise: float
    scale: float

    @staticmethod
    def from_group(part: BasisGroup, prior: ChannelPrior) -> Probe:
        """Factor a group's covariance with its own powers."""
        at, basis, noise = (
            solve_group(part, part.powers(prior)),
            part.basis.to(torch.complex128),
            prior.noise,
        )
        alpha = basis @ at.given.weights + (part.group.target - basis @ part.target) / noise
        inverse = at.given.factor.inverse
        root = basis @ Factor.from_gram(inverse + 1e-12 * torch.eye(len(inverse))).lower
        return Probe(part.group, basis, root, basis[:, :0], alpha, noise, at.scale)

    def wave_precision(self, waves: Tensor) -> Tensor:
        """Return f^H C^-1 f (m,) float64 of waves (m, n)."""
        inside, basis, downdate = (
            (waves.conj() @ each).abs().square().sum(1)
            for each in (self.root, self.basis, self.downdate)
        )
        outside = waves.abs().square().sum(1) - basis
        return (inside + outside.clamp_min(0) / self.noise - downdate).clamp_min(0)

    def likelihood_gain(
        self, waves: Tensor, level: float, precision: Tensor | None = None
    ) -> Tensor:
        """Return log likelihood gains (m,) [nats] by each of waves (m, n) complex128 alone,
        of some power.

        `precision` (m,) stands in for `known(waves)`.
        """
        inner = (waves.conj() @ self.alpha).abs().square().sum(1)
        size = 1 + level * (self.wave_precision(waves) if precision is None else precision)
        return level * inner / size / self.scale - self.alpha.shape[1] * size.log()

    def add_wave(self, wave: Tensor, level: float) -> Probe:
        """Return the probe with a wave (n,) of some power among the terms."""
        dual = self.root @ (self.root.mH @ wave) - self.downdate @ (self.downdate.mH @ wave)
        dual = dual + (wave - self.basis @ (self.basis.mH @ wave)) / self.noise
        share = level / (1 + level * float((wave.conj() @ dual).real))
        alpha = self.alpha - share * dual[:, None] * (wave.conj() @ self.alpha)[None]
        return replace(
            self, alpha=alpha, downdate=torch.cat([self.downdate, share**0.5 * dual[:, None]], 1)
        )


def likelihood_gains(
    probes: Sequence[Probe],
    count: int,
    waves_of: Callable[[Probe, Tensor], Tensor],
    levels: Sequence[float],
    wave_precision: Callable[[Probe, Tensor], Tensor] = Probe.wave_precision,
) -> Tensor:
    """Return log likelihood gains (count, levels) of all groups; `waves_of` (m, n)
    are of numbers (m,).
    """
    total = torch.zeros(count, len(levels), dtype=torch.float64)
    for probe in probes:
        for chunk in torch.arange(count).split(max(ENTRIES // len(probe.group), 1)):
            raise_if_cancelled()
            each = waves_of(probe, chunk)
            size = wave_precision(probe, each)
            total[chunk] += torch.stack(
                [probe.likelihood_gain(each, level, size) for level in levels], 1
            )
    return total


def find_static_offset(
    parts: tuple[BasisGroup, ...], prior: ChannelPrior, wavelength: float
) -> Tensor | None:
    """Return the likeliest offset (3,) float64 [m] on a grid that is refined,
    or None for none better.

    Beside the direct wave all terms are held as they are, its varying gain left out.
    """
    direct = prior[Direct]
    none = prior.with_terms(replace(direct, power=torch.full_like(direct.power, TINY)))
    probes, level = [Probe.from_group(part, none) for part in parts], float(direct.power.sum())

    def log_posterior_gain(offsets: Tensor) -> Tensor:
        def direct_waves(probe: Probe, chunk: Tensor) -> Tensor:
            moved = (
                replace(direct, frame=replace(direct.frame, offset=offset))
                for offset in offsets[chunk]
            )
            return torch.cat([at.waves(probe.group) for at in moved])

        likely = -0.5 * (offsets / (REACH * wavelength)).square().sum(1)
        return likely + likelihood_gains(probes, len(offsets), direct_waves, (level,))[:, 0]

    best, step = ORIGIN, REACH * wavelength / COARSE
    near = torch.arange(-1, 2, dtype=torch.float64)
    coarse = torch.arange(-COARSE, COARSE + 1, dtype=torch.float64)
    for axis in (coarse, *(near / 2**halving for halving in range(1, REFINED + 1))):
        grid = best + step * torch.cartesian_prod(axis, axis, axis)
        best = grid[log_posterior_gain(grid).argmax()]
    unmoved, best_gain = log_posterior_gain(torch.stack([ORIGIN, best])).tolist()
    return best if math.isfinite(best_gain) and best_gain > unmoved else None
