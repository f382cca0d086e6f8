"""Levels between two places: a process over places of both ends, given the links nearest to each.

A link whose station was heard has that station's links among the nearest. One of a place that was
never an end has others' alone: its settings are the likeliest ones where each link is given links
of other stations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

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
from gsparc.processes.few_rows import draw_rows
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import (
    LOOKED_AT,
    LOOKED_BY,
    Nearest,
    PlaceValues,
    choose_kernel_by_nearest,
    condition_on_nearest,
)
from gsparc.processes.neighbourhood import NEIGHBOURS, Neighbourhood
from gsparc.processes.places import first_end, other_end
from gsparc.processes.powers import PowerRows
from gsparc.processes.prior import Prior
from gsparc.processes.stored import Stored
from gsparc.processes.trend import Trend
from gsparc.processes.uncertainty import mean_and_error

FOLDS = 10  # of stations, that are left out together
# A metre of the station's place, of one of the other end's: what is its own, such as its pose, is
# no other's. Twenty rows of a new one then have 3.35 dB for 3.43, none and a hundred the same.
STILL = 2.0
MANY = 20  # places of stations, from which on both ends move


@dataclass(frozen=True)
class LinkPriors(Stored):
    """What is known of levels over places of both ends before any row.

    Attributes:
        law: of the site.
        heard: kernel of what is left, of links of stations that were heard, at `scaled` places;
            None: their own processes tell them.
        unheard: of links of all others.
    """

    law: Trend
    heard: Kernel | None
    unheard: Kernel

    def condition(self, rows: StationRows, seed: int) -> Links:
        """Return what rows that were heard say."""
        values, kernels = link_values(rows, self.law), (self.heard, self.unheard)
        heard, unheard = (
            None if kernel is None else condition_on_nearest(Prior(kernel), values, seed)
            for kernel in kernels
        )
        assert unheard is not None
        return Links(self.law, heard, unheard, torch.from_numpy(rows.index))


@dataclass(frozen=True)
class Links(Stored):
    """The same given rows.

    Attributes:
        law: see `LinkPriors`.
        heard, unheard: of what is left.
        index: (n,) int64, rows of the measurements.
    """

    law: Trend
    heard: Nearest | None
    unheard: Nearest
    index: Tensor

    def add(self, rows: PowerRows, faded: Tensor) -> Links:
        """Return the same given further rows (n,) that were heard, at settings as they are.

        Args:
            rows: `places` (n, 6).
            faded: (n,) variances on top of their noise [dB^2].
        """
        values = link_values(rows, self.law)
        heard = None if self.heard is None else _add_values(self.heard, values, faded)
        unknown = torch.full((len(faded),), -1, dtype=self.index.dtype)
        index = torch.cat([self.index, unknown])
        return Links(self.law, heard, _add_values(self.unheard, values, faded), index)

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
    law, looked_at = start.known_trend, draw_rows(len(rows.index), LOOKED_AT, seed)
    values, kernel = link_values(rows, law), Prior(start.kernel)
    others = np.c_[looked_at, links_of_others(rows, values.places, looked_at, LOOKED_BY)]
    heard, unheard = (
        choose_kernel_by_nearest(kernel, values, seed, near)[0] for near in (None, others)
    )
    order = np.argsort(rows.index)
    chosen = order[np.searchsorted(rows.index, missed.rows, sorter=order)]
    errors, whole = np.empty(len(chosen)), condition_on_nearest(Prior(unheard), values, seed)
    for of, rest in _station_folds(rows, chosen):
        mean = whole.subset(rest, seed).answer(torch.from_numpy(values.places[chosen[of]])).mean
        errors[of] = (mean - values.values[chosen[of]])[:, 0].numpy()
    gain, unsure = mean_and_error(missed.errors**2 - errors**2, rows.station[chosen])
    before, after = (math.sqrt(float((part**2).mean())) for part in (missed.errors, errors))
    used = gain > ERRORS * unsure
    remark = (
        f"stations left out: rmse {before:.3g} dB by what all share, {after:.3g} dB by the "
        f"{NEIGHBOURS} links whose ends are nearest, which answer{'' if used else ' nothing'}"
    )
    return LinkPriors(law, heard, unheard) if used else None, remark


def errors_of_heard(rows: StationRows, priors: LinkPriors, seed: int) -> np.ndarray:
    """Return errors (n,) [dB] of rows that were heard, each predicted from all others."""
    heard, values = priors.condition(rows, seed).heard, link_values(rows, priors.law).values
    assert heard is not None
    return (heard.left_out().mean - values)[:, 0].numpy()


def _add_values(process: Nearest, values: PlaceValues, faded: Tensor) -> Nearest:
    """The process given further values, among its densest, of noise that `faded` (n,) adds to."""
    kernel, near = process.prior.kernel, process.near
    level = np.full(len(faded), near.level.max(), np.int8)
    places = np.concatenate([near.places, values.places])
    noise = torch.cat([process.noise, kernel.noise + faded / kernel.amplitude])
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
