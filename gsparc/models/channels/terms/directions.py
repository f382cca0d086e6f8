"""Waves of unequal power from unequal directions: `E sum_b p_b w_b V_b(d)`.

V_b is the correlation of waves from about one direction, E the Matern-3/2 envelope, and w_b a
factor by its angle to the static end, 1 where directions are of the room alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Self

import torch
from torch import Tensor

from gsparc.models.channels.columns import Slot, SlotPlaces
from gsparc.models.channels.kernels import directional_correlation
from gsparc.models.channels.terms.compressed import Basis
from gsparc.models.channels.terms.term import HIGHEST, ChannelTerm
from gsparc.ops.queries import has_query_kernel, sum_directional
from gsparc.processes.kernel import distances
from gsparc.processes.left_out import ENTRIES
from gsparc.processes.matern import matern32

HALF = 0.25  # length of the mean of directions from which they are of a half sphere
TILTED = 0.5  # pull of logarithms of factors towards ends to 0: a prior of standard deviation 1


@dataclass(frozen=True, kw_only=True)
class Directions(ChannelTerm):
    """Directions beside the isotropic field.

    Attributes:
        angles: (M, 3) float64, where waves come from, of powers (M,).
        concentration: of each, that of a von Mises-Fisher density.
        towards: (J,) float64 logarithms of factors at angles to the static end, evenly from 0 to
            pi.
    """

    name = "directions"
    angles: Tensor
    concentration: float
    towards: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))

    def direction_powers(self, slots: Sequence[Slot]) -> Tensor:
        """Return powers (T, M) as ends have them; (1, M) where all have the same."""
        if not len(self.towards):
            return self.power[None]
        return self.power * (self.knot_weights(slots) @ self.towards).exp()

    def knot_weights(self, slots: Sequence[Slot]) -> Tensor:
        """Return weights (T, M, J) of the J knots in the angle between directions and ends.

        Directions of a half sphere stand for their mirror images as well: the nearer one counts.
        """
        ends, knots = (
            torch.stack([slot.end for slot in slots]) + self.frame.offset,
            len(self.towards),
        )
        towards = torch.nn.functional.normalize(ends - self.frame.middle, dim=1)
        cosine = towards @ self.angles.T
        normal = self.angles.mean(0)
        if float(torch.linalg.vector_norm(normal)) > HALF:
            normal = torch.nn.functional.normalize(normal, dim=0)
            mirrored = self.angles - 2 * (self.angles @ normal)[:, None] * normal
            cosine = torch.maximum(cosine, towards @ mirrored.T)
        at = torch.acos(cosine.clamp(-1, 1)) * ((knots - 1) / math.pi)
        return (1 - (at[..., None] - torch.arange(knots, dtype=torch.float64)).abs()).clamp_min(0)

    def sum_correlations(
        self, powers: Tensor, angles: Tensor, wavenumber: float, a: Tensor, b: Tensor
    ) -> Tensor:
        """Return sums (T, n, m) complex128 over waves from each of `angles` (M, 3)
        of powers (T, M), without the envelope.
        """
        # Differences of small numbers, wherever the origin is
        middle, squared = b[:1], (wavenumber * distances(a, b)).square()
        before, after = (wavenumber * (angles @ (places - middle).T) for places in (a, b))
        if has_query_kernel(squared, before, after, powers):
            return sum_directional(squared, before, after, powers, self.concentration)
        along = before[:, :, None] - after[:, None]
        each = directional_correlation(squared, along, self.concentration)
        return torch.tensordot(powers.to(each.dtype), each, 1)

    def covariance(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return `E sum_b p_b w_b V_b(d)` (n, m) complex128, see `Term`."""
        return next(iter(self.end_covariances([a], [b])))

    def end_covariances(self, a: Sequence[SlotPlaces], b: Sequence[SlotPlaces]) -> Iterable[Tensor]:
        """Return covariances of ends whose correlations are computed once, see `ChannelTerm`."""
        powers = self.direction_powers([places_of_slot.slot for places_of_slot in a])
        wavenumber, other, parts = a[0].slot.wavenumber, b[0].places, []
        for part in a[0].places.split(max(ENTRIES // (len(other) * len(self.angles)), 1)):
            each = self.sum_correlations(powers, self.angles, wavenumber, part, other)
            parts.append(each * matern32(distances(part, other), self.frame.envelope))
        whole = torch.cat(parts, 1)
        return whole if len(whole) == len(a) else repeat(whole[0], len(a))

    def variance(self, a: SlotPlaces) -> Tensor:
        """Return the sum of powers (n,), see `ChannelTerm`."""
        return self.direction_powers([a.slot])[0].sum().expand(len(a.places))

    def unit_covariances_in_basis(self, at: SlotPlaces, basis: Basis) -> Tensor:
        """Return those of M directions, see `ChannelTerm`."""
        places, wavenumber = at.places, at.slot.wavenumber

        def correlation_matrices() -> list[Tensor]:
            bound = matern32(distances(places, places), self.frame.envelope)
            unit = self.power.new_ones(1, 1)
            return [
                self.sum_correlations(unit, angle, wavenumber, places, places)[0] * bound
                for angle in self.angles.split(1)
            ]

        return basis.compress_once(
            (self.concentration, self.angles.numpy().tobytes()), correlation_matrices
        )

    def design(self, slot: Slot) -> Tensor:
        """Return the knots' weights beside the powers', see `ChannelTerm`."""
        columns = super().design(slot)
        return (
            torch.cat([columns, self.knot_weights([slot])[0]], 1) if len(self.towards) else columns
        )

    def parameters(self) -> Tensor:
        """Return logarithms of powers, then of factors (M + J,), see `Term`."""
        return torch.cat([self.power.log(), self.towards])

    def with_values(self, parameters: Tensor) -> Self:
        """Return the term of other ones, see `Term`."""
        count = len(self.power)
        return replace(self, power=parameters[:count].exp(), towards=parameters[count:])

    def bounds(self, scale: float = 1.0) -> list[tuple[float, float]]:
        """Return bounds of all, see `Term`."""
        return super().bounds() + [(-HIGHEST, HIGHEST)] * len(self.towards)

    def penalty(self, parameters: Tensor, shrinkage: float) -> Tensor:
        """Return that of inverse Gamma powers about their mean and of normal factors,
        see `ChannelTerm`.
        """
        power, towards = parameters[: len(self.power)].exp(), parameters[len(self.power) :]
        ratio = power.mean() / power
        return shrinkage * (ratio - ratio.log()).sum() + TILTED * towards.square().sum()
