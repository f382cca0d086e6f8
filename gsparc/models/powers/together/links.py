"""Levels between two places: a process over places of both ends, given the links nearest to each.

A link whose station was heard has that station's links among the nearest. One of a place that was
never an end has others' alone: its settings are the likeliest ones where each link is given links
of other stations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.models.closed_form import LeftOutRows
from gsparc.models.powers.together.learning import ERRORS, LeftOutStations
from gsparc.models.powers.together.terms import StationRows
from gsparc.models.target_rows import linear_moments
from gsparc.processes.averages import MeanVariance
from gsparc.processes.few_rows import sample_place_rows
from gsparc.processes.fit_kernel import SETTLED, fit_kernel
from gsparc.processes.kernel import Kernel, Stationary, WhiteNoise, distances, to_number
from gsparc.processes.nearest import (
    LOOKED_AT,
    LOOKED_BY,
    Nearest,
    NeighbourSample,
    PlaceValues,
    choose_kernel_by_nearest,
    condition_on_nearest,
    nearest_density,
)
from gsparc.processes.neighbourhood import Neighbourhood
from gsparc.processes.places import first_end, other_end
from gsparc.processes.powers import PowerRows
from gsparc.processes.prior import Prior
from gsparc.processes.stored import Stored
from gsparc.processes.trend import Trend
from gsparc.processes.uncertainty import mean_and_error

Rows = TypeVar("Rows", bound=PowerRows)
FOLDS = 10  # of stations, that are left out together
# A metre of the station's place, of one of the other end's: what is its own, such as its pose, is
# no other's. Twenty rows of a new one then have 3.35 dB for 3.43, none and a hundred the same.
STILL = 2.0
RATIOS = (1.0, 0.2)  # of lengths about stations, of those about the other end, to begin with
OTHERS = 100  # links that tell of a station that was never heard
MANY = 20  # places of stations, from which on both ends move


@dataclass(frozen=True)
class LinkShadowing(Stationary):
    """What links share: alike as both their ends are near, rough at any scale.

    >>> near = torch.tensor([[0.0, 0, 0, 9, 9, 9]])  # one station, another receiver
    >>> LinkShadowing(2.0).covariance(near, torch.tensor([[2.0, 0, 0, 9, 9, 9]]))
    tensor([[0.3679]])

    Attributes:
        length: about the moving end [m].
        other: about the station [m]: its pose, too, is no other's.
    """

    other: Tensor | float = 1.0
    by_distance = False

    def correlation(self, distance: Tensor) -> Tensor:
        """See `Stationary`; of distances in lengths."""
        return (-distance).exp()

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """See `Term`; of places (..., 6) of both ends [m]."""
        moving = distances(first_end(a), first_end(b)) / self.length
        return self.share * self.correlation(
            moving + distances(other_end(a), other_end(b)) / self.other
        )

    def parameters(self) -> Tensor:
        """Return logarithms of both lengths (2,)."""
        return torch.tensor([self.length, self.other], dtype=torch.float64).log()

    def bounds(self, scale: float) -> list[tuple[float, float]]:
        """See `Term`."""
        return 2 * super().bounds(scale)

    def with_values(self, parameters: Tensor) -> Self:
        """See `Term`."""
        length, other = map(to_number, parameters.exp())
        return replace(self, length=length, other=other)


@dataclass(frozen=True)
class LinkPriors(Stored):
    """What is known of levels over places of both ends before any row.

    Attributes:
        law: of the site.
        heard: kernel of what is left, of links of stations that were heard, at `scaled` places;
            None: their own processes tell them.
        unheard: of links of all others.
        reciprocal: whether these are told by links with their ends exchanged, too.
    """

    law: Trend
    heard: Kernel | None
    unheard: Kernel
    reciprocal: bool = False

    def condition(self, rows: StationRows, seed: int) -> Links:
        """Return what rows that were heard say."""
        heard, values = None, link_values(rows, self.law)
        if self.heard is not None:
            heard = condition_on_nearest(Prior(self.heard), values, seed)
        if self.reciprocal:
            values = link_values(with_exchanged(rows), self.law)
        unheard = condition_on_nearest(Prior(self.unheard), values, seed, neighbours=OTHERS)
        index = torch.from_numpy(rows.index)
        return Links(self.law, heard, unheard, index, self.reciprocal)


@dataclass(frozen=True)
class Links(Stored):
    """The same given rows.

    Attributes:
        law: see `LinkPriors`.
        heard, unheard: of what is left.
        index: (n,) int64, rows of the measurements.
        reciprocal: see `LinkPriors`.
    """

    law: Trend
    heard: Nearest | None
    unheard: Nearest
    index: Tensor
    reciprocal: bool = False

    def add(self, rows: PowerRows) -> Links:
        """Return the same given further rows, of places (n, 6), that were heard, at settings as
        they are.
        """
        heard, values = self.heard, link_values(rows, self.law)
        if heard is not None:
            heard = _add_values(heard, values)
        index = torch.cat([self.index, torch.full((len(rows.places),), -1, dtype=self.index.dtype)])
        if self.reciprocal:
            values = link_values(with_exchanged(rows), self.law)
        unheard = _add_values(self.unheard, values)
        return Links(self.law, heard, unheard, index, self.reciprocal)

    def of_station(self, heard: bool) -> Nearest | None:
        """Return what tells of a station; None: its own process does."""
        return self.heard if heard else self.unheard

    def answer(self, places: Tensor, heard: bool) -> MeanVariance:
        """Return mean [dB] and variance [dB^2] (B,) of a measurement at places (B, 6) [m]."""
        process = self.of_station(heard)
        assert process is not None
        mean, variance = process.answer(scaled(places))
        return MeanVariance(
            self.law.mean(places) + mean[:, 0], process.prior.kernel.amplitude * variance
        )

    def noise(self, heard: bool) -> float:
        """Variance of a measurement's noise [dB^2]."""
        process = self.of_station(heard)
        assert process is not None
        kernel = process.prior.kernel
        return kernel.amplitude * kernel.noise

    def left_out(self, rows: np.ndarray | None) -> LeftOutRows:
        """Return the rows, or those of `rows` (m,) that it knows, each without itself; linear."""
        assert self.heard is not None
        every = np.arange(len(self.index))
        some = every if rows is None else np.flatnonzero(np.isin(self.index.numpy(), rows))
        mean, variance = self.heard.left_out(torch.from_numpy(some))
        level = self.law.mean(self.heard.places[some] / scaled(torch.ones(6))) + mean[:, 0]
        spread = self.heard.prior.kernel.amplitude * variance
        moments = linear_moments(level.float(), spread.float())
        return LeftOutRows(self.index.numpy()[some], *moments)


def scaled(places: Tensor) -> Tensor:
    """Return places (n, 6) in which links are as near as they are alike."""
    return torch.cat([first_end(places), STILL * other_end(places)], -1)


def both_ends_move(data: Measurements, rows: np.ndarray) -> bool:
    """Tell whether rows (n,) are levels between many places of either end; silent ones are not."""
    places = np.asarray(data.site.every_station.position)[np.unique(data.stations_of(rows))]
    heard = data.censored is None or not data.censored[rows].any()
    return heard and bool(np.isfinite(places).all()) and len(np.unique(places, axis=0)) >= MANY


def learn_links(
    rows: StationRows, start: Prior, missed: LeftOutStations, seed: int
) -> tuple[LinkPriors | None, str]:
    """Return the likeliest settings, None where stations that are left out are told no better than
    by `missed`, and what must be said of it.

    Args:
        rows: that were heard, of several stations.
        start: the site's law, and a kernel to begin with.
        missed: what terms that stations share miss of some rows.
        seed: of rows that are looked at.
    """
    law, kernel = start.known_trend, start.kernel
    order = np.argsort(rows.index)
    chosen = order[np.searchsorted(rows.index, missed.rows, sorter=order)]
    station = rows.station[chosen]
    unheard, errors = _learn_others(rows, kernel, law, chosen, seed)
    exchanged, others = _learn_others(with_exchanged(rows), kernel, law, chosen, seed)
    gain, unsure = mean_and_error(errors**2 - others**2, station)
    reciprocal = gain > ERRORS * unsure
    if reciprocal:
        unheard, errors = exchanged, others
    gain, unsure = mean_and_error(missed.errors**2 - errors**2, station)
    before, after = (math.sqrt(float((part**2).mean())) for part in (missed.errors, errors))
    used = gain > ERRORS * unsure
    either = ", in either direction" if reciprocal else ""
    remark = (
        f"stations left out: rmse {before:.3g} dB by what all share, {after:.3g} dB by the "
        f"{OTHERS} links whose ends are nearest{either}, which answer{'' if used else ' nothing'}"
    )
    if not used:
        return None, remark
    heard = choose_kernel_by_nearest(Prior(kernel), link_values(rows, law), seed)[0]
    return LinkPriors(law, heard, unheard, reciprocal), remark


def _learn_others(
    rows: StationRows, start: Kernel, law: Trend, chosen: np.ndarray, seed: int
) -> tuple[Kernel, np.ndarray]:
    """The likeliest kernel of links given those of other stations, and errors (m,) [dB] of the
    chosen rows (m,), each predicted from these.
    """
    values, looked_at = link_values(rows, law), sample_place_rows(rows.places, LOOKED_AT, seed)
    near = np.c_[looked_at, links_of_others(rows, values.places, looked_at, LOOKED_BY)]
    places = torch.from_numpy(values.places[near])
    kernel = _likeliest(start, NeighbourSample(places, values.values[near], values.count[near]))
    errors = np.empty(len(chosen))
    whole = condition_on_nearest(Prior(kernel), values, seed, neighbours=OTHERS)
    for of, rest in _station_folds(rows, chosen):
        mean = whole.subset(rest, seed).answer(torch.from_numpy(values.places[chosen[of]])).mean
        errors[of] = (mean - values.values[chosen[of]])[:, 0].numpy()
    return kernel, errors


def _likeliest(start: Kernel, sample: NeighbourSample) -> Kernel:
    """The kernel of largest density of rows given those that each is given."""
    far, noise = max(start.lengths), WhiteNoise(start.noise)
    starts = [Kernel((LinkShadowing(far, other=ratio * far), noise)) for ratio in RATIOS]
    bounds, settled = starts[0].bounds(sample.apart[:, 0]), SETTLED / len(sample.apart)
    return fit_kernel(lambda k: nearest_density(k, sample), starts, bounds, settled=settled)[1]


def with_exchanged(rows: Rows) -> Rows:
    """Return rows, and after them the same with both ends exchanged."""
    both = rows.subset(np.tile(np.arange(len(rows.places)), 2))
    turned = np.concatenate([rows.places, np.roll(rows.places, 3, 1)])
    return replace(both, places=turned)


def errors_of_heard(rows: StationRows, priors: LinkPriors, seed: int) -> np.ndarray:
    """Return errors (n,) [dB] of rows that were heard, each predicted from all others."""
    heard, values = priors.condition(rows, seed).heard, link_values(rows, priors.law).values
    assert heard is not None
    return (heard.left_out().mean - values)[:, 0].numpy()


def _add_values(process: Nearest, values: PlaceValues) -> Nearest:
    """The process given further values, among its densest."""
    near, added = process.near, float(process.prior.kernel.noise)
    level = np.full(len(values.places), near.level.max(), np.int8)
    places = np.concatenate([near.places, values.places])
    noise = torch.cat([process.noise, process.noise.new_full((len(level),), added)])
    rest = torch.cat([process.rest, values.values])
    near = Neighbourhood(places, np.concatenate([near.level, level]))
    return replace(process, near=near, rest=rest, noise=noise)


def link_values(rows: PowerRows, law: Trend) -> PlaceValues:
    """Return levels less the law over scaled places of both ends, one for each row."""
    places = torch.from_numpy(rows.places)
    once = torch.ones(len(places), dtype=torch.float64)
    rest = torch.from_numpy(rows.decibels) - law.mean(places)
    return PlaceValues(scaled(places).numpy(), rest[:, None], once)


def links_of_others(
    rows: StationRows, places: np.ndarray, chosen: np.ndarray, most: int
) -> np.ndarray:
    """Return numbers (m, k) of the rows of other stations that are nearest, at places (n, 6), to
    the chosen (m,).
    """
    result = np.empty((len(chosen), most), np.int64)
    for of, others in _station_folds(rows, chosen):
        near = cKDTree(places[others]).query(places[chosen[of]], np.arange(1, most + 1))
        result[of] = others[near[1]]
    return result


def _station_folds(
    rows: StationRows, chosen: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of those of the chosen rows (m,) that are of a fold's stations, and all other rows
    (n,) of other stations.
    """
    fold = np.unique(rows.station, return_inverse=True)[1].reshape(-1) % FOLDS
    for number in np.unique(fold[chosen]):
        yield np.flatnonzero(fold[chosen] == number), np.flatnonzero(fold != number)
