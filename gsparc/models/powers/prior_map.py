"""A map from before any row (`model.prior`): of a planning tool, a ray tracer,
or last year's model.

Levels are a share of the map's, which is about 1 before any row, a constant, and a process of what
the map lacks. Laws without the map stand beside it, and the likelihood of rows left out says which
is right (`members.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.base.errors import group_warnings
from gsparc.base.files import Files
from gsparc.data.schema import Measurements
from gsparc.processes.places import first_end, other_end
from gsparc.processes.sectors import ROUND, SHARED, Sectors, sector_of
from gsparc.processes.term import Columns

if TYPE_CHECKING:
    from gsparc.models.powers.together.terms import StationRows

SHARE = (1.0, 0.3)  # mean and deviation of the weight of a map's levels
NEAR = 4  # points of the map that tell of a place
CLOSE = 1e-3  # [m]
# Share of points with a neighbour as near; that tell how near, and of the law
SPACING, DRAWN = 0.9, 10_000
AREA = (
    2.0,
    4.0,
)  # spacings to the nearest point up to which, and from which on not, a map tells
LEAST_TOLD, SURE = 8, 2.0  # rows that tell of a slope; its deviations
SLOPES = (0.4, 2.5)  # of levels by those of a map in the same unit of the same place
FLAT_DB = 1.0  # between all levels of a map: powers that are no levels
ALONG = 0.9  # of a map's levels, less a law of distance, that lie below those along the beam


@dataclass(frozen=True)
class PriorMap(Columns):
    """Levels of a map, between its points the mean of the nearest,
    weighed by distances to the power -2.

    Outside the area of its points it is the law of distance that its own levels have.

    Attributes:
        points: (M, 2) of the end that moves [m], world.
        level: (M,) there, less their mean [dB].
        prior_db: see `Columns`.
        spacing: of the points [m].
        about: x and y of the end that stands [m]; level at 1 m of it [dB], and by decade.
    """

    points: Tensor
    level: Tensor
    prior_db: Sequence[float] | None = SHARE
    spacing: float = math.inf  # older files say nothing of it
    about: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @classmethod
    def from_file(cls, path: Files, data: Measurements, station: str, still: np.ndarray) -> Self:
        """Read the map of one station as it is shown; see `from_levels` and `read_prior_levels`."""
        return cls.from_levels(*_read_maps(path, data, (station,))[0][2], still)

    @classmethod
    def from_levels(cls, points: np.ndarray, level: np.ndarray, still: np.ndarray) -> Self:
        """Return a map of levels (M,) [dB] at points (M, 2) [m]; the end that stands is at (3,)
        or NaN.
        """
        level = level - level.mean()
        part = slice(None, None, max(1, len(points) // DRAWN))
        about = (0.0, 0.0, 0.0, 0.0)
        if np.isfinite(still[:2]).all() and len(level[part]) > 2:
            decades = np.log10(np.linalg.norm(points[part] - still[:2], axis=1).clip(1.0))
            slope, first = (
                np.polynomial.Polynomial.fit(decades, level[part], 1).convert().coef[[1, 0]]
            )
            about = (*still[:2].tolist(), float(first), float(slope))
        known = torch.from_numpy(points.copy()), torch.from_numpy(level)
        return cls(*known, spacing=point_spacing(points), about=about)

    @cached_property
    def _tree(self) -> cKDTree:
        """Of the points: made once, since each query asks it."""
        return cKDTree(self.points.numpy())

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`."""
        at = places[:, :2]
        inside, level = self.look_up(at)
        x, y, first, by_decade = self.about
        squared = (at - at.new_tensor([x, y])).square().sum(1).clamp_min(1.0)
        outside = first + by_decade * squared.log10() / 2
        return (inside * level + (1 - inside) * outside)[:, None].to(places.dtype)

    def look_up(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far (n,) places (n, 2) [m] are within the map's area, 0 to 1, and levels (n,)
        [dB].
        """
        near = self._tree.query(at.detach().numpy(), min(NEAR, len(self.points)))[1]
        near = torch.from_numpy(near.reshape(len(at), -1))
        squared = (self.points[near] - at[:, None]).square().sum(2) + CLOSE**2
        weight, (within, beyond) = 1 / squared, AREA
        inside = (beyond - squared[:, 0].sqrt() / self.spacing) / (beyond - within)
        return inside.clamp(0.0, 1.0), (weight * self.level[near]).sum(1) / weight.sum(1)

    def explain_misfit(self, places: np.ndarray, decibels: np.ndarray) -> str:
        """Say what is wrong with a map by levels (n,) [dB] at world places (n, D) [m]; empty:
        nothing.

        >>> at = np.c_[np.arange(20.0), np.zeros(20)]
        >>> levels = PriorMap.from_levels(at, at[:, 0], np.full(3, np.nan))
        >>> levels.explain_misfit(at, -50 - at[:, 0])[:45]
        'model.prior: levels fall by 1 dB where those '
        """
        if len(places) < LEAST_TOLD:
            return ""
        inside, level = self.look_up(torch.from_numpy(places[:, :2]))
        whole = (inside == 1).numpy()
        if whole.sum() < LEAST_TOLD or (spread := float(level[whole].std())) == 0:
            return ""
        known, values = level.numpy()[whole], decibels[whole] - decibels[whole].mean()
        known = (known - known.mean()) / spread
        slope = float(known @ values) / len(known) / spread
        error = float(np.std(values - slope * spread * known)) / spread / math.sqrt(len(known) - 2)
        if slope + SURE * error < 0:
            advice = "path losses? write minus them, or scale -1 of the band"
            return (
                f"model.prior: levels fall by {-slope:.1g} dB where those of the map rise by "
                f"1: {advice}"
            )
        low, high = slope - SURE * error, slope + SURE * error
        if low <= SLOPES[1] and high >= SLOPES[0]:
            return ""
        advice = "in another unit, or of another place?"
        if float(np.ptp(self.level)) < FLAT_DB:
            advice = "linear powers? write 10 log10 of them, or the unit of the band, such as mW"
        return (
            f"model.prior: levels rise by {slope:.1g} dB where those of the map rise by 1: {advice}"
        )


def point_spacing(points: np.ndarray) -> float:
    """Return how near points (M, 2) lie [m]: most have a neighbour as near;
    infinity of one point.
    """
    if len(points) < 2:
        return math.inf
    nearest = cKDTree(points).query(points[:: max(1, len(points) // DRAWN)], 2)[0][:, 1]
    return float(np.quantile(nearest, SPACING)) or math.inf


def usual_loss(way: Tensor) -> Tensor:
    """Return what the law of distance of a network takes off before any row (n,) [dB],
    of ways (n, D) [m].
    """
    return 5 * SHARED[0] * way.square().sum(1).clamp_min(1.0).log10()


def describe_use(used: bool, cells: int) -> str:
    """Say whether the map from before is used, of so many cells.

    >>> describe_use(False, 12)
    'the map from before is left out for 12 cells: rows are likelier without it'
    """
    how = "used" if used else "left out"
    return (
        f"the map from before is {how} for {cells} "
        f"cells{'' if used else ': rows are likelier without it'}"
    )


@dataclass(frozen=True)
class NetworkMaps(Columns):
    """Maps of a network's stations as a mean,
    less the law of distance that a network has before any row.

    Attributes:
        maps: of stations that have one: number, whether it has the station's pattern, as that of a
            whole site has none, and the map.
        level: of them along beams, less which stations with and without a map are alike [dB].
    """

    maps: tuple[tuple[int, bool, PriorMap], ...]
    level: float = 0.0

    @classmethod
    def from_file(cls, path: Files, data: Measurements) -> Self:
        """Read the map of each station, or of its site; `DataError` where there is none,
        see there.
        """
        maps = list[tuple[int, bool, PriorMap]]()
        for number, own, (world, levels) in _read_maps(path, data, data.site.every_station.shown):
            points, level = map(torch.from_numpy, (world - data.site.origin[:2], levels))
            before = maps[-1][2] if maps else None
            # Squares of one raster are stored once.
            if before is not None and torch.equal(points, before.points):
                points, spacing = before.points, before.spacing
            else:
                spacing = point_spacing(points.numpy())
            maps.append((number, own, PriorMap(points, level, spacing=spacing)))
        return cls(tuple(maps))

    def explain_misfits(self, rows: StationRows, names: Sequence[str]) -> list[str]:
        """Say what is wrong with maps of stations by rows of these,
        see `PriorMap.explain_misfit`.
        """
        heard = rows.side == 0
        own = [
            (names[n], level, heard & (rows.station == n))
            for n, is_own, level in self.maps
            if is_own
        ]
        faults = [
            (name, level.explain_misfit(rows.places[at], rows.decibels[at]))
            for name, level, at in own
        ]
        return group_warnings([f"station {name}: {fault}" for name, fault in faults if fault])

    def put_under(self, network: Sectors, places: np.ndarray) -> Sectors:
        """Return a network about these maps, whose stations at (T, 3)
        have no other pattern and power.
        """
        table, aimed = network.table.clone(), [number for number, own, _ in self.maps if own]
        table[aimed] = ROUND.double()
        still = torch.from_numpy(places[:, :2])
        levels = [
            prior_map.level + usual_loss(prior_map.points - still[number])
            for number, _, prior_map in self.maps
        ]
        level = float(np.quantile(torch.cat(levels).numpy(), ALONG))
        return replace(network, table=table, more=(replace(self, level=level),))

    def columns(self, places: Tensor) -> Tensor:
        """None: what maps miss is what a network has without them."""
        return places.new_zeros(len(places), 0)

    def mean(self, places: Tensor) -> Tensor:
        """See `Columns`; of places of sectors (n, 7), 0 of one without a map."""
        result = places.new_zeros(len(places))
        for number, _, prior_map in self.maps:
            own = (sector_of(places) == number).nonzero()[:, 0]
            if len(own):
                at = places[own]
                inside, level = prior_map.look_up(at[:, :2])
                level = inside * (level + usual_loss(first_end(at) - other_end(at)) - self.level)
                result = result.index_add(0, own, level.to(result))
        return result


def _read_maps(
    path: Files, data: Measurements, stations: Sequence[str]
) -> list[tuple[int, bool, tuple[np.ndarray, np.ndarray]]]:
    """See `read_prior_maps`."""
    # Here, as readers of tables and datasets take three seconds to import: a model keeps its maps.
    from gsparc.datasets.prior_levels import read_prior_maps

    return read_prior_maps(path, data, stations)
