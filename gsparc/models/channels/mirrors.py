"""Mirror planes that several static ends share,
by the likelihood of their images at all ends together.

A plane mirrors every end, each image with a complex gain of its own whose power all ends share: a
wall that one antenna hardly shows is seen by many. Upright and level planes are looked at on a
grid, the best are moved to where the likelihood is largest, and one by one kept while it rises by
more than their numbers are worth (G. Schwarz, "Estimating the dimension
of a model", Ann. Statist. 6 (1978)).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsparc.models.apart import keep_apart
from gsparc.models.channels.evidence import BasisGroup
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.probe import Probe, likelihood_gains
from gsparc.models.channels.terms import Images
from gsparc.models.channels.terms.term import Frame
from gsparc.processes.density import TINY
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.worker import raise_if_cancelled

LEVELS = (0.03, 0.1, 0.3)  # powers of an image that are tried, of the signal's
MARGIN = 0.3  # how far beyond places and ends planes may be, of their extent
LEAST_MARGIN_M = 2.0  # and at least
TURN_RAD = 1.5  # phase across the places that a plane's azimuth may be off by
STEP = 0.25  # wavelengths between offsets
MOST_QUARTERS, MOST_OFFSETS = 24, 400  # of the grid
PROMISING = 2000  # planes that are looked at again after the first was found
STARTS = 3  # planes that are moved to their best, of which the best is tried
APART = 1.0  # wavelengths between the images of some end in two of them
REFINED = 5  # halvings of the step
# Rise of the log likelihood per channel [nats]: fewer are not worth the time that images take
LEAST = 0.1
PARAMETERS = 4  # of a plane: two angles, an offset and a power

LOOKED_AT = 32  # planes that tell what is known of all of a grid
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

Probes = tuple[Probe, ...]


class _Searcher:
    """Planes that are kept, and probes of few rows of few ends (`rough`) and of all with them."""

    def __init__(self, rough: Probes, probes: Probes, frame: Frame, wavelength: float) -> None:
        self.rough, self.probes, self.frame, self.wavelength = rough, probes, frame, wavelength
        self.ends = torch.stack([probe.group.slot.end for probe in probes])
        self.planes, self.risen = torch.zeros(0, 4, dtype=torch.float64), 0.0

    def plane_gains(
        self,
        probes: Probes,
        planes: Tensor,
        precision: Callable[[Probe, Tensor], Tensor] = Probe.wave_precision,
    ) -> Tensor:
        """Return the rise of the log likelihood (W, levels) of each plane alone."""

        def image_waves(probe: Probe, chunk: Tensor) -> Tensor:
            return Images.from_planes(self.frame, planes[chunk]).waves(probe.group)

        return likelihood_gains(probes, len(planes), image_waves, LEVELS, precision)

    def add_plane(self, plane: Tensor, level: float, gain: float) -> None:
        """Return one more plane (4,)."""
        self.planes, self.risen = torch.cat([self.planes, plane[None]]), self.risen + gain
        image = Images.from_planes(self.frame, plane[None])
        self.rough, self.probes = (
            tuple(probe.add_wave(image.waves(probe.group)[0], level) for probe in each)
            for each in (self.rough, self.probes)
        )

    def separate_planes(self, grid: Tensor, scores: Tensor) -> list[Tensor]:
        """Return the best planes whose images of the ends are apart."""
        placed, near = (
            Images.from_planes(self.frame, grid).mirror_ends(self.ends),
            APART * self.wavelength,
        )

        def alike(one: int, other: int) -> bool:
            return bool((placed[:, one] - placed[:, other]).norm(dim=-1).max() < near)

        return [*grid[keep_apart(scores.argsort(descending=True).tolist(), alike, STARTS)]]

    def refine_plane(self, plane: Tensor, turn: float) -> tuple[Tensor, float, float]:
        """Return a plane (4,) where its likelihood is largest, its level,
        and what it gains [nats].
        """
        middle, shift = self.frame.middle, STEP * self.wavelength / 2
        normal, away = plane[:-1], plane[-1]
        across = torch.linalg.cross(normal, UP)
        if float(across.norm()) < 0.5:
            across = torch.tensor([1.0, 0.0, 0.0]).double()
        axes = torch.stack([across, torch.linalg.cross(normal, across)])
        steps = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
        moves = torch.cartesian_prod(steps, steps, steps)
        for halving in range(REFINED):
            share = 0.5**halving
            turned = normal + share * turn * moves[:, :2] @ axes
            turned = turned / turned.norm(dim=1, keepdim=True)
            shifted = away - normal @ middle + share * shift * moves[:, 2]
            planes = torch.cat([turned, (shifted + turned @ middle)[:, None]], 1)
            gains = self.plane_gains(self.probes, planes)
            best = int(gains.argmax()) // len(LEVELS)
            plane, level = planes[best], LEVELS[int(gains[best].argmax())]
            (normal, away), gain = (plane[:-1], plane[-1]), float(gains[best].max())
        return plane, level, gain


def find_mirrors(
    coarse: tuple[BasisGroup, ...],
    parts: tuple[BasisGroup, ...],
    prior: ChannelPrior,
    wavelength: float,
    max_planes: int,
) -> Tensor:
    """Return planes (W, 4) float64, local; none where all together are not worth it.

    Args:
        coarse: few rows of few ends, for the grid.
        parts: of all ends.
        prior: the terms beside.
        wavelength: [m].
        max_planes: planes.
    """
    rough, probes = (
        tuple(Probe.from_group(part, prior) for part in each) for each in (coarse, parts)
    )
    search = _Searcher(rough, probes, prior.frame, wavelength)
    numbers = sum(2 * probe.group.target.numel() for probe in probes)
    worth = math.log(numbers) / 2
    grid, turn = planes_and_azimuth_step(rough, prior.frame, wavelength)
    while len(search.planes) < max_planes:
        raise_if_cancelled()
        scores = search.plane_gains(search.rough, grid, _approximate_precision).max(1).values
        if not len(search.planes):
            top = scores.topk(min(PROMISING, len(grid))).indices
            grid, scores = grid[top], scores[top]
        moved = [
            search.refine_plane(start, turn / 2) for start in search.separate_planes(grid, scores)
        ]
        plane, level, gain = max(moved, key=lambda m: m[2])
        if gain < PARAMETERS * worth:
            break
        search.add_plane(plane, level, gain)
    return search.planes if 2 * search.risen > LEAST * numbers else search.planes[:0]


def planes_and_azimuth_step(
    probes: Probes, frame: Frame, wavelength: float
) -> tuple[Tensor, float]:
    """Return upright and level planes (m, 4) about places and ends,
    and the step of their azimuths [rad].
    """
    places = torch.cat([probe.group.places for probe in probes])
    points = torch.cat(
        [places, torch.stack([probe.group.slot.end for probe in probes]) + frame.offset]
    )
    extent = float(torch.linalg.vector_norm(places.amax(0) - places.amin(0)))
    # Of a half turn: walls, those across them and diagonal ones are all there.
    quarter = math.ceil(math.pi**2 / 2 * extent / wavelength / TURN_RAD)
    azimuth = torch.arange(4 * min(max(quarter, 1), MOST_QUARTERS), dtype=torch.float64)
    turn = math.pi / len(azimuth)
    normals = torch.stack([(azimuth * turn).cos(), (azimuth * turn).sin(), 0 * azimuth], 1)
    planes = []
    for normal in torch.cat([normals, UP[None]]):
        low, high = (points @ normal).aminmax()
        margin = max(MARGIN * float(high - low), LEAST_MARGIN_M)
        number = min(
            max(int((float(high - low) + 2 * margin) / (STEP * wavelength)), 2), MOST_OFFSETS
        )
        offsets = torch.linspace(
            float(low) - margin, float(high) + margin, number, dtype=torch.float64
        )
        offsets = offsets[(offsets - frame.middle @ normal).abs() > STEP * wavelength]
        planes.append(torch.cat([normal.expand(len(offsets), -1), offsets[:, None]], 1))
    return torch.cat(planes), turn


def _approximate_precision(probe: Probe, waves: Tensor) -> Tensor:
    """`Probe.wave_precision` by that of a few:
    an isotropic field knows waves from everywhere alike.
    """
    size = waves.abs().square().sum(1)
    few = evenly_spaced(len(waves), LOOKED_AT)
    share = probe.wave_precision(waves[few]).sum() / size[few].sum().clamp_min(TINY)
    return size * share
