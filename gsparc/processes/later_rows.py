"""Rows of one station that came after its map was learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsparc.processes.stored import Stored

TINY = 1e-6  # [dB^2]
# Side of the parts of a place that these are of, as a share; more than parts
PART, RADIX = 1 / 5, 1000
# Weights of coordinates whose sums tell places apart
MIXED = torch.tensor((2, 3, 5, 7, 11, 13)).double().sqrt() * 1e3


@dataclass(frozen=True)
class LaterRows(Stored):
    """Rows of one station that came after its map was learned.

    Attributes:
        number: (n,) int64 of each row, ascending as they came.
        batch: (n,) int64, the update that it came with.
        places: (n, D) float64 [m].
        level: (n,) of the map there [dB].
        missed: (n,) what was measured less that [dB].
        doubt: (n,) variance of the map's error there [dB^2].
        noise: (n,) variance of a measurement [dB^2].
        silent: (n,) bool, where nothing was heard, and the level that it was below stands for the
            power.
    """

    number: Tensor
    batch: Tensor
    places: Tensor
    level: Tensor
    missed: Tensor
    doubt: Tensor
    noise: Tensor
    silent: Tensor

    def __len__(self) -> int:
        return len(self.number)

    @classmethod
    def empty(cls) -> LaterRows:
        """Return no rows."""
        none, number = torch.zeros(0).double(), torch.zeros(0, dtype=torch.int64)
        place = torch.zeros(0, 3).double()
        return cls(number, number, place, none, none, none, none, none > 0)

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> LaterRows:
        """Return those of a file; an older one also has variances that grew since."""
        return super().read({name: part for name, part in state.items() if name != "faded"})

    def __getitem__(self, chosen: Tensor | slice) -> LaterRows:
        """Return the rows `chosen`."""
        return LaterRows(*(part[chosen] for part in vars(self).values()))

    def join(self, later: LaterRows) -> LaterRows:
        """Return these rows and later ones."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        return LaterRows(*(torch.cat(pair) for pair in pairs))

    def merge(self, visits: bool = False) -> LaterRows:
        """Return one row a place, of every update where `visits`: what rows there miss in the mean,
        by their noise; as new as the last of them.
        """
        if not len(self):
            return self
        # Places that differ have other sums; rows of equal ones are sought much faster so.
        visit = self.places @ MIXED[: self.places.shape[1]] + self.batch * visits
        places, which = visit.unique(return_inverse=True)
        told = 1 / (self.noise + TINY)
        total = told.new_zeros(len(places)).index_add(0, which, told)
        missed = torch.zeros_like(total).index_add(0, which, told * self.missed) / total
        last = torch.zeros_like(which[: len(places)]).scatter_reduce(
            0, which, torch.arange(len(which)), "amax", include_self=False
        )
        rows = replace(self[last], missed=missed, noise=1 / total)
        return rows[rows.number.argsort()]

    def spread(self, extent: float, most: int) -> LaterRows:
        """Return so many rows at most, the latest of each part of a site
        of this extent before others [m].

        Rows of a walk that ends elsewhere are no reason to forget what was changed.
        """
        places = self.places.flip(0)
        part = (places / (extent * PART)).floor() @ (
            RADIX ** torch.arange(places.shape[1])
        ).double()
        parts, order = part.sort(stable=True)
        turn = torch.empty_like(order)
        turn[order] = torch.arange(len(order)) - torch.searchsorted(parts, parts)
        return self[(len(order) - 1 - turn.argsort(stable=True)[:most]).sort().values]

    @property
    def middle(self) -> Tensor:
        """What a map that tells nothing any more is taken for [dB]."""
        return self.level.mean()
