"""Settings of a network's model of powers, from what its lists hold and from what they leave out.

First laws, patterns and gains as if rows were independent (a Tobit model), which also says where an azimuth
contradicts the data; then all settings by the evidence of processes that sectors of a site share, in which
rows that are only below a level count by expectation propagation.
"""

from __future__ import annotations

import math
import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from gsparc.data.errors import Caution
from gsparc.data.schema import Measurements, Stations
from gsparc.models.baselines.distance_law import fit_law
from gsparc.models.powers.together.terms import LinkRows
from gsparc.processes.censored import Sites
from gsparc.processes.density import Evidence, walked
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import apart
from gsparc.processes.prior import Prior
from gsparc.processes.sectors import NO_AZIMUTH, SHARED, SHARED_SPREAD, SectorKernel, Sectors
from gsparc.processes.trend import LEAST_SPREAD
from gsparc.processes.worker import late_when
from gsparc.training.time_budget import TimeBudget

SAME_SITE_M = 5.0  # stations closer than this are of one site
SAME_NAME_M = 100.0  # the same of those whose names differ in their last part alone
USUAL = (0.0, 0.0, 65.0, 10.0, 0.0)  # of `Stations.sector` where it is not known
NO_PATTERN = 1e9  # width [deg] of a beam in height whose tilt nobody gave
ONE_BAND = 1.1  # ratio of carriers of one band
GAIN_DB = 4.0  # deviation of a sector's level, before it is learned
LOOSE, LEAST_DB2 = 1.5, 1e-2  # deviation of logarithms of kernels' numbers from usual; least variance
CONTRADICTED_DEG = 30.0
SURE = 10.0, 0.1  # nats, and nats a row, by which another azimuth must be likelier
TURNS, GAINS = torch.arange(-180.0, 180.0, 10.0), torch.arange(-12.0, 12.5, 2.0)
ROUGH_LOOKS, LOOKS, SETTLED = 150, 40, 1e-5
ROUGH_ON, LEARNED_ON = 20_000, 160  # rows of all sites; of each site, whose covariance is factored
LEAST_WHOLE = 30  # places that leave no sector out, for settings by these alone
SHARED_BOUNDS = (0.5, 7.0), (-20.0, 20.0), (-1.0, 1.0), (-1.2, 1.5), (10.0, 40.0), (-6.0, 6.0)  # of `SHARED`
STRETCH = 4  # places in the order of the drive that are drawn as one


def network_of(data: Measurements, places: np.ndarray | None = None) -> Sectors | None:
    """Return the sectors that stations are; None without known beams or lists of sites with several.

    Args:
        data: powers of several stations.
        places: (T, 3) of the stations [m]; None: those that are given.
    """
    stations = data.site.stations
    assert stations is not None
    places = stations.position if places is None else places
    sector = np.full((len(places), len(USUAL) + 1), np.nan) if stations.sector is None else stations.sector
    site = sites_of(stations, places)
    levels = () if data.censored is None else np.unique(data.target[data.censored > 0])
    several = 2 * (np.bincount(site)[site] > 1).sum() >= len(site) and len(levels) > len(site)
    if not several and not np.isfinite(sector[:, 0]).any():
        return None  # levels of rows are of lists: a receiver has one for each station
    band = np.zeros(len(site), np.int64)
    if stations.carrier_hz is not None:
        order = np.argsort(stations.carrier_hz)
        steps = np.diff(stations.carrier_hz[order], prepend=stations.carrier_hz[order[:1]])
        band[order] = np.cumsum(steps > (ONE_BAND - 1) * stations.carrier_hz[order])
    sector = sector[:, : len(USUAL)]
    table = np.where(np.isfinite(sector), sector, USUAL)
    table[:, 3] = np.where(np.isfinite(sector[:, 1]), table[:, 3], NO_PATTERN)
    table[:, 0] = np.where(np.isfinite(sector[:, 0]), sector[:, 0] % 360, NO_AZIMUTH)
    table[:, 4] -= table[:, 4].mean()
    which = torch.from_numpy(np.stack([site, band]))
    return Sectors(0.0, table=torch.from_numpy(table), site=which[0], band=which[1])


def sites_of(stations: Stations, places: np.ndarray) -> np.ndarray:
    """Return numbers (T,) int64 of the sites that stations at places (T, 3) [m] belong to.

    >>> at = np.array([[0.0, 0, 0], [20, 0, 0], [500, 0, 0]])
    >>> sites_of(Stations(at, ("A-1", "A-2", "B-1")), at)
    array([0, 0, 1])
    """
    apart = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=-1)
    stem = np.array([re.sub(r"(.)[-_ /.:][^-_ /.:]*$", r"\1", name) for name in stations.name])
    near = (apart <= SAME_SITE_M) | ((apart <= SAME_NAME_M) & (stem[:, None] == stem))
    if stations.sector is not None:
        near |= stations.sector[:, None, 5] == stations.sector[:, 5]  # as a column of the list says
    return connected_components(near)[1].astype(np.int64)


def by_site(rows: LinkRows, network: Sectors) -> LinkRows:
    """Return the same by sites; places (n, 7) say which station a row is of."""
    places = np.concatenate([rows.places[:, :6], rows.station[:, None]], 1)
    return replace(rows, places=places, station=network.site.numpy()[rows.station])


def learn_network(
    rows: LinkRows, network: Sectors, names: tuple[str, ...], seed: int, budget: TimeBudget | None
) -> tuple[Prior, list[str]]:
    """Return the prior of every site of a network, and what must be said of it.

    Args:
        rows: by sites, see `by_site`.
        network: of the stations.
        names: (T,) of the stations.
        seed: of rows drawn.
        budget: searches end with what they have when it is over.
    """
    few = rows.at(np.sort(np.random.default_rng(seed).permutation(len(rows.index))[:ROUGH_ON]))
    law = replace(fit_law(few, None), level=0.0, exponent=0.0)
    loud = few if few.silent.all() else few.loud
    decades = law.decades(torch.from_numpy(loud.places))
    start = replace(
        network, law=law, middle=float(decades.mean()), spread=max(float(decades.std()), LEAST_SPREAD),
        levels=torch.full((int(network.band.max()) + 1,), float(loud.decibels.mean()), dtype=torch.float64),
    )  # fmt: skip
    with nullcontext() if budget is None else late_when(budget.over):
        rough, gains, scale = _rough(few, start)
        turned, notes = _turned(few, rough, gains, scale, names)
        if notes:
            rough, gains, scale = _rough(few, turned)
        trend, kernel = _by_evidence(rows, rough, gains, scale, seed)
    parts = (*kernel.shares, kernel.noise)
    site, own, bearing, gain, noise = (math.sqrt(kernel.amplitude * part) for part in parts)
    law_note = (
        f"{len(names)} sectors of {int(network.site.max()) + 1} sites in one model: exponent "
        f"{float(trend.shared[0]):.3g}, levels +- {gain:.2g} dB, shadowing of a site {site:.2g} dB over"
        f" {kernel.lengths[0]:.3g} m, of a sector {own:.2g} dB over {kernel.lengths[1]:.3g} m and"
        f" {bearing:.2g} dB by bearing, noise {noise:.2g} dB"
    )
    width, height = (float(trend.shared[i].exp()) for i in (2, 3))
    beams = (
        f"beams {width:.2f} times as wide and {height:.2f} times as high as said, floor "
        f"{float(trend.shared[4]):.3g} dB, tilts {float(trend.shared[5]):+.2g} deg"
    )
    aimed = [beams] if bool((trend.table[:, 0] != NO_AZIMUTH).any()) else []
    return Prior(kernel, trend), [law_note, *aimed, *notes]  # type: ignore[arg-type]


def _misfit(mean: Tensor, rows: LinkRows, scale: Tensor) -> Tensor:
    """Negative log likelihood of each row (..., n), independent of the others."""
    z = (torch.from_numpy(rows.decibels) - mean) / scale
    side = torch.from_numpy(rows.side)
    beyond = -torch.special.log_ndtr(side * z)
    return torch.where(side != 0, beyond, 0.5 * z.square() + torch.log(scale))


def _off(shared: Tensor) -> Tensor:
    """Negative log prior of what sectors share."""
    return 0.5 * ((shared - SHARED) / SHARED_SPREAD).square().sum()


def _rough(rows: LinkRows, start: Sectors) -> tuple[Sectors, Tensor, float]:
    """Shared parameters, gains (T,) and the deviation [dB] of rows taken as independent."""
    places, number = torch.from_numpy(rows.places), torch.from_numpy(rows.places[:, 6].astype(np.int64))
    bands, count = len(start.levels), len(start.table)

    def objective(at: Tensor) -> Tensor:
        shared, levels, scale, gains = at.split((len(SHARED), bands, 1, count))
        mean = start.at(places, shared, levels) + gains[number]
        return _misfit(mean, rows, scale.exp()).sum() + _off(shared) + 0.5 * (gains / GAIN_DB).square().sum()

    begin = np.r_[start.shared.numpy(), start.levels.numpy(), math.log(8.0), np.zeros(count)]
    free = [(-400.0, 400.0)] * bands + [(0.0, 4.0)] + [(-40.0, 40.0)] * count
    best, _ = walked(objective, [begin], [*SHARED_BOUNDS, *free], ROUGH_LOOKS, SETTLED)
    shared, levels, scale, gains = torch.from_numpy(best).split((len(SHARED), bands, 1, count))
    return replace(start, shared=shared.clone(), levels=levels.clone()), gains, float(scale.exp())


@torch.no_grad()
def _turned(
    rows: LinkRows, trend: Sectors, gains: Tensor, scale: float, names: tuple[str, ...]
) -> tuple[Sectors, list[str]]:
    """Azimuths that rows contradict turned to where they fit, and a note of each."""
    table, notes = trend.table.clone(), list[str]()
    for t in range(len(table)):
        part = rows.at(np.flatnonzero(rows.places[:, 6] == t))
        if not len(part.index) or part.silent.all() or table[t, 0] == NO_AZIMUTH:
            continue
        own = torch.nn.functional.pad(TURNS.double()[:, None], (0, 3))  # all else as it is
        mean = trend.at(torch.from_numpy(part.places), trend.shared, trend.levels, own)
        levels = (gains[t] + GAINS)[:, None]
        likely = _misfit(mean[:, None] + levels, part, torch.tensor(scale)).sum(2)
        likely = (likely + 0.5 * (levels[:, 0] / GAIN_DB).square()).amin(1)
        best = int(likely.argmin())
        gained, said = float(likely[len(TURNS) // 2] - likely[best]), float(TURNS[best])
        if abs(said) >= CONTRADICTED_DEG and gained > SURE[0] + SURE[1] * len(part.index):
            found = float((table[t, 0] + said) % 360)
            notes.append(Caution(
                f"azimuth of {names[t]}: {float(table[t, 0]):.0f} deg is contradicted by its levels, which "
                f"fit {found:.0f} deg, used instead"
            ))  # fmt: skip
            table[t, 0] = found
    return replace(trend, table=table), notes


def _by_evidence(
    rows: LinkRows, rough: Sectors, gains: Tensor, scale: float, seed: int
) -> tuple[Sectors, SectorKernel]:
    """All settings of largest evidence of some rows of each site."""
    rows, bands = _whole(rows), len(rough.levels)
    parts = [_stretches(rows.of(number), LEARNED_ON, seed) for number in rows.stations]
    places = [torch.from_numpy(part.places) for part in parts]
    values = [torch.from_numpy(part.decibels) for part in parts]
    side = [torch.from_numpy(part.side) for part in parts]
    rough = replace(rough, doubt=torch.zeros(len(SHARED) + bands, 0, dtype=torch.float64))
    own = [gram @ gram.T for gram in map(rough.columns, places)]
    count, last = sum(map(len, places)), [list[Sites]() for _ in parts]

    def covariance(i: int, at: Tensor) -> Tensor:
        kernel = SectorKernel.of(at)
        noise = kernel.noise * torch.eye(len(own[i]), dtype=torch.float64)
        return own[i] + kernel.amplitude * (kernel.between(places[i], places[i]) + noise)

    def objective(at: Tensor) -> Tensor:
        shared, levels, logs = at.split((len(SHARED), bands, len(usual)))
        total = _off(shared) + 0.5 * ((logs - usual) / LOOSE).square().sum()
        for i, at_ in enumerate(places):
            rest = values[i] - rough.at(at_, shared, levels)
            total = total + Evidence.apply(covariance(i, logs), rest, side[i], last[i])  # type: ignore[no-untyped-call]
        return total / count

    middle = float(apart(places[0][:, :3], places[0][:, :3]).median()) or 1.0
    bearing = 0.1 if bool((rough.table[:, 0] != NO_AZIMUTH).any()) else 0.5
    site, sector, around, noise = max(scale**2, 1.0) * np.array([0.5, 0.3, bearing, 0.1])
    numbers = [*[0.1 * middle] * 2, site, sector, around, max(float(gains.var()), 1.0), noise]
    usual = torch.tensor(numbers, dtype=torch.float64).log()
    start = torch.cat([rough.shared, rough.levels, usual]).numpy()
    wide = [(-400.0, 400.0)] * bands + [(math.log(middle * 1e-3), math.log(middle * 3))] * 2
    wide += [(math.log(LEAST_DB2), math.log(1e3))] * 5
    best, _ = walked(objective, [start], [*SHARED_BOUNDS, *wide], LOOKS, SETTLED)
    shared, levels, logs = torch.from_numpy(best).split((len(SHARED), bands, len(usual)))
    learned = replace(rough, shared=shared.clone(), levels=levels.clone())
    precision = torch.eye(len(SHARED) + bands, dtype=torch.float64)
    for i, at_ in enumerate(places):
        gram, quiet = covariance(i, logs), side[i] != 0
        if quiet.any():
            gram.diagonal()[quiet] += last[i][0].variance
        columns = Factor.of(gram, "raise").whitened(learned.shared_columns(at_))
        precision += columns.T @ columns
    doubt, kernel = Factor.of(precision, "raise").root.T, SectorKernel.read(SectorKernel.of(logs).state())
    return replace(learned, doubt=doubt.contiguous(), unit=math.sqrt(kernel.amplitude)), kernel


def _whole(rows: LinkRows) -> LinkRows:
    """Those of places that have as many rows as any, if these are enough; else all."""
    place = np.unique(rows.places[:, :3], axis=0, return_inverse=True)[1].reshape(-1)
    sectors = np.unique(np.stack([place, rows.places[:, 6].astype(np.int64)], 1), axis=0)[:, 0]
    count = np.bincount(sectors)
    whole = count == count.max()
    return rows.at(np.flatnonzero(whole[place])) if whole.sum() >= LEAST_WHOLE else rows


def _stretches(rows: LinkRows, most: int, seed: int) -> LinkRows:
    """At most so many rows, all that there are of places that follow each other in short stretches.

    To take some of the rows of a place would tell of stronger or weaker ones than there are.
    """
    place = np.unique(rows.places[:, :3], axis=0, return_inverse=True)[1].reshape(-1)
    first = np.full(int(place.max()) + 1, len(rows.index))
    np.minimum.at(first, place, rows.index)
    stretch = np.argsort(np.argsort(first)) // STRETCH
    rank = np.random.default_rng(seed).permutation(int(stretch.max()) + 1)[stretch[place]]
    return rows.at(np.sort(np.argsort(rank, kind="stable")[:most]))
