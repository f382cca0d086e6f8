"""Sources where the bearings of many receivers cross: a greedy search on what is left, then a polish."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.ops import SphereGrid
from gsparc.physics.lags import Lags

SWEEPS = 20  # over all sources: powers are then within a hundredth of the best


@dataclass(frozen=True)
class SearchSettings:
    """How sources are looked for.

    Attributes:
        sources: largest number.
        per_round: added before powers are solved again.
        rows: receivers that are looked at, spread over the site.
        candidates: points tried in each round.
        reach: how far around the receivers sources are looked for, in diagonals of their box.
        apart: least mean difference of two new sources' directions, as seen from a few receivers.
        least_gain: the search ends when a round explains less than this share of what was left.
        ridge: of the power solves.
        steps: of the polish.
        rate: of the polish [m].
    """

    sources: int = 48
    per_round: int = 8
    rows: int = 100
    candidates: int = 12000
    reach: float = 0.65
    apart: float = 0.08
    least_gain: float = 0.02
    ridge: float = 0.01
    steps: int = 150
    rate: float = 0.05


def bearings(sources: Tensor, receivers: Tensor, rotation: Tensor) -> Tensor:
    """Unit vectors (n, K, 3) from receivers (n, 3) to sources (K, 3) [m], receiver frame."""
    way = sources[None] - receivers[:, None]
    return (way / way.norm(dim=-1, keepdim=True).clamp_min(1e-6)) @ rotation


@torch.no_grad()
def powers(lags: Tensor, atoms: Tensor, ridge: float) -> Tensor:
    """Power (n, K), none negative, of each source at each receiver.

    Ridge regression of lags (n, Q) on atoms (n, K, Q) within the positive cone, by coordinate descent from
    the clipped free solution (Franc, Hlavac and Navara 2005).
    """
    gram = atoms @ atoms.mT
    gram.diagonal(dim1=-2, dim2=-1).add_(ridge)
    asked = (atoms @ lags[..., None])[..., 0]
    found = torch.linalg.solve(gram, asked).clamp_(min=0)
    slope = (gram @ found[..., None])[..., 0] - asked
    curvature = gram.diagonal(dim1=-2, dim2=-1)
    for _ in range(SWEEPS):
        for k in range(found.shape[1]):
            step = (found[:, k] - slope[:, k] / curvature[:, k]).clamp_(min=0) - found[:, k]
            found[:, k] += step
            slope += step[:, None] * gram[:, k]
    return found


def mixed(power: Tensor, atoms: Tensor) -> Tensor:
    """Lags (n, Q) of sources of the given power (n, K)."""
    return (power[:, None] @ atoms)[:, 0]


def find_sources(
    lags: Tensor,
    receivers: Tensor,
    first: Tensor | None,
    rotation: Tensor,
    space: Lags,
    grid: SphereGrid,
    settings: SearchSettings,
    seed: int,
) -> Tensor:
    """Positions (K, 3) float32 [m] of sources.

    Args:
        lags: (n, Q) of the spectra looked at.
        receivers: (n, 3) [m].
        first: (3,) [m] where the transmitter stands, which is not moved; None when unknown.
        rotation: (3, 3) receiver to world.
        space: of the lags.
        grid: of the spectra; rows are searched by their nearest pixel.
        settings: how.
        seed: of the candidates.
    """
    generator = torch.Generator().manual_seed(seed)
    low, high = receivers.min(0).values, receivers.max(0).values
    far = settings.reach * float((high - low).norm())
    low, high = low - far, high + far
    known = torch.empty(0, 3) if first is None else first.reshape(1, 3).float()
    left, found = lags, known
    if len(known):
        found, left = known, _left(lags, receivers, known, rotation, space, settings.ridge)
    energy = float(left.square().sum())
    while len(found) < settings.sources:
        candidates = low + (high - low) * torch.rand(settings.candidates, 3, generator=generator)
        new = _best(candidates, left, receivers, rotation, space, grid, settings)
        if not len(new):
            break
        found = torch.cat([found, new])
        left = _left(lags, receivers, found, rotation, space, settings.ridge)
        before, energy = energy, float(left.square().sum())
        if energy > (1 - settings.least_gain) * before:
            break
    return _polished(found, len(known), lags, receivers, rotation, space, settings, generator)


def _left(
    lags: Tensor, receivers: Tensor, sources: Tensor, rotation: Tensor, space: Lags, ridge: float
) -> Tensor:
    atoms = space.atoms(bearings(sources, receivers, rotation))
    return lags - mixed(powers(lags, atoms, ridge), atoms)


def _best(
    candidates: Tensor,
    left: Tensor,
    receivers: Tensor,
    rotation: Tensor,
    space: Lags,
    grid: SphereGrid,
    settings: SearchSettings,
) -> Tensor:
    """The candidates in whose direction most is left, over all receivers; near doubles dropped."""
    amplitude = space.spectrum(left).sqrt_().reshape(len(left), -1)
    score = torch.zeros(len(candidates))
    for image, receiver in zip(amplitude, receivers, strict=True):
        pixel, inside = _pixels(bearings(candidates, receiver[None], rotation)[0], grid)
        score += torch.where(inside, image[pixel], 0.0)
    ranked = candidates[score.argsort(descending=True)[:1500]]
    some = receivers[:: max(1, len(receivers) // 12)][:12]
    seen = bearings(ranked, some, rotation).transpose(0, 1).reshape(len(ranked), -1)
    chosen: list[int] = []
    for i in range(len(ranked)):
        if all(float((seen[i] - seen[j]).abs().mean()) > settings.apart for j in chosen):
            chosen.append(i)
        if len(chosen) == settings.per_round:
            break
    return ranked[chosen]


def _pixels(directions: Tensor, grid: SphereGrid) -> tuple[Tensor, Tensor]:
    """Nearest pixel (n,) of unit vectors (n, 3), and whether the grid has one there."""
    elevation = torch.asin(directions[:, 2].clamp(-1, 1))
    azimuth = torch.atan2(directions[:, 1], directions[:, 0])
    row = ((elevation - grid.first_elevation) / grid.elevation_step).round().long()
    column = ((azimuth - grid.first_azimuth) / grid.azimuth_step).round().long()
    turn = round(2 * np.pi / grid.azimuth_step)
    column = column % turn
    inside = (row >= 0) & (row < grid.height) & (column < grid.width)
    return (row.clamp(0, grid.height - 1) * grid.width + column.clamp(0, grid.width - 1)), inside


def _polished(
    sources: Tensor,
    fixed: int,
    lags: Tensor,
    receivers: Tensor,
    rotation: Tensor,
    space: Lags,
    settings: SearchSettings,
    generator: torch.Generator,
) -> Tensor:
    """Positions by gradient; the first `fixed` stay.

    Powers are the best ones at every step, so that their own change does not enter the gradient.
    """
    if settings.steps == 0 or len(sources) == fixed:
        return sources
    free = sources[fixed:].clone().requires_grad_(True)
    optimiser = torch.optim.Adam([free], lr=settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
    for _ in range(settings.steps):
        some = torch.randperm(len(receivers), generator=generator)[:64]
        everything = torch.cat([sources[:fixed], free])
        left = _left(lags[some], receivers[some], everything, rotation, space, settings.ridge)
        loss = left.square().sum() / lags[some].square().sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return torch.cat([sources[:fixed], free.detach()])
