"""Powers of a network's sectors: a law of distance, their patterns,
shadowing that those of a site share.

Places (n, 7) are of the moving end, of the station [m], and the station's number. The pattern is
that of 3GPP TR 36.814, table A.2.1.1-2:
`-min(min(12 (azimuth / width)^2, floor) + min(12 (elevation / height)^2, 20), floor)`, of angles
[deg] from the azimuth, clockwise from north, and from the tilt, positive downwards. Widths lie
between 3 dB points; `floor` (A_m there) starts at 25 dB and is learned, 20 dB (SLA_v) is fixed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor

from gsparc.processes.kernel import ExponentialShadowing, distances, to_number
from gsparc.processes.places import Places, first_end, horizontal, other_end
from gsparc.processes.term import Columns, Term
from gsparc.processes.trend import Trend

ELEVATION_FLOOR_DB = 20.0
BEARING = 0.5  # radians, over which a sector's deviations from its pattern are alike
# Shared by all: exponent, bend [dB a squared decade], logarithms of both widths, floor [dB],
# tilt [deg].
SHARED = torch.tensor((3.5, 0.0, 0.0, 0.0, 25.0, 0.0), dtype=torch.float64)
SHARED_SPREAD = torch.tensor((0.7, 2.0, 0.2, 0.3, 4.0, 1.5), dtype=torch.float64)
# Of a sector's own: azimuth, tilt [deg], logarithm of its width, floor [dB]; slope [dB a decade].
OWN_SPREAD = torch.tensor((5.0, 1.0, 0.1, 2.5, 3.0), dtype=torch.float64)
LEVEL_DB = 4.0  # of a band
SHARE_SPAN = (1e-2, 1e3)  # bounds of a part's variance [dB^2]
NONE = torch.zeros(0, dtype=torch.float64)
NO_AZIMUTH = -1.0
ROUND = torch.tensor([[NO_AZIMUTH, 0.0, 65.0, 10.0, 0.0]])  # without a pattern, of mean power
USUAL = ROUND[0].clamp_min(0.0).double()  # of a sector where it is not known
ROUND_DEG, NO_PATTERN = 360.0, 1e9  # width [deg] of a beam in height whose tilt nobody gave
BEAM = (0.8, 0.4)  # mean and deviation of the share of its pattern that a sector's levels show
STEP = 0.5  # of a spread, for slopes of the mean
UNITS = STEP * torch.cat([SHARED_SPREAD, OWN_SPREAD[:4]]).diag()
STEPS = torch.cat([UNITS, -UNITS, 0 * UNITS[:1]])  # of parameters, the last without any


def sector_table(beams: np.ndarray) -> Tensor:
    """Return a table (T, 5) float64 as of `Sectors` of what is known of beams (T, 5 or more), NaN
    where nothing is; powers are less their mean.
    """
    beams = beams[:, : len(USUAL)]
    known, given = np.isfinite(beams), torch.from_numpy(np.nan_to_num(beams))
    azimuth, tilt, width, height, power = torch.where(torch.from_numpy(known), given, USUAL).T
    aimed, tilted = torch.from_numpy(known[:, :2]).T
    azimuth = torch.where(aimed, azimuth % ROUND_DEG, NO_AZIMUTH)
    height = torch.where(tilted, height, NO_PATTERN)
    return torch.stack([azimuth, tilt, width, height, power - power.mean()], 1)


def sector_of(places: Places) -> Places:
    """Return the number of the station (..., n) that places (..., n, 7) are of."""
    return places[..., 6]


@dataclass(frozen=True)
class Sectors(Trend):
    """The mean of powers of T sectors, and what of it is uncertain.

    Attributes:
        table: (T, 5) float64: azimuth from north, tilt, widths across and in height [deg], power
            [dB]; one without azimuth has no pattern, and -1 there.
        site: (T,) of each, and its band, int64.
        band: see `site`.
        shared: (6,) see `SHARED`.
        levels: (bands,) at the middle distance [dB].
        doubt: (6 + bands, Q) what is uncertain of `shared_columns`, for unit normal weights of a
            site.
        unit: deviation of the processes [dB], in which terms are.
    """

    table: Tensor = NONE
    site: Tensor = NONE
    band: Tensor = NONE
    shared: Tensor = SHARED
    levels: Tensor = NONE
    doubt: Tensor = NONE
    unit: float = 1.0

    @cached_property
    def indicators(self) -> tuple[Tensor, Tensor]:
        """Return which of its site (T, R) each sector is, and of which band (T, bands),
        as units.
        """
        rank = (self.site[:, None] == self.site).tril(-1).sum(1)
        units = torch.nn.functional.one_hot
        return units(rank).double(), units(self.band, len(self.levels)).double()

    def add_sectors(self, sectors: Tensor, like: int | None = None) -> Sectors:
        """Return these and further ones (k, 5), see `table`, of a site of their own.

        Their band is that of sector `like`; None: the first.
        """
        site = self.site.new_full((len(sectors),), int(self.site.max()) + 1)
        of_band = torch.full_like(site, 0 if like is None else int(self.band[like]))
        band, table = torch.cat([self.band, of_band]), torch.cat([self.table, sectors.double()])
        return replace(self, table=table, site=torch.cat([self.site, site]), band=band)

    def mean(self, places: Tensor) -> Tensor:
        """See `Trend`."""
        return self.powers_at(places, self.shared, self.levels) + self.known_mean(places)

    def known_mean(self, places: Tensor) -> Tensor:
        """Return what `more` terms have as their mean (n,) [dB]."""
        return sum((term.mean(places) for term in self.more), places.new_zeros(len(places)))

    def powers_at(  # type: ignore[override]
        self, places: Tensor, shared: Tensor, levels: Tensor, own: Tensor | None = None
    ) -> Tensor:
        """Return powers (..., n) [dB] for shared parameters (..., 6), levels;
        a sector's own (..., 4).
        """
        assert self.law is not None
        number = sector_of(places).long()
        decades = self.law.decades(places) - self.middle
        exponent, bend = shared.unsqueeze(-1).unbind(-2)[:2]
        level = levels[self.band[number]] + self.table[number, 4] - 10 * exponent * decades
        return level - bend * decades.square() - self.pattern_loss(places, shared, own)

    def pattern_loss(
        self, places: Tensor, shared: Tensor | None = None, own: Tensor | None = None
    ) -> Tensor:
        """Return what patterns take off (..., n) [dB]; see `powers_at`.

        >>> north = Sectors(0.0, table=torch.tensor([[0.0, 0.0, 70.0, 10.0, 0.0]]))
        >>> aside, behind = [0.5736, 0.8192, 0, 0, 0, 0, 0], [0.0, -1, 0, 0, 0, 0, 0]
        >>> north.pattern_loss(torch.tensor([aside, behind])).float()  # 35 degrees aside
        tensor([ 2.9999, 25.0000])
        """
        azimuth, tilt, width, height, _ = self.table[sector_of(places).long()].T
        shared = self.shared if shared is None else shared
        wider, higher, floor, tilted = shared.unsqueeze(-1).unbind(-2)[2:]
        away = first_end(places) - other_end(places)
        flat = horizontal(away).norm(dim=1).clamp_min(1e-3)
        # From north and clockwise, as azimuths of sectors are given.
        bearing = torch.rad2deg(torch.atan2(away[:, 0], away[:, 1]))
        down = torch.rad2deg(torch.atan2(-away[:, 2], flat))
        turn, lean, wide, less = torch.zeros(4, 1) if own is None else own.unsqueeze(-1).unbind(-2)
        floor = floor + less
        # Brought into [-180, 180): a sector to the north sees both sides of 0.
        across = torch.remainder(bearing - azimuth - turn + 180, 360) - 180
        across = 12 * (across / (width * torch.exp(wider + wide))).square()
        over = 12 * ((down - tilt - tilted - lean) / (height * torch.exp(higher))).square()
        loss = across.minimum(floor) + over.clamp_max(ELEVATION_FLOOR_DB)
        return torch.where(azimuth == NO_AZIMUTH, 0.0, loss.minimum(floor))

    def linearise(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return means (n,), and what deviations of all shared parameters, of a sector's own,
        do to them.

        The latter (n, 10) [dB] are central differences, half a spread to either side.
        """
        shared, sector_steps = STEPS.split((len(SHARED), len(OWN_SPREAD) - 1), 1)
        ends = self.powers_at(places, self.shared + shared, self.levels, sector_steps)
        return ends[-1], ((ends[: len(STEPS) // 2] - ends[len(STEPS) // 2 : -1]) / (2 * STEP)).T

    def shared_columns(self, places: Tensor, slopes: Tensor | None = None) -> Tensor:
        """Return columns (n, 6 + bands) [dB] of what all sectors share, for unit normal weights."""
        slopes = self.linearise(places)[1] if slopes is None else slopes
        bands = self.indicators[1][sector_of(places).long()]
        return torch.cat([slopes[:, : len(SHARED)], LEVEL_DB * bands], 1)

    def columns(self, places: Tensor) -> Tensor:
        """See `Trend`: each sector's azimuth, tilt, width, floor and slope; what all share."""
        return self.mean_and_columns(places)[1]

    def mean_and_columns(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """See `Trend`."""
        assert self.law is not None
        (mean, slopes), decades = (
            self.linearise(places),
            (self.law.decades(places) - self.middle)[:, None],
        )
        parts = torch.cat([slopes[:, len(SHARED) :], OWN_SPREAD[-1] * decades], 1)
        # Each sector of a site has columns of its own, which are 0 in the rows of the others.
        blocks = (self.indicators[0][sector_of(places).long(), :, None] * parts[:, None]).flatten(1)
        return mean + self.known_mean(places), torch.cat(
            [blocks, self.shared_columns(places, slopes) @ self.doubt], 1
        ) / self.unit


@dataclass(frozen=True)
class Beam(Columns):
    """What the pattern of one sector takes off: about the listed one, more or less of it.

    >>> north = Beam(torch.tensor([[0.0, 0.0, 70.0, 10.0, 0.0]]), torch.zeros(3))
    >>> north.mean(torch.tensor([[0.0, 1, 0], [0, -1, 0]]))  # ahead of it, and behind
    tensor([ 0., -20.])

    Attributes:
        table: (1, 5) of it, see `Sectors`.
        still: (3,) the end that stands [m].
        middle: mean loss of the rows, less which it is nearly independent of the level [dB].
        unit: deviation of the process [dB], which columns are relative to.
    """

    table: Tensor
    still: Tensor
    middle: float = 0.0
    unit: float = 1.0

    def loss(self, places: Tensor) -> Tensor:
        """Return what the listed pattern takes off (n,) [dB] at places (n, 3) [m]."""
        still, sector = (
            self.still.to(places).expand(len(places), 3),
            places.new_zeros(len(places), 1),
        )
        ends = torch.cat([places, still, sector], 1)
        return Sectors(0.0, table=self.table).pattern_loss(ends) - self.middle

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`."""
        return -BEAM[1] / self.unit * self.loss(places)[:, None]

    def mean(self, places: Tensor) -> Tensor:
        """See `Columns`."""
        return -BEAM[0] * self.loss(places)


@dataclass(frozen=True)
class SectorShadowing(Term[Tensor]):
    """`a exp(site) + same sector (b exp(own) + c bearing + d)` of one site's sectors.

    Shadowing decays exponentially over distance (M. Gudmundson, Electronics Letters 27 (1991); 3GPP
    TR 38.901, section 7.4.4).

    Attributes:
        lengths: of a site's shadowing and of a sector's own [m].
        shares: a, b, c and d, of a sector's level; in a kernel they sum to 1.
    """

    lengths: tuple[Tensor | float, ...]
    shares: tuple[Tensor | float, ...]

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return that (..., n, m) of places (..., n, 7) and (..., m, 7), see `Term`."""
        distance = distances(first_end(a), first_end(b))
        ways = (horizontal(first_end(at) - other_end(at)) for at in (a, b))
        towards = [torch.nn.functional.normalize(way, dim=-1) for way in ways]
        # exp((cos angle - 1) / b^2): a Gaussian of small angles that closes around the circle.
        alike = (towards[0] / BEARING**2 @ towards[1].mT - 1 / BEARING**2).exp()
        (site, sector, bearing, level), (wide, near) = self.shares, self.lengths
        sector_part = sector * (distance * (-1 / near)).exp() + bearing * alike + level
        same = sector_of(a)[..., :, None] == sector_of(b)[..., None, :]
        return site * (distance * (-1 / wide)).exp() + same * sector_part

    def parameters(self) -> Tensor:
        """Return logarithms of lengths and shares (6,)."""
        return torch.tensor([*self.lengths, *self.shares], dtype=torch.float64).log()

    def bounds(self, scale: float) -> list[tuple[float, float]]:
        """See `Term`."""
        lengths = ExponentialShadowing(scale).bounds(scale) * len(self.lengths)
        return lengths + [(math.log(SHARE_SPAN[0]), math.log(SHARE_SPAN[1]))] * len(self.shares)

    def with_values(self, parameters: Tensor) -> Self:
        """See `Term`."""
        lengths, shares = parameters.exp().split((len(self.lengths), len(self.shares)))
        return replace(
            self, lengths=tuple(map(to_number, lengths)), shares=tuple(map(to_number, shares))
        )
