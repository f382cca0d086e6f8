"""Where queries and rows are, as kernels read them: what moves, what stands,
and which station that is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Site

NOBODY = -1  # in place of a station's number: none of them
SAME_PLACE_M = 0.01  # a static end nearer than this to a station is that station


@dataclass(frozen=True)
class Ends:
    """Ends of n queries on the CPU, in float64.

    Attributes:
        moving: (n, 3) places [m]; (n, 6) of both ends where both move.
        still: (n, 3) places [m] of the other end; NaN where unknown.
        turned: (n, 3, 3), the receiver's turns.
        station: (n,) int64; `NOBODY` of a static end that is not where any station stands.
    """

    moving: Tensor
    still: Tensor
    turned: Tensor
    station: Tensor

    def __len__(self) -> int:
        return len(self.moving)

    def rows(self, chosen: Tensor) -> Ends:
        """Return some of them."""
        return Ends(*(part[chosen] for part in vars(self).values()))

    @classmethod
    def from_query(cls, site: Site, query: Query) -> Ends:
        """Return ends in a site's terms; of a query without stations,
        of those who stand where it says.
        """
        still, turned = (
            query.tx if site.moving_end == "rx" else query.rx.position,
            query.rx.rotation,
        )
        still = still.expand(len(query), -1).cpu().double()
        if site.stations is None:
            station = torch.zeros(len(query), dtype=torch.long)
        elif query.station is None:
            station = stations_at(torch.from_numpy(site.stations.position), still)
        else:
            station = query.station.cpu().long()
        return cls(
            query.places(site), still, turned.expand(len(query), -1, -1).cpu().double(), station
        )


def stations_at(known: Tensor, places: Tensor) -> Tensor:
    """Return the numbers (n,) int64 of stations at (T, 3) [m] that places (n, 3) are,
    `NOBODY` where none is.

    >>> places = torch.tensor([[0.0, 0, 0], [5, 0, 0]])
    >>> stations_at(places, torch.tensor([[5.0, 0, 0.001], [3, 0, 0]]))
    tensor([ 1, -1])
    """
    away, number = station_distances(known, places).min(1)
    return torch.where(away <= SAME_PLACE_M, number, NOBODY)


def station_distances(known: Tensor, places: Tensor) -> Tensor:
    """Return distances (n, T) [m]; of an unknown place 0 to unknown stations,
    and infinity to others.
    """
    both_unknown = places.isnan().any(1)[:, None] & known.isnan().any(1)
    return torch.cdist(places.detach(), known).nan_to_num(math.inf).masked_fill(both_unknown, 0.0)
