"""A map from before any row (`model.prior`): of a planning tool, a ray tracer, or last year's model.

Levels are a share of the map's, which is about 1 before any row, a constant, and a process of what the map
lacks. Laws without the map stand beside it, and the likelihood of rows left out says which is right
(`candidate_priors` in `settings.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.prior_levels import Files, read_prior_maps
from gsparc.data.schema import Measurements
from gsparc.processes.places import first_end, other_end
from gsparc.processes.sectors import ROUND, SHARED, Sectors, sector_of
from gsparc.processes.term import Columns

SHARE = (1.0, 0.3)  # mean and deviation of the weight of a map's levels
NEAR = 4  # points of the map that tell of a place
CLOSE = 1e-3  # [m]
ALONG = 0.9  # of a map's levels, less a law of distance, that lie below those along the beam


@dataclass(frozen=True)
class PriorMap(Columns):
    """Levels of a map, between its points the mean of the nearest, weighed by distances to the power -2.

    Attributes:
        points: (M, 2) of the end that moves [m], world.
        level: (M,) there, less their mean [dB].
        prior_db: see `Columns`.
    """

    points: Tensor
    level: Tensor
    prior_db: Sequence[float] | None = SHARE

    @classmethod
    def from_levels(cls, points: np.ndarray, level: np.ndarray) -> Self:
        """Return a map of levels (M,) [dB] at points (M, 2) [m]."""
        return cls(torch.from_numpy(points.copy()), torch.from_numpy(level - level.mean()))

    @cached_property
    def _tree(self) -> cKDTree:
        """Of the points: made once, since each query asks it."""
        return cKDTree(self.points.numpy())

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`."""
        at = places[:, :2]
        near = self._tree.query(at.detach().numpy(), min(NEAR, len(self.points)))[1]
        near = torch.from_numpy(near.reshape(len(at), -1))
        weight = 1 / ((self.points[near] - at[:, None]).square().sum(2) + CLOSE**2)
        return ((weight * self.level[near]).sum(1) / weight.sum(1))[:, None].to(places.dtype)


def usual_loss(way: Tensor) -> Tensor:
    """Return what the law of distance of a network takes off before any row (n,) [dB], of ways (n, D) [m]."""
    return 5 * SHARED[0] * way.square().sum(1).clamp_min(1.0).log10()


def describe_use(used: bool, cells: int) -> str:
    """Say whether the map from before is used, of so many cells.

    >>> describe_use(False, 12)
    'the map from before is left out for 12 cells: rows are likelier without it'
    """
    how = "used" if used else "left out"
    return f"the map from before is {how} for {cells} cells{'' if used else ': rows are likelier without it'}"


@dataclass(frozen=True)
class NetworkMaps(Columns):
    """Maps of a network's stations as a mean, less the law of distance that a network has before any row.

    Attributes:
        maps: of stations that have one: number, whether it has the station's pattern, as that of a whole site
            has none, and the map.
        level: of them along beams, less which stations with and without a map are alike [dB].
    """

    maps: tuple[tuple[int, bool, PriorMap], ...]
    level: float = 0.0

    @classmethod
    def from_file(cls, path: Files, data: Measurements) -> Self:
        """Read the map of each station, or of its site; `DataError` where there is none, see there."""
        found = list[tuple[int, bool, PriorMap]]()
        for number, own, (world, levels) in read_prior_maps(path, data, data.site.every_station.shown):
            points, level = map(torch.from_numpy, (world - data.site.origin[:2], levels))
            before = found[-1][2].points if found else points
            # Squares of one raster are stored once.
            points = before if torch.equal(points, before) else points
            found.append((number, own, PriorMap(points, level)))
        return cls(tuple(found))

    def put_under(self, network: Sectors, places: np.ndarray) -> Sectors:
        """Return a network about these maps, whose stations at (T, 3) have no other pattern and power."""
        table, aimed = network.table.clone(), [number for number, own, _ in self.maps if own]
        table[aimed] = ROUND.double()
        still = torch.from_numpy(places[:, :2])
        levels = [one.level + usual_loss(one.points - still[number]) for number, _, one in self.maps]
        level = float(np.quantile(torch.cat(levels).numpy(), ALONG))
        return replace(network, table=table, more=(replace(self, level=level),))

    def columns(self, places: Tensor) -> Tensor:
        """None: what maps miss is what a network has without them."""
        return places.new_zeros(len(places), 0)

    def mean(self, places: Tensor) -> Tensor:
        """See `Columns`; of places of sectors (n, 7), 0 of one without a map."""
        result = places.new_zeros(len(places))
        for number, _, one in self.maps:
            own = (sector_of(places) == number).nonzero()[:, 0]
            if len(own):
                at = places[own]
                level = one.columns(at)[:, 0] + usual_loss(first_end(at) - other_end(at)) - self.level
                result = result.index_add(0, own, level.to(result))
        return result
