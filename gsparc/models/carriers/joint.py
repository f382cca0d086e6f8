"""A process over places and carriers: what carriers of one place tell of each other,
and of places nearby.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from gsparc.data.ends import SAME_PLACE_M
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import distances
from gsparc.processes.left_out import LeftOutErrors, left_out_residuals
from gsparc.processes.matern import matern32
from gsparc.processes.stored import Stored

LENGTHS = (0.1, 0.2, 0.4, 0.8)  # of the site's diagonal, that are tried
SHARES, NOISES = (0.5, 2.0, 8.0), (0.3, 1.0, 3.0)  # of what the carriers of a place share
# Of the same, what carriers within some octaves share besides
NEAR_CARRIERS, OCTAVES = (0.0, 0.5), 1.0
USUAL = 0.5  # places, as which the usual noise counts beside a place's own
# Of the same, what images within .2 octaves share at neighbouring places
OWN, ALONE = (0.0, 2.0), 0.2


@dataclass(frozen=True)
class Covariance(Stored):
    """Covariance of residual images over places and carriers,
    in units of the part that a place shares.

    Attributes:
        length: over places [m].
        shared: of what neighbouring places share, at all carriers.
        near: of what near carriers of a place share.
        own: of what neighbouring places share at near carriers alone.
        noise: of a row, in the mean over places: `row_noise`.
        amplitude: of the whole, per pixel.
    """

    length: float
    shared: float
    near: float
    own: float
    noise: float
    amplitude: float = 1.0

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return covariances (n, m) of rows (n, 4) and (m, 4): places [m], and log2 of carriers."""
        distance = distances(a[:, :3], b[:, :3])
        octaves = (a[:, None, 3] - b[None, :, 3]).abs()
        same_place, alike = matern32(distance, SAME_PLACE_M), matern32(octaves, OCTAVES)
        around, carrier_term = matern32(distance, self.length), self.own * matern32(octaves, ALONE)
        # Of a carrier alone: its mean image, and what varies over places.
        return (
            self.shared * around
            + carrier_term * (1 + around)
            + same_place * (1 + self.near * alike)
        )

    def gram(self, rows: Tensor, noise: Tensor | float) -> Tensor:
        """Return covariances (n, n) of rows (n, 4) with theirs (n,) of `row_noise`."""
        return self.between(rows, rows) + self.noise * noise * torch.eye(
            len(rows), dtype=torch.float64
        )

    @property
    def prior(self) -> float:
        """Variance of a row without noise."""
        return self.shared + 2 * self.own + 1 + self.near

    @property
    def description(self) -> str:
        """Its numbers in words."""
        parts = (
            f"shared {self.shared:.3g}, near {self.near:.3g}, own {self.own:.3g}, noise "
            f"{self.noise:.3g}"
        )
        return f"length {self.length:.3g} m, {parts}"


class JointChoice(NamedTuple):
    """A covariance, the weight of paths beside it, and what both miss (n, P) of rows left out.

    Attributes:
        new: without all rows of the place.
        seen: one by one.
        carrier: without all rows of the carrier.
    """

    covariance: Covariance
    weight: float
    new: Tensor
    seen: Tensor
    carrier: Tensor


def row_noise(images: Tensor, groups: list[Tensor]) -> Tensor:
    """Return how far images (n, P) of a place are from each other (n,), 1 in the mean over places.

    Where one path is most of what arrives all carriers see the same; phases between several differ.
    """
    squared = torch.stack([(images[rows] - images[rows].mean(0)).square().sum() for rows in groups])
    free = torch.tensor([len(rows) - 1.0 for rows in groups], dtype=torch.float64)
    usual = squared.sum().clamp_min(1e-9) / free.sum().clamp_min(1.0)
    noise = images.new_ones(len(images))
    for rows, noise_of_group in zip(
        groups, (squared / usual + USUAL) / (free + USUAL), strict=True
    ):
        noise[rows] = noise_of_group
    return noise


def choose_joint(
    rows: Tensor,
    images: Tensor,
    paths: Tensor,
    noise: Tensor,
    groups: list[Tensor],
    carriers: list[Tensor],
    entries: int,
) -> JointChoice:
    """Return the covariance and weight of paths of least error at places and at rows left out.

    Args:
        rows: (n, 4), places [m] and log2 of carriers.
        images: (n, P) float64, components of images of so many `entries`, about their mean.
        paths: (n, P) float64, images expected of paths, about the same mean.
        noise: (n,) of `row_noise`.
        groups, carriers: rows of each place, and of each carrier.
        entries: pixels.
    """
    both, best, result = torch.cat([images, paths], 1), math.inf, None
    for candidate in _candidates(float((rows[:, :3].amax(0) - rows[:, :3].amin(0)).norm()) or 1.0):
        inverse = Factor.from_gram(candidate.gram(rows, noise)).inverse
        solved = inverse @ both
        away = left_out_residuals(inverse, solved, groups)
        # Residuals are linear in what is taken off: the best weight is a quotient.
        image, path = away.residual.chunk(2, dim=1)
        weighted_path = path / noise[:, None]
        weight = float((image * weighted_path).sum() / (path * weighted_path).sum().clamp_min(1e-9))
        weight = min(max(weight, 0.0), 1.0)
        new, seen = (
            _without_paths(each, weight) for each in (away, left_out_residuals(inverse, solved))
        )
        # As of ratios in decibels: what is told well counts as much as what is not.
        error = sum(
            float(missed.square().sum(1).clamp_min(1e-9).log().mean()) for missed in (new, seen)
        )
        if error < best:
            scaled = replace(
                candidate, amplitude=float((new.square().sum(1) / away.variance).mean()) / entries
            )
            carrier = _without_paths(left_out_residuals(inverse, solved, carriers), weight)
            best, result = error, JointChoice(scaled, weight, new, seen, carrier)
    assert result is not None
    return result


def _candidates(diagonal: float) -> Iterator[Covariance]:
    for length, *parts in product(LENGTHS, SHARES, NEAR_CARRIERS, OWN, NOISES):
        yield Covariance(length * diagonal, *parts)


def _without_paths(errors: LeftOutErrors, weight: float) -> Tensor:
    image, path = errors.residual.chunk(2, dim=1)
    return image - weight * path
