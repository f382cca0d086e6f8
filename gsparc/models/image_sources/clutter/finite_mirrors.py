"""Finite mirrors: the best patch on a known plane, and small mirrors parallel to known walls.

Few receivers see a reflection in a table top: as a source visible to all it stays below the noise.
As a patch, only receivers whose reflection point lies on it are summed.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from gsparc.models.apart import keep_apart
from gsparc.models.image_sources.clutter.blocking import plane_tangents, share_inside_patches
from gsparc.models.image_sources.clutter.boxes import maximise_by_evolution
from gsparc.models.image_sources.clutter.residual import UnexplainedRows
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import spherical_waves
from gsparc.physics.draws import sample_in_box, sample_log_uniform
from gsparc.physics.mirror_planes import hesse_form, reflect
from gsparc.physics.waves import LIGHT
from gsparc.processes.worker import raise_if_cancelled

log = logging.getLogger(__name__)

SMALLEST, LARGEST = 0.2, 3.0  # [m] sides of random patches
MIN_SIDE = 0.05  # [m]
DRAWS = 300  # random patches, of which the best evolve
PARALLEL = 0.999  # cosine of normals that are taken as equal
# [m], of the raster that small mirrors are searched on; larger where it has more than MOST_CELLS
CELL = 0.35
STEP = 0.08  # of a wavelength, between candidate planes
BEHIND = 0.4  # [m], how far behind the receivers' box planes are tried
MAX_SPAN = 6  # cells along each side of a rectangle
MAX_CELLS = 2e8  # of all rasters along one wall's normal; larger sites are not searched
MOST_CELLS = 1e7  # of them that are looked at, a microsecond each
BLOCK_CELLS = 1e6  # of the rasters held at a time, four numbers each
MIN_SERVED = 4  # receivers with a reflection in a small mirror, at least


def find_patch(unexplained: UnexplainedRows, plane: int) -> tuple[Tensor, float]:
    """Return the patch (4,) on a plane that explains most if sequences end on it alone,
    and its nats.
    """
    mine = [k for k, sequence in enumerate(unexplained.scene.sequences) if plane in sequence]
    few, waves = unexplained.paths.select_sequences(mine), unexplained.waves[:, mine]
    along = plane_tangents(unexplained.scene.planes[plane])
    met, reflected = few.end @ along.T, few.plane == plane
    ends = unexplained.room @ along.T
    low, high = ends.amin(0), ends.amax(0)

    def gain_of_patches(patches: Tensor) -> Tensor:
        return unexplained.scorer.gains_of_shares(
            patches,
            lambda part: torch.where(reflected, share_inside_patches(met, part), 1.0).prod(-1),
            waves,
        )

    def repair(patches: Tensor) -> Tensor:
        lower, upper = patches.chunk(2, 1)
        lower = torch.minimum(lower, upper - MIN_SIDE)
        return torch.cat([torch.maximum(lower, low), torch.minimum(upper, high)], 1)

    middle = sample_in_box(low, high, DRAWS, unexplained.generator)
    side = sample_log_uniform(SMALLEST, LARGEST, middle, unexplained.generator)
    starts = repair(torch.cat([middle - side / 2, middle + side / 2], 1))
    starts = starts[gain_of_patches(starts).topk(8).indices]
    return maximise_by_evolution(starts, gain_of_patches, repair, unexplained.generator, rounds=10)


@dataclass(frozen=True)
class SmallMirror:
    """A patch on a plane of its own.

    Attributes:
        plane: (4,) float64.
        patch: (4,) float32, along its tangents.
        score: approximate gain of its sequences together [nats].
    """

    plane: Tensor
    patch: Tensor
    score: float

    def overlaps(self, other: SmallMirror, max_gap: float) -> bool:
        """Tell whether both are parallel, closer than `max_gap` [m] and overlap."""
        (normal, offset), (normal2, offset2) = map(hesse_form, (self.plane, other.plane))
        if (normal @ normal2).abs() < PARALLEL or (offset - offset2).abs() > max_gap:
            return False
        low, high = (
            torch.maximum(self.patch, other.patch)[:2],
            torch.minimum(self.patch, other.patch)[2:],
        )
        return bool((high > low).all())


def find_small_mirrors(unexplained: UnexplainedRows, limit: int) -> list[SmallMirror]:
    """Return at most so many small mirrors parallel to walls, best first.

    For every plane of a comb along every wall's normal, the sums `a^H K^-1 y` of its sequences
    (itself, after and before each wall) are collected in a raster of where it is met; integral
    images give every rectangle. Sites whose rasters have more than `MAX_CELLS` are not searched;
    cells of those with more than `MOST_CELLS` are larger. Whether to go on is asked
    (`raise_if_cancelled`) after each size of rectangle.
    """
    rows, room = unexplained.rows, unexplained.room
    walls = unexplained.scene.planes[unexplained.scene.walls]
    wavelength = LIGHT / float(rows.frequency.mean())
    mirrors: list[SmallMirror] = []
    normals: list[Tensor] = []
    for plane in walls:
        normal, _ = hesse_form(plane)
        if any((normal @ other).abs() >= PARALLEL for other in normals):
            continue
        normals.append(normal)
        ends = (room.double() @ normal).sort().values
        offsets = torch.arange(
            float(ends[0]) - BEHIND, float(ends[1]) + BEHIND, STEP * wavelength, dtype=torch.float64
        )
        candidates = torch.cat([normal.expand(len(offsets), -1), offsets[:, None]], 1)
        many = 1 + 2 * len(walls)
        count = (
            math.prod(_count_cells(room, plane_tangents(candidates[0]), CELL))
            * many
            * len(candidates)
        )
        if count > MAX_CELLS:
            log.info(
                "no search for small mirrors: %.0e raster cells at this site and wavelength", count
            )
            continue
        cell = CELL * math.sqrt(max(count / MOST_CELLS, 1.0))
        each = (
            max(math.prod(_count_cells(room, plane_tangents(candidates[0]), cell)), len(rows))
            * many
        )
        blocks = candidates.split(max(1, int(BLOCK_CELLS / each)))
        parts = [_best_rectangles(unexplained, block, walls, cell) for block in blocks]
        total, corners = (torch.cat(part) for part in zip(*parts, strict=True))
        for number in total.topk(min(2 * limit, len(total))).indices.tolist():
            mirrors.append(SmallMirror(candidates[number], corners[number], float(total[number])))
    best, gap = sorted(mirrors, key=lambda m: -m.score), 0.5 * wavelength
    return [
        best[i]
        for i in keep_apart(range(len(best)), lambda i, j: best[i].overlaps(best[j], gap), limit)
    ]


def _best_rectangles(
    unexplained: UnexplainedRows, candidates: Tensor, known: Tensor, cell: float
) -> tuple[Tensor, Tensor]:
    """Best rectangle of each candidate plane (C, 4): nats (C,) and corners (C, 4)."""
    along = plane_tangents(candidates[0])
    low, cells = (unexplained.room @ along.T).amin(0), _count_cells(unexplained.room, along, cell)
    tables, alpha, scale = (
        [],
        unexplained.scorer.solved_residual,
        unexplained.scorer.precision_diagonal,
    )
    for arriving, met in _waves_and_meetings(
        unexplained.rows, unexplained.scene.transmitter, candidates, known
    ):
        raise_if_cancelled()
        at = ((met @ along.T - low) / cell).floor().long()
        inside = (
            (at >= 0).all(-1) & (at < torch.tensor(cells)).all(-1) & (met[..., 0] == met[..., 0])
        )
        index = (at[..., 0] * cells[1] + at[..., 1]).clamp(0, cells[0] * cells[1] - 1)
        correlation, blank = (
            arriving.conj() * alpha,
            torch.zeros(len(candidates), cells[0] * cells[1]),
        )
        values = (
            correlation.real,
            correlation.imag,
            arriving.abs().square() * scale,
            torch.ones(()),
        )
        binned = [
            blank.scatter_add(1, index, (value * inside).float()).view(-1, *cells)
            for value in values
        ]
        tables.append(binned)
    stacked = (torch.stack(each).cumsum(-1).cumsum(-2) for each in zip(*tables, strict=True))
    sums = [torch.nn.functional.pad(each, (1, 0, 1, 0)) for each in stacked]  # integral images
    total, best = torch.zeros(len(candidates)), torch.zeros(candidates.shape)
    # a few cells, or all there are: a wall that was missed
    sizes = [sorted({*range(1, min(MAX_SPAN, count) + 1), count}) for count in cells]
    for wide, high_by in product(*sizes):
        raise_if_cancelled()
        if high_by == sizes[1][0]:
            strips = [s[..., wide:, :] - s[..., :-wide, :] for s in sums]
        real, imag, energy, count = (s[..., high_by:] - s[..., :-high_by] for s in strips)
        score = (real.square() + imag.square()) / energy.clamp_min(1e-3) / 2
        # Sequences add up: (C, u, v)
        summed = ((score - 1).clamp_min(0) * (count >= MIN_SERVED)).sum(0)
        value, at = summed.flatten(1).max(1)
        first = torch.stack([at // summed.shape[2], at % summed.shape[2]], 1)
        span = torch.tensor([wide, high_by])
        corners = torch.cat([low + cell * first, low + cell * (first + span)], 1)
        better = value > total
        total = torch.where(better, value, total)
        best = torch.where(better[:, None], corners, best)
    return total, best


def _count_cells(room: Tensor, along: Tensor, cell: float) -> list[int]:
    """Cells of that side [m] in a raster along each of two tangents (2, 3)."""
    ends = room @ along.T
    return ((ends.amax(0) - ends.amin(0)) / cell).ceil().long().clamp_min(1).tolist()


def _waves_and_meetings(
    rows: Rows, transmitter: Tensor, candidates: Tensor, known: Tensor
) -> list[tuple[Tensor, Tensor]]:
    """Waves (C, n) of every sequence over a candidate, and where it is met (C, n, 3),
    NaN if not.
    """
    places = rows.position.float()
    once, *more = _images_over_candidates(transmitter, candidates, known)
    meetings = [_intersect_planes(places, once, candidates)]
    for wall, after, before in zip(known, more[::2], more[1::2], strict=True):
        meetings.append(_intersect_planes(places, after, candidates))
        first = _intersect_planes(places, before, wall.expand_as(candidates))
        meetings.append(_intersect_planes(first, once, candidates))
    sources = _images_over_candidates(rows.static_ends(transmitter), candidates, known)
    return [
        (spherical_waves(rows, source).T, met)
        for source, met in zip(sources, meetings, strict=True)
    ]


def _images_over_candidates(static: Tensor, candidates: Tensor, known: Tensor) -> list[Tensor]:
    """Images (..., C, 3) of (..., 3) in each candidate, then after and before each wall."""
    start = static[..., None, :]
    once = reflect(start, candidates)
    pairs = ((reflect(reflect(start, wall), candidates), reflect(once, wall)) for wall in known)
    return [once, *(image for pair in pairs for image in pair)]


def _intersect_planes(start: Tensor, end: Tensor, planes: Tensor) -> Tensor:
    """Where lines from (n, 3) or (C, n, 3) to (C, 3) meet planes (C, 4); NaN where not between."""
    normal, offset = (part.float() for part in hesse_form(planes[:, None]))
    offset, end = offset[..., 0], end[:, None].float()
    above, below = (start * normal).sum(-1) - offset, (end * normal).sum(-1) - offset
    share = torch.where(above * below < 0, above / (above - below), math.nan)
    return start + share[..., None] * (end - start)
