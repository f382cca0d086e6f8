"""Settings of a network's model of powers, from what its lists hold and from what they leave out.

First laws, patterns and gains as if rows were independent (a Tobit model), which also says where an
azimuth contradicts the data; then all settings by the evidence of processes that sectors of a site
share, in which rows that are only below a level count by expectation propagation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from gsparc.base.errors import Caution, list_first
from gsparc.data.foreign import find_foreign_patches
from gsparc.data.schema import Measurements, Stations
from gsparc.data.station_names import site_name
from gsparc.models.baselines.distance_law import fit_law
from gsparc.models.powers.together.terms import StationRows, places_and_notes, rows_of_stations
from gsparc.processes.censored import PseudoValues
from gsparc.processes.density import NegativeLogEvidence
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import sample_place_rows
from gsparc.processes.fit_kernel import SETTLED, minimise
from gsparc.processes.kernel import Kernel, WhiteNoise, distances
from gsparc.processes.places import first_end, horizontal, other_end
from gsparc.processes.prior import Prior
from gsparc.processes.sectors import (
    NO_AZIMUTH,
    OWN_SPREAD,
    ROUND_DEG,
    SHARED,
    SHARED_SPREAD,
    USUAL,
    Sectors,
    SectorShadowing,
    sector_of,
    sector_table,
)
from gsparc.processes.trend import LEAST_SPREAD
from gsparc.tables.checks.piles import find_floor_piles

SAME_SITE_M = 5.0  # stations closer than this are of one site
SAME_NAME_M = 100.0  # the same of those whose names differ in their last part alone
ONE_BAND = 1.1  # ratio of carriers of one band
GAIN_DB = 4.0  # deviation of a sector's level, before it is learned
LOOSE = 1.5  # deviation of logarithms of kernels' numbers from usual
# Usual noise and deviations by bearing, of the variance; usual lengths, of that between places
LITTLE = 0.1
BOUND = 5.0  # deviations of what sectors share, beyond which it is not looked for
CONTRADICTED_DEG = 30.0
LEAST_TESTED = 20  # rows of a file, whose azimuths are asked
# At .1 nats a row 6 of 16 azimuths that were 60 degrees off passed;
# at .03 too many right ones do not.
SURE = 10.0, 0.05  # nats, and nats a row, by which another azimuth must be likelier
SUREST, TURNED = 0.75, 8  # of the largest gain, that are turned at a time; times
TURNS = torch.arange(-180.0, 180.0, 10.0)  # of an azimuth [deg]
GAINS = torch.arange(-12.0, 12.5, 2.0)  # [dB]
ROUGH_LOOKS = 150  # evaluations, each of a sum over rows
# Rows of all sites; of each site, whose covariance is factored, and where some were silent
ROUGH_ON, LEARNED_ON, WEIGHED_ON = 20_000, 400, 160


def find_sectors(data: Measurements, places: np.ndarray | None = None) -> Sectors | None:
    """Return the sectors that stations are; None without known beams or lists
    of sites with several.

    Args:
        data: powers of several stations.
        places: (T, 3) of the stations [m]; None: those that are given.
    """
    stations = data.site.every_station
    places = stations.position if places is None else places
    sector = stations.beams
    site = number_sites(stations, places)
    levels = () if data.censored is None else np.unique(data.target[data.censored > 0])
    several = 2 * (np.bincount(site)[site] > 1).sum() >= len(site) and len(levels) > len(site)
    if not several and not np.isfinite(sector[:, 0]).any():
        return None  # levels of rows are of lists: a receiver has one for each station
    band = np.zeros(len(site), np.int64)
    if stations.carrier_hz is not None:
        order = np.argsort(stations.carrier_hz)
        steps = np.diff(stations.carrier_hz[order], prepend=stations.carrier_hz[order[:1]])
        band[order] = np.cumsum(steps > (ONE_BAND - 1) * stations.carrier_hz[order])
    which = torch.from_numpy(np.stack([site, band]))
    return Sectors(0.0, table=sector_table(sector), site=which[0], band=which[1])


def number_sites(stations: Stations, places: np.ndarray) -> np.ndarray:
    """Return numbers (T,) int64 of the sites that stations at places (T, 3) [m] belong to.

    >>> at = np.array([[0.0, 0, 0], [20, 0, 0], [500, 0, 0]])
    >>> number_sites(Stations(at, ("A-1", "A-2", "B-1")), at)
    array([0, 0, 1])
    """
    apart = np.linalg.norm(horizontal(places[:, None] - places), axis=-1)
    stem = np.array([site_name(name) for name in stations.name])
    near = (apart <= SAME_SITE_M) | ((apart <= SAME_NAME_M) & (stem[:, None] == stem))
    site = stations.beams[:, len(USUAL)]  # as a column of the list says
    near |= site[:, None] == site
    return connected_components(near)[1].astype(np.int64)


def relabel_by_site(rows: StationRows, network: Sectors) -> StationRows:
    """Return the same by sites; places (n, 7) say which station a row is of."""
    ends = first_end(rows.places), other_end(rows.places)
    places = np.concatenate([*ends, rows.station[:, None]], 1)
    return replace(rows, places=places, station=network.site.numpy()[rows.station])


def check_azimuths(data: Measurements, seed: int = 0) -> list[str]:
    """Return what `learn_network` says of azimuths; nothing where `data` are of no network."""
    if not data.site.target.is_level or data.station is None or len(data) < LEAST_TESTED:
        return []
    numbers = np.arange(len(data))
    places, _ = places_and_notes(data, numbers)
    if (network := find_sectors(data, places)) is None or (network.table[:, 0] == NO_AZIMUTH).all():
        return []
    rows = relabel_by_site(rows_of_stations(data, numbers, places), network)
    return _fit_azimuths(rows, network, data.site.every_station.shown, seed)[-1]


def learn_network(
    rows: StationRows, network: Sectors, names: tuple[str, ...], seed: int
) -> tuple[float, Prior, list[str]]:
    """Return the log evidence and the prior of every site of a network,
    and what must be said of it.

    Args:
        rows: by sites, see `relabel_by_site`.
        network: of the stations.
        names: (T,) of the stations.
        seed: of rows drawn.
    """
    known, more = network.known_mean(torch.from_numpy(rows.places)), network.more
    rows = replace(rows, decibels=rows.decibels - known.numpy())
    rough, gains, scale, notes = _fit_azimuths(rows, replace(network, more=()), names, seed)
    evidence, trend, kernel = _fit_by_evidence(rows, rough, gains, scale, seed)
    shadowing = cast(SectorShadowing, kernel.terms[0])
    variances = (kernel.amplitude * float(part) for part in (*shadowing.shares, kernel.noise))
    (site, own, bearing, gain, noise), (wide, near) = map(math.sqrt, variances), shadowing.lengths
    exponent, _, wider, higher, floor, tilt = trend.shared.tolist()
    law_note = (
        f"{len(names)} sectors of {int(network.site.max()) + 1} sites in one model: distance "
        "exponent "
        f"{exponent:.3g}, gains +- {gain:.2g} dB, noise {noise:.2g} dB"
    )
    shadow_note = (
        f"shadowing of a site {site:.2g} dB over {wide:.3g} m, of a sector {own:.2g} dB over "
        f"{near:.3g} m, "
        f"{bearing:.2g} dB from bearing to bearing"
    )
    beams = (
        f"beams {math.exp(wider):.2f} times as wide and {math.exp(higher):.2f} times as high as "
        "listed or "
        f"usual, front-to-back ratio {floor:.3g} dB, tilts off by {tilt:+.2g} degrees"
    )
    aimed = [beams] if bool((trend.table[:, 0] != NO_AZIMUTH).any()) else []
    return (
        evidence,
        Prior(kernel, replace(trend, more=more)),
        [law_note, shadow_note, *aimed, *notes],
    )


def _fit_azimuths(
    rows: StationRows, network: Sectors, names: tuple[str, ...], seed: int
) -> tuple[Sectors, Tensor, float, list[str]]:
    """What `_fit_rough` returns, with azimuths that rows do not contradict, and notes on these."""
    few = _without_foreign(rows.subset(sample_place_rows(rows.places, ROUGH_ON, seed)))
    law = replace(fit_law(few, None), level=0.0, exponent=0.0)
    loud = few.heard_rows
    decades = law.decades(torch.from_numpy(loud.places))
    start = replace(
        network,
        law=law,
        middle=float(decades.mean()),
        spread=max(float(decades.std()), LEAST_SPREAD),
        levels=torch.full(
            (int(network.band.max()) + 1,), float(loud.decibels.mean()), dtype=torch.float64
        ),
    )
    # A receiver's noise is no level of a sector: no azimuth is doubted by it.
    piles = find_floor_piles(sector_of(loud.places), loud.decibels).values()
    top = max((top for top, _ in piles), default=-math.inf)
    quiet = replace(
        few, decibels=few.decibels.clip(top), side=np.where(few.decibels < top, 1, few.side)
    )
    rough, gains, scale = _fit_rough(quiet, start)
    # A wrong azimuth bends what all sectors share, by which right ones are doubted:
    # the surest first.
    for _ in range(TURNED):
        turned = _correct_azimuths(quiet, rough, gains, scale)
        if torch.equal(turned.table, rough.table):
            break
        rough, gains, scale = _fit_rough(quiet, turned)
    notes = _note_turned(network.table[:, 0], rough.table[:, 0], names)
    notes += _note_untested(quiet, rough, gains, scale, names)
    return *(_fit_rough(few, rough) if piles else (rough, gains, scale)), notes


def _without_foreign(rows: StationRows) -> StationRows:
    """Rows less those that are another station's: far off and strong, they turned an azimuth."""
    foreign, number = [np.zeros(0, np.int64)], sector_of(rows.places)
    for sector in np.unique(number):
        own = np.flatnonzero((number == sector) & ~rows.silent)
        at, still = first_end(rows.places[own]), other_end(rows.places[own[:1]])
        patches = find_foreign_patches(at, rows.decibels[own], still[0]) if len(own) else []
        foreign += [own[patch] for patch in patches]
    return rows.subset(np.setdiff1d(np.arange(len(rows.index)), np.concatenate(foreign)))


def _misfits(mean: Tensor, rows: StationRows, scale: Tensor) -> Tensor:
    """Negative log likelihood of each row (..., n), independent of the others."""
    z = (torch.from_numpy(rows.decibels) - mean) / scale
    side = torch.from_numpy(rows.side)
    beyond = -torch.special.log_ndtr(side * z)
    return torch.where(side != 0, beyond, 0.5 * z.square() + torch.log(scale))


def _penalty(shared: Tensor) -> Tensor:
    """Negative log prior of what sectors share."""
    return 0.5 * ((shared - SHARED) / SHARED_SPREAD).square().sum()


def _shared_bounds() -> list[tuple[float, float]]:
    ends = (SHARED - BOUND * SHARED_SPREAD, SHARED + BOUND * SHARED_SPREAD)
    return list(zip(*(end.tolist() for end in ends), strict=True))


def _fit_rough(rows: StationRows, start: Sectors) -> tuple[Sectors, Tensor, float]:
    """Shared parameters, gains (T,) and the deviation [dB] of rows taken as independent."""
    places, number = (
        torch.from_numpy(rows.places),
        torch.from_numpy(sector_of(rows.places).astype(np.int64)),
    )
    bands, count = len(start.levels), len(start.table)

    def negative_log_posterior(at: Tensor) -> Tensor:
        shared, levels, scale, gains = at.split((len(SHARED), bands, 1, count))
        mean = start.powers_at(places, shared, levels) + gains[number]
        likelihood = _misfits(mean, rows, scale.exp()).sum()
        return likelihood + _penalty(shared) + 0.5 * (gains / GAIN_DB).square().sum()

    begin = np.r_[
        start.shared.numpy(), start.levels.numpy(), math.log(2 * GAIN_DB), np.zeros(count)
    ]
    free = [(-math.inf, math.inf)]
    # A deviation of 1 dB at least.
    bounds = [*_shared_bounds(), *free * bands, (0.0, math.inf), *free * count]
    best, _ = minimise(negative_log_posterior, [begin], bounds, ROUGH_LOOKS)
    shared, levels, scale, gains = torch.from_numpy(best).split((len(SHARED), bands, 1, count))
    return replace(start, shared=shared.clone(), levels=levels.clone()), gains, float(scale.exp())


@torch.no_grad()
def _misfits_of_turns(
    rows: StationRows, trend: Sectors, gains: Tensor, scale: float
) -> tuple[Tensor, Tensor]:
    """How badly rows fit each azimuth turned by `TURNS` (T, K) [nats],
    and what tells two turns apart (T,).

    Zero of all turns where a sector has no azimuth, or nothing was heard of it.
    """
    result = torch.zeros(len(trend.table), len(TURNS), dtype=torch.float64)
    sure = torch.full_like(result[:, 0], SURE[0])
    rest = torch.zeros(len(TURNS), len(OWN_SPREAD) - 2, dtype=torch.float64)  # as it is
    own = torch.cat([TURNS.double()[:, None], rest], 1)
    for t in range(len(trend.table)):
        part = rows.subset(np.flatnonzero(sector_of(rows.places) == t))
        if not len(part.index) or part.silent.all() or trend.table[t, 0] == NO_AZIMUTH:
            continue
        mean = trend.powers_at(torch.from_numpy(part.places), trend.shared, trend.levels, own)
        levels = (gains[t] + GAINS)[:, None]
        likely = _misfits(mean[:, None] + levels, part, torch.tensor(scale)).sum(2)
        result[t] = (likely + 0.5 * (levels[:, 0] / GAIN_DB).square()).amin(1)
        sure[t] += SURE[1] * len(part.index)
    return result, sure


def _correct_azimuths(rows: StationRows, trend: Sectors, gains: Tensor, scale: float) -> Sectors:
    """Those azimuths that rows contradict most turned to where they fit."""
    misfit, sure = _misfits_of_turns(rows, trend, gains, scale)
    least, best = misfit.min(1)
    nats, turn = misfit[:, len(TURNS) // 2] - least, TURNS[best]
    gained = torch.where((turn.abs() >= CONTRADICTED_DEG) & (nats > sure), nats, 0 * nats)
    surest = (gained > 0) & (gained >= SUREST * gained.max())
    table = trend.table.clone()
    table[surest, 0] = (table[surest, 0] + turn[surest].double()) % ROUND_DEG
    return replace(trend, table=table)


def _note_untested(
    rows: StationRows, trend: Sectors, gains: Tensor, scale: float, names: tuple[str, ...]
) -> list[str]:
    """A note on azimuths that rows do not tell to `CONTRADICTED_DEG`,
    and to how many degrees they do.
    """
    misfit, sure = _misfits_of_turns(rows, trend, gains, scale)
    alike = misfit - misfit[:, len(TURNS) // 2, None] <= sure[:, None]
    farthest = torch.where(alike & (trend.table[:, :1] != NO_AZIMUTH), TURNS.abs(), 0.0).amax(1)
    blind = [
        t for t in farthest.argsort(descending=True, stable=True) if farthest[t] >= CONTRADICTED_DEG
    ]
    each = [
        f"{names[t]} {min(float(farthest[t] + TURNS.diff()[0]), 180):.0f} degrees" for t in blind
    ]
    cells = f"{len(blind)} of {len(names)} cells"
    told = f"azimuths of {cells} are tested little: the drive would not show an error of less than"
    return [f"{told}: {list_first(each, 30)}; drive to both sides of their beams"] if blind else []


def _note_turned(given: Tensor, found: Tensor, names: tuple[str, ...]) -> list[str]:
    """A note that names all azimuths (T,) [deg] that were turned, also by less in several steps."""
    turned = [
        f"{names[t]} (listed {given[t]:.0f}, fitted {found[t]:.0f} degrees)"
        for t in torch.nonzero(found != given)[:, 0].tolist()
    ]
    text = f"azimuths are contradicted by levels; the fitted ones are used: {', '.join(turned)}"
    return [Caution(text)] if turned else []


def _fit_by_evidence(
    rows: StationRows, rough: Sectors, gains: Tensor, scale: float, seed: int
) -> tuple[float, Sectors, Kernel]:
    """The log evidence of some rows of each site, and all settings of the largest."""
    rows, bands = rows.select_complete_places(), len(rough.levels)
    most = WEIGHED_ON if rows.silent.any() else LEARNED_ON
    parts = [rows.select_station(number).draw_stretches(most, seed) for number in rows.stations]
    places = [torch.from_numpy(part.places) for part in parts]
    values = [torch.from_numpy(part.decibels) for part in parts]
    side = [torch.from_numpy(part.side) for part in parts]
    rough = replace(rough, doubt=torch.zeros(len(SHARED) + bands, 0, dtype=torch.float64))
    own = [gram @ gram.T for gram in map(rough.columns, places)]
    count, last = sum(map(len, places)), [list[PseudoValues]() for _ in parts]
    middle = float(distances(*(first_end(places[0]),) * 2).median()) or 1.0
    start = _usual_kernel(rough, middle, max(scale**2, 1.0), max(float(gains.var()), 1.0))
    usual = start.parameters()

    def negative_log_evidence(at: Tensor) -> Tensor:
        shared, levels, logs = at.split((len(SHARED), bands, len(usual)))
        total = _penalty(shared) + 0.5 * ((logs - usual) / LOOSE).square().sum()
        kernel = start.with_values(logs)
        for i, at_ in enumerate(places):
            gram, rest = own[i] + kernel.gram(at_), values[i] - rough.powers_at(at_, shared, levels)
            total = total + NegativeLogEvidence.apply(gram, rest, side[i], last[i])  # type: ignore[no-untyped-call]
        return total / count

    *bounds, noise = start.terms[0].bounds(middle)
    bounds = [*_shared_bounds(), *[(-math.inf, math.inf)] * bands, *bounds, noise, noise]
    begin = torch.cat([rough.shared, rough.levels, usual]).numpy()
    best, value = minimise(negative_log_evidence, [begin], bounds, settled=SETTLED / count)
    shared, levels, logs = torch.from_numpy(best).split((len(SHARED), bands, len(usual)))
    learned, kernel = (
        replace(rough, shared=shared.clone(), levels=levels.clone()),
        start.with_values(logs),
    )
    precision = torch.eye(len(SHARED) + bands, dtype=torch.float64)
    for i, at_ in enumerate(places):
        gram, quiet = own[i] + kernel.gram(at_), side[i] != 0
        if quiet.any():
            gram.diagonal()[quiet] += last[i][0].variance
        columns = Factor.from_gram(gram, "raise").whiten(learned.shared_columns(at_))
        precision += columns.T @ columns
    doubt, kernel = Factor.from_gram(precision, "raise").root.T, _to_unit_amplitude(kernel)
    learned = replace(learned, doubt=doubt.contiguous(), unit=math.sqrt(kernel.amplitude))
    return -count * value, learned, kernel


def _usual_kernel(trend: Sectors, middle: float, variance: float, level: float) -> Kernel:
    """Before learning, of amplitude 1, so that parts are variances [dB^2];
    `middle` is between places [m].
    """
    bearing = LITTLE if bool((trend.table[:, 0] != NO_AZIMUTH).any()) else 0.5
    site, sector, around, noise = (variance * share for share in (0.5, 0.3, bearing, LITTLE))
    signal = SectorShadowing((LITTLE * middle, LITTLE * middle), (site, sector, around, level))
    return Kernel((signal, WhiteNoise(noise)))


def _to_unit_amplitude(kernel: Kernel) -> Kernel:
    """The same with parts relative to the amplitude."""
    signal = cast(SectorShadowing, kernel.terms[0])
    amplitude = sum(map(float, signal.shares))
    shares = tuple(share / amplitude for share in signal.shares)
    return Kernel((replace(signal, shares=shares), WhiteNoise(kernel.noise / amplitude)), amplitude)
