"""Directions of arrival at places that nobody measured: the direct path,
and images in mirror planes.

Carriers of one place have the same paths under other phases: the mean of their spectra in power is
nearly the incoherent sum of the paths. Planes are those whose images explain the means at all
training places together, found one after the other;
what each path carries there is solved in nonnegative numbers.

`moving_array` solves powers alike, for sources that stand: there they are points where bearings of
a moving array meet, here planes, as the images of a moving transmitter move. `image_sources` reads
phases: its planes are bisectors of sources that a coherent likelihood places,
which spectra without phases do not have.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.data.ends import SAME_PLACE_M
from gsparc.models.moving_array.triangulate import nonnegative_powers, sum_lags
from gsparc.physics.array_response import normalise_spectrum
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.physics.lags import SpectrumLags
from gsparc.physics.mirror_planes import NO_PLANES, reflect
from gsparc.processes.factor import Factor
from gsparc.processes.stored import Stored

PLANES = 8  # at most
REACH, STEP = 3.0, 0.05  # beyond the box of both ends, and between planes that are tried [m]
# Of planes that tell how the room is turned [m], and of turns [degrees]
COARSE_STEP, TURN_STEP = 0.2, 6
NEARLY = 0.9  # of what planes along the axes leave over, which others must be below
LEAST_GAIN = 0.003  # of the energy: a plane that explains less is none
LEAST_ALONE = 0.02  # of an image's energy
RIDGE = 0.02  # of the powers' solve
# Shares at a place: of the nearest, by distance, and of all
NEIGHBOURS, LEAST_M, COMMON = 8, 0.3, 0.15
DRAWS = 24  # of the phases between paths


@dataclass(frozen=True)
class SharedPaths(Stored):
    """Paths from a place to the receiver.

    Attributes:
        planes: (K, 4) float64, mirrors.
        receiver: (3,) float64 [m].
        rotation: (3, 3) float64, of the receiver.
        places: (n, 3) float64 [m], where shares are known.
        shares: (n, K + 1) float64, powers times distance squared of the direct path and of images,
            of sum 1.
    """

    planes: Tensor
    receiver: Tensor
    rotation: Tensor
    places: Tensor
    shares: Tensor

    def ways(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return directions (n, K + 1, 3) of arrival, receiver frame, and distances (n, K + 1)
        [m].
        """
        return directions_and_distances(places, self.planes, self.receiver, self.rotation)

    def powers(self, places: Tensor) -> Tensor:
        """Return what paths carry to places (n, 3), (n, K + 1), of sum 1;
        one that was measured by others.
        """
        distance = torch.cdist(places, self.places)
        # A place does not tell its own shares.
        weight = torch.where(distance < SAME_PLACE_M, 0.0, 1 / distance.clamp_min(LEAST_M).square())
        near = weight.topk(min(NEIGHBOURS, len(self.places)), dim=1)
        mean = (near.values[..., None] * self.shares[near.indices]).sum(1) / near.values.sum(
            1, keepdim=True
        )
        shares = (1 - COMMON) * mean + COMMON * self.shares.mean(0)
        return normalize(shares / self.ways(places)[1].square(), p=1, dim=1)


def directions_and_distances(
    places: Tensor, planes: Tensor, receiver: Tensor, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    """Return directions (n, K + 1, 3) of places (n, 3) and their images, receiver frame;
    distances [m].
    """
    mirrored = reflect(places[:, None], planes)
    away = torch.cat([places[:, None], mirrored], 1) - receiver
    distance = away.norm(dim=2).clamp_min(LEAST_M)
    return away @ rotation / distance[..., None], distance


def find_paths(
    lags: SpectrumLags, seen: Tensor, places: Tensor, receiver: Tensor, rotation: Tensor
) -> SharedPaths:
    """Return planes and shares that explain lags `seen` (n, count) at places (n, 3) [m]."""
    metric = Factor.from_gram(lags.gram).lower  # of lags to pixels: energies are of images
    target, ends = seen.double() @ metric, torch.cat([places, receiver[None]])

    def looks(planes: Tensor) -> Tensor:
        directions = directions_and_distances(places, planes, receiver, rotation)[0]
        return lags.plane_wave_lags(directions.float()).double() @ metric

    # Walls stand at right angles to each other:
    # which way is told by a coarse search in every direction.
    trials = [
        _planes_to_try(ends, turn, COARSE_STEP) for turn in torch.arange(0, 90, TURN_STEP).deg2rad()
    ]
    errors = torch.stack(
        [_choose_planes(looks, trial, target)[2].square().sum() for trial in trials]
    )
    errors[0] *= NEARLY  # along the axes, where that is nearly as good
    turn = torch.tensor(TURN_STEP * int(errors.argmin())).deg2rad()
    planes, powers, _ = _choose_planes(looks, _planes_to_try(ends, turn, STEP), target)
    distance = directions_and_distances(places, planes, receiver, rotation)[1]
    return SharedPaths(
        planes, receiver, rotation, places, normalize(powers * distance.square(), p=1, dim=1)
    )


def _choose_planes(
    looks: Callable[[Tensor], Tensor], tried: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return those (K, 4) of planes (Q, 4) whose looks explain the target (n, D), powers,
    and the rest.
    """
    planes, energy, tried_looks = NO_PLANES, float(target.square().sum()), looks(tried)
    atoms, images = tried_looks[:, :1], tried_looks[:, 1:]
    powers, residual = _solve(atoms, target)
    while len(planes) < PLANES:
        # Of an image only what known paths cannot imitate tells: orthogonal least squares.
        basis = torch.linalg.qr(atoms.mT)[0]
        alone = images - images @ basis @ basis.mT
        scale = alone.square().sum(2).clamp_min(LEAST_ALONE * images.square().sum(2))
        best = int(
            ((alone * residual[:, None]).sum(2).clamp_min(0).square() / scale).sum(0).argmax()
        )
        more = torch.cat([atoms, images[:, best : best + 1]], 1)
        solved, rest = _solve(more, target)
        if float((residual.square().sum() - rest.square().sum()) / energy) < LEAST_GAIN:
            break
        planes, atoms, powers, residual = (
            torch.cat([planes, tried[best : best + 1]]),
            more,
            solved,
            rest,
        )
    return planes, powers, residual


def _planes_to_try(ends: Tensor, turn: Tensor, step: float) -> Tensor:
    """Planes (Q, 4) across axes turned about z [rad], on both sides of the box of ends (n, 3)
    [m].
    """
    planes, axes = [], torch.eye(3).double()
    axes[:2, :2] = torch.stack([turn.cos(), turn.sin(), -turn.sin(), turn.cos()]).view(2, 2)
    for axis in axes:
        low, high = (ends @ axis).aminmax()
        beyond = step * torch.arange(1, round(REACH / step), dtype=torch.float64)
        offset = torch.cat([low - beyond, high + beyond])
        planes.append(torch.cat([axis.expand(len(offset), 3), offset[:, None]], 1))
    return torch.cat(planes)


def _solve(looks: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Nonnegative powers (n, K) whose sums of looks (n, K, D) are nearest to the target (n, D);
    the rest.
    """
    powers = nonnegative_powers(target, looks, (RIDGE * float(looks.norm(dim=2).mean())) ** 2)
    return powers, target - sum_lags(powers, looks)


class ExpectedSpectra:
    """Mean spectra, normalised as published, of paths whose phases nobody knows.

    Args:
        renderer: of the array.
        turns: (M, 3), radians per unit of direction.
        normalisation: as of `Site`.
        exponent: of a pixel that is its power.
    """

    def __init__(
        self, renderer: SpectrumRenderer, turns: Tensor, normalisation: str, exponent: int
    ) -> None:
        self.renderer, self.turns = renderer, turns
        self.normalisation, self.exponent = normalisation, exponent

    @torch.no_grad()
    def __call__(self, directions: Tensor, powers: Tensor) -> Tensor:
        """Return images (n, H * W) float32 of directions (n, K, 3) and powers (n, K)."""
        drawn = torch.rand(DRAWS, powers.shape[1], generator=torch.Generator().manual_seed(0))
        phases = torch.polar(torch.ones_like(drawn), 2 * math.pi * drawn)
        angle = directions.float() @ self.turns.T
        response = torch.polar(powers.float().sqrt()[..., None].expand_as(angle), angle)
        result = []
        for row in response:
            vectors = phases @ row
            image = self.renderer(torch.cat([vectors, torch.zeros(DRAWS, 1)], 1)).flatten(1)
            image = image if self.exponent == 2 else image.square()
            result.append(normalise_spectrum(image, self.normalisation).mean(0))
        return torch.stack(result)
