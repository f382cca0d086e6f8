"""Triangulate sources from the spectra of many receivers: greedy search on the residual,
then refinement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.base.limits import internal
from gsparc.data.schema import Measurements
from gsparc.models.apart import keep_apart
from gsparc.models.terms import array_obstacle
from gsparc.ops import SphereGrid
from gsparc.physics.draws import sample_in_box
from gsparc.physics.lags import SpectrumLags

SWEEPS = 20  # of coordinate descent: powers are then within 1 % of the optimum
BEST_PART = 8  # one in this many candidates may be a source
COMPARED = 12  # receivers whose bearings tell two candidates apart
SEEN_AT_ONCE = 64  # receivers of a step of refinement


@dataclass(frozen=True)
class SearchSettings:
    """Source search.

    Attributes:
        sources: largest number.
        per_round: added before powers are solved again.
        rows: receivers used, spread over the site.
        candidates: points tried in each round.
        reach: margin of the search box around the receivers, in diagonals of theirs.
        apart: least mean difference of two new sources' directions, as seen from a few receivers.
        least_gain: the search ends when a round explains less than this share of the residual.
        ridge: of the power solves.
        steps: of the gradient refinement of positions.
        rate: its step size [m].
    """

    sources: int = 48
    per_round: int = internal(8)
    rows: int = 100
    candidates: int = 12000
    reach: float = 0.65
    apart: float = internal(0.08)
    least_gain: float = internal(0.02)
    ridge: float = internal(0.01)
    steps: int = 150
    rate: float = internal(0.05)


def bearings(sources: Tensor, receivers: Tensor, rotation: Tensor) -> Tensor:
    """Return unit vectors (n, K, 3) from receivers (n, 3) to sources (K, 3) [m], receiver frame."""
    return normalize(sources[None] - receivers[:, None], dim=-1) @ rotation


@torch.no_grad()
def nonnegative_powers(lags: Tensor, atoms: Tensor, ridge: float) -> Tensor:
    """Return the power (n, K), none negative, of each source at each receiver.

    Ridge regression of lags (n, Q) on atoms (n, K, Q) within the positive cone, by coordinate
    descent from the clipped free solution (Franc, Hlavac and Navara 2005).
    """
    gram = atoms @ atoms.mT
    gram.diagonal(dim1=-2, dim2=-1).add_(ridge)
    correlation = (atoms @ lags[..., None])[..., 0]
    power = torch.linalg.solve(gram, correlation).clamp_(min=0)
    slope = (gram @ power[..., None])[..., 0] - correlation
    curvature = gram.diagonal(dim1=-2, dim2=-1)
    for _ in range(SWEEPS):
        for k in range(power.shape[1]):
            step = (power[:, k] - slope[:, k] / curvature[:, k]).clamp_(min=0) - power[:, k]
            power[:, k] += step
            # One column instead of a product with the whole Gram matrix a step.
            slope += step[:, None] * gram[:, k]
    return power


def sum_lags(power: Tensor, atoms: Tensor) -> Tensor:
    """Return lags (n, Q) of sources of the given power (n, K)."""
    return (power[:, None] @ atoms)[:, 0]


def find_sources(
    lags: Tensor,
    receivers: Tensor,
    first: Tensor | None,
    rotation: Tensor,
    space: SpectrumLags,
    grid: SphereGrid,
    settings: SearchSettings,
    seed: int,
) -> Tensor:
    """Return positions (K, 3) float32 [m] of sources.

    Args:
        lags: (n, Q) of the spectra.
        receivers: (n, 3) [m].
        first: (3,) [m] position of the transmitter, held fixed; None when unknown.
        rotation: (3, 3) receiver to world.
        space: of the lags.
        grid: of the spectra; candidates are scored at their nearest pixel.
        settings: how.
        seed: of the candidates.
    """
    generator = torch.Generator().manual_seed(seed)
    low, high = receivers.min(0).values, receivers.max(0).values
    far = settings.reach * float((high - low).norm())
    low, high = low - far, high + far
    anchors = receivers[:0] if first is None else first[None].float()

    def residual_lags(lags: Tensor, receivers: Tensor, sources: Tensor) -> Tensor:
        """Return residual lags (n, Q) of sources of the best powers."""
        atoms = space.plane_wave_lags(bearings(sources, receivers, rotation))
        return lags - sum_lags(nonnegative_powers(lags, atoms, settings.ridge), atoms)

    positions, residual = anchors, residual_lags(lags, receivers, anchors) if len(anchors) else lags
    energy = float(residual.square().sum())
    while len(positions) < settings.sources:
        candidates = sample_in_box(low, high, settings.candidates, generator)
        # Amplitudes: with powers the nearest receiver would decide alone.
        amplitude = space.spectrum(residual).sqrt_().reshape(len(residual), -1)
        new = _best_separated(candidates, amplitude, receivers, rotation, grid, settings)
        if not len(new):
            break
        positions = torch.cat([positions, new[: settings.sources - len(positions)]])
        residual = residual_lags(lags, receivers, positions)
        before, energy = energy, float(residual.square().sum())
        if energy > (1 - settings.least_gain) * before:
            break
    if settings.steps == 0 or len(positions) == len(anchors):
        return positions
    # Powers are optimal at every step, so that their derivative does not enter the gradient.
    free = positions[len(anchors) :].clone().requires_grad_(True)
    optimiser = torch.optim.Adam([free], lr=settings.rate)
    for step in range(settings.steps):
        progress = step / settings.steps
        optimiser.param_groups[0]["lr"] = settings.rate * (1 + math.cos(math.pi * progress)) / 2
        # As many receivers a step on every site, so that its time is bounded.
        some = torch.randperm(len(receivers), generator=generator)[:SEEN_AT_ONCE]
        residual = residual_lags(lags[some], receivers[some], torch.cat([anchors, free]))
        # A share of the energy: levels of spectra must not matter beside Adam's epsilon.
        loss = residual.square().sum() / lags[some].square().sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return torch.cat([anchors, free.detach()])


def _best_separated(
    candidates: Tensor,
    images: Tensor,
    receivers: Tensor,
    rotation: Tensor,
    grid: SphereGrid,
    settings: SearchSettings,
) -> Tensor:
    """Candidates of the largest amplitude (n, P) in their direction over all receivers,
    no near doubles.
    """
    score = torch.zeros(len(candidates))
    for image, receiver in zip(images, receivers, strict=True):
        pixel, inside = _pixels_and_inside(bearings(candidates, receiver[None], rotation)[0], grid)
        score += torch.where(inside, image[pixel], 0.0)
    # Doubles are found by comparing pairs one by one.
    ranked = candidates[score.argsort(descending=True)[: len(candidates) // BEST_PART]]
    some = receivers[:: max(1, len(receivers) // COMPARED)][:COMPARED]
    seen = bearings(ranked, some, rotation).transpose(0, 1).reshape(len(ranked), -1)
    chosen = keep_apart(
        range(len(ranked)),
        lambda i, j: float((seen[i] - seen[j]).abs().mean()) <= settings.apart,
        settings.per_round,
    )
    return ranked[chosen]


def _pixels_and_inside(directions: Tensor, grid: SphereGrid) -> tuple[Tensor, Tensor]:
    """Nearest pixel (n,) of unit vectors (n, 3), and whether the grid has one there."""
    # Unit vectors rounded above 1 have no arcsine.
    elevation = torch.asin(directions[:, 2].clamp(-1, 1))
    azimuth = torch.atan2(directions[:, 1], directions[:, 0])
    row = ((elevation - grid.first_elevation) / grid.elevation_step).round().long()
    column = ((azimuth - grid.first_azimuth) / grid.azimuth_step).round().long()
    # On the full circle, of which the grid may have a part: columns beyond its width are outside.
    column = column % round(2 * np.pi / grid.azimuth_step)
    inside = (row >= 0) & (row < grid.height) & (column < grid.width)
    return (row.clamp(0, grid.height - 1) * grid.width + column.clamp(0, grid.width - 1)), inside


# Share of energy outside the array's lags, above which it measured no such spectrum
MAX_UNEXPLAINED = 0.02


def site_problem(data: Measurements) -> str | None:
    """Return why sources cannot be triangulated from these measurements; None when they can."""
    otherwise = (
        "bearings need a moving receiver, here the transmitter moves (model=array is for that)"
    )
    problem = array_obstacle(data.site, "tx", otherwise)
    if problem is not None:
        return problem
    if not np.allclose(data.rx_rotation, data.rx_rotation[0], atol=1e-6):
        return "the receiver turns as it moves; bearings need one orientation"
    return None
