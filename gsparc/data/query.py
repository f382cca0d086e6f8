"""What a model is asked: places, and what else is known of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from gsparc.ops import Pose

if TYPE_CHECKING:
    from gsparc.data.schema import End, Site


@dataclass(frozen=True)
class Query:
    """B places that are asked about together, in local coordinates [m].

    Precision follows that of the places: float32,
    or float64 where autograd is to follow the answer.

    One receiver for all:

    >>> query = Query(tx=torch.zeros(5, 3), rx=Pose.identity(torch.zeros(3)))
    >>> tuple(len(part) for part in query.split(2))
    (2, 2, 1)

    Attributes:
        tx: (B, 3) [m].
        rx: one Pose that all share, or B poses.
        station: (B,) int64, which of the site's stations each is of; None: who stands at the static
            end.
        run: (B,) int64, see `Measurements`: answers are in the phase and level of that run; None,
            or a run that was not learned from: in those of the largest.
        uplink: (B, U, L) complex64 received at the same moment, in target units; None where there
            is none.
        noise_variance: (B,) float32 in target units; None when unknown.
    """

    tx: Tensor
    rx: Pose
    station: Tensor | None = None
    run: Tensor | None = None
    uplink: Tensor | None = None
    noise_variance: Tensor | None = None

    def __len__(self) -> int:
        return len(self.tx)

    def rows(self, chosen: slice | Tensor) -> Self:
        """Return some of them, as an index of the first axis chooses;
        a pose that all share stays one.
        """
        return self._with(lambda v: v if isinstance(v, Pose) and not v.batched else v[chosen])

    def split(self, size: int) -> Iterator[Self]:
        """Yield all in order, at most `size` at a time."""
        for start in range(0, max(len(self), 1), size):
            yield self.rows(slice(start, start + size))

    def to(self, device: torch.device | str) -> Self:
        """Return the same on another device."""
        return self._with(lambda v: v.to(device))

    def places(self, site: Site) -> Tensor:
        """Return where the moving end is, (B, 3) float64 [m] on the CPU; (B, 6)
        of both where both move.
        """
        return site.moving(self.tx, self.rx).expand(len(self), -1).cpu().double()

    def with_ends(self, places: Mapping[End, Tensor]) -> Self:
        """Return the same with ends at other places (B, 3) [m], all in their precision."""
        ends, dtype = (
            {"tx": self.tx, "rx": self.rx.position, **places},
            next(iter(places.values())).dtype,
        )
        tx, rx, turned = (end.to(dtype) for end in (ends["tx"], ends["rx"], self.rx.rotation))
        return replace(self, tx=tx, rx=Pose(rx, turned))

    @staticmethod
    def from_places(site: Site, places: Tensor, station: Tensor | None = None) -> Query:
        """Return what is asked of the moving end at places (B, 3) [m],
        with the static end where it stood.

        Where nobody knows that it is NaN; receivers are turned as they were when measured.

        Args:
            site: what the dataset declares; one end is static.
            places: local, in the precision of the query.
            station: (B,) int64, of several stations; None of one.
        """
        stations, count = site.every_station, len(places)
        still = np.full(3, np.nan) if site.several else stations.position[0]
        turned = np.eye(3) if site.rx_rotation is None else site.rx_rotation
        if station is not None:
            still = stations.position[station.numpy()]
            turned = turned if stations.rotation is None else stations.rotation[station.numpy()]
        end, turn = (torch.from_numpy(value).to(places.dtype) for value in (still, turned))
        turns = turn.expand(count, 3, 3)
        if site.static_end != "rx":
            return Query(end.expand(count, 3), Pose(places, turns), station)
        receiver = Pose(end, turn) if end.ndim == 1 else Pose(end.expand(count, 3), turns)
        return Query(places, receiver, station)

    def _with(self, change: Callable[[Any], Any]) -> Self:
        each = {
            name: value for name, value in vars(self).items() if isinstance(value, (Tensor, Pose))
        }
        return replace(self, **{name: change(value) for name, value in each.items()})


@dataclass(frozen=True, kw_only=True)
class Batch(Query):
    """A query with what was measured there; positions are float32.

    Attributes:
        index: (B,) int64 row in the dataset.
        target: (B, H, W) float32, or (B, antennas, subcarriers) complex64, or (B, 1) float32.
        mask: like target, bool, True where measured; None when everything was.
        share: of a training step's rows, where processes share them; 0 where another has these
            rows.
    """

    index: Tensor
    target: Tensor
    mask: Tensor | None = None
    share: float = 1.0
