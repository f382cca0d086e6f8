"""Powers of a network's sectors: a law of distance, their patterns, shadowing that those of a site share.

Places (n, 7) are of the moving end, of the station [m], and the station's number. The pattern is that of 3GPP
TR 36.814, table A.2.1.1-2:
`-min(min(12 (azimuth / width)^2, floor) + min(12 (elevation / height)^2, 20), floor)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from gsparc.processes.kernel import apart, matern32
from gsparc.processes.trend import Trend

ELEVATION_FLOOR_DB = 20.0
BEARING = 0.5  # radians, over which a sector's deviations from its pattern are alike
# Shared by all: exponent, bend [dB a squared decade], logarithms of both widths, floor [dB], tilt [deg].
SHARED = (3.5, 0.0, 0.0, 0.0, 25.0, 0.0)
SHARED_SPREAD = (0.7, 2.0, 0.2, 0.3, 4.0, 1.5)
# Of a sector's own: azimuth, tilt [deg], logarithm of its width; slope [dB a decade].
OWN_SPREAD = (5.0, 1.0, 0.1, 3.0)
NONE = torch.zeros(0, dtype=torch.float64)
NO_AZIMUTH = -1.0
STEP = 0.5  # of a spread, for slopes of the mean


@dataclass(frozen=True)
class Sectors(Trend):
    """The mean of powers of T sectors, and what of it is uncertain.

    Attributes:
        table: (T, 5) float64: azimuth from north, tilt, widths across and in height [deg], power [dB]; one
            without azimuth has no pattern, and -1 there.
        rank: (T,) of a sector among those of its site, and the band of each, int64.
        band: see `rank`.
        shared: (6,) see `SHARED`.
        levels: (bands,) at the middle distance [dB].
        doubt: (6 + bands, Q) what is uncertain of `shared_columns`, for unit normal weights of a site.
        gain: deviation of a sector's level [dB].
        unit: deviation of the processes [dB], in which terms are.
    """

    table: Tensor = NONE
    rank: Tensor = NONE
    band: Tensor = NONE
    shared: Tensor = NONE
    levels: Tensor = NONE
    doubt: Tensor = NONE
    gain: float = 1.0
    unit: float = 1.0

    def mean(self, places: Tensor) -> Tensor:
        """See `Trend`."""
        return self.at(places, self.shared, self.levels)

    def at(  # type: ignore[override]
        self, places: Tensor, shared: Tensor, levels: Tensor, own: Tensor | None = None
    ) -> Tensor:
        """Return powers (..., n) [dB] for shared parameters (..., 6), levels; turn, tilt, width (..., 3)."""
        assert self.law is not None
        number = places[:, 6].long()
        decades = self.law.decades(places) - self.middle
        exponent, bend = shared.unsqueeze(-1).unbind(-2)[:2]
        level = levels[self.band[number]] + self.table[number, 4] - 10 * exponent * decades
        return level - bend * decades.square() - self.loss(places, shared, own)

    def loss(self, places: Tensor, shared: Tensor | None = None, own: Tensor | None = None) -> Tensor:
        """Return what patterns take off (..., n) [dB]; see `at`."""
        azimuth, tilt, width, height, _ = self.table[places[:, 6].long()].T
        shared = self.shared if shared is None else shared
        wider, higher, floor, tilted = shared.unsqueeze(-1).unbind(-2)[2:]
        away = places[:, :3] - places[:, 3:6]
        flat = away[:, :2].norm(dim=1).clamp_min(1e-3)
        # From north and clockwise, as azimuths of sectors are given.
        bearing = torch.rad2deg(torch.atan2(away[:, 0], away[:, 1]))
        down = torch.rad2deg(torch.atan2(-away[:, 2], flat))
        turn, lean, wide = torch.zeros(3, 1) if own is None else own.unsqueeze(-1).unbind(-2)
        # Brought into [-180, 180): a sector to the north sees both sides of 0.
        across = torch.remainder(bearing - azimuth - turn + 180, 360) - 180
        across = 12 * (across / (width * torch.exp(wider + wide))).square()
        over = 12 * ((down - tilt - tilted - lean) / (height * torch.exp(higher))).square()
        loss = across.minimum(floor) + over.clamp_max(ELEVATION_FLOOR_DB)
        return torch.where(azimuth == NO_AZIMUTH, 0.0, loss.minimum(floor))

    def shared_columns(self, places: Tensor) -> Tensor:
        """Return columns (n, 6 + bands) [dB] of what all sectors share, for unit normal weights."""
        steps = STEP * torch.tensor(SHARED_SPREAD, dtype=torch.float64).diag()
        ends = self.at(places, self.shared + torch.cat([steps, -steps]), self.levels)
        # Central differences, half a spread to either side.
        result = (ends[: len(steps)] - ends[len(steps) :]) / (2 * STEP)
        bands = torch.nn.functional.one_hot(self.band[places[:, 6].long()], len(self.levels)).to(places)
        return torch.cat([result.T, self.gain * bands], 1)

    def columns(self, places: Tensor) -> Tensor:
        """See `Trend`: each sector's level, azimuth, tilt, width and slope; what all share."""
        assert self.law is not None
        number = places[:, 6].long()
        steps = STEP * torch.tensor(OWN_SPREAD[:3], dtype=torch.float64).diag()
        ends = self.at(places, self.shared, self.levels, torch.cat([steps, -steps]))
        slope = OWN_SPREAD[3] * (self.law.decades(places) - self.middle)
        parts = [torch.full_like(slope, self.gain), *((ends[:3] - ends[3:]) / (2 * STEP)), slope]
        own = torch.stack(parts, 1) / self.unit
        which = torch.nn.functional.one_hot(self.rank[number], int(self.rank.max()) + 1).to(places)
        # Each sector of a site has columns of its own, which are 0 in the rows of the others.
        shared = self.shared_columns(places) @ self.doubt / self.unit
        return torch.cat([(which[:, :, None] * own[:, None]).flatten(1), shared], 1)


@dataclass(frozen=True)
class SectorKernel:
    """`amplitude (a Matern(site) + same sector (b Matern + c bearing) + noise)` of the sectors of one site.

    Attributes:
        lengths: of a site's shadowing and of a sector's own [m].
        shares: a, b, c; they sum to 1.
        noise: variance relative to `amplitude`.
        amplitude: variance of a value [dB^2].
    """

    lengths: tuple[float, float]
    shares: tuple[float, float, float]
    noise: float
    amplitude: float = 1.0

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return correlations (n, m) of places (n, 7) and (m, 7)."""
        return self.of(Pairs.of(a, b), self.lengths, self.shares)

    @staticmethod
    def of(pairs: Pairs, lengths: Any, shares: Any) -> Tensor:
        """Return the same of pairs, differentiable in lengths and shares."""
        own = shares[1] * matern32(pairs.distance, lengths[1]) + shares[2] * pairs.alike
        return shares[0] * matern32(pairs.distance, lengths[0]) + pairs.same * own

    def state(self) -> dict[str, Any]:
        """Return numbers that `read` needs."""
        return {"site_kernel": [*self.lengths, *self.shares, self.noise, self.amplitude]}

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> Self:
        """Return the kernel whose `state()` this was."""
        v = [float(value) for value in state["site_kernel"]]
        return cls((v[0], v[1]), (v[2], v[3], v[4]), v[5], v[6])


@dataclass(frozen=True)
class Pairs:
    """Of rows (n, 7) and (m, 7): distances [m], whether of one sector, and how alike their bearings are."""

    distance: Tensor
    same: Tensor
    alike: Tensor

    @classmethod
    def of(cls, a: Tensor, b: Tensor) -> Pairs:
        """Compare places (..., n, 7) with (..., m, 7)."""
        towards = [torch.nn.functional.normalize(at[..., :2] - at[..., 3:5], dim=-1) for at in (a, b)]
        # exp((cos angle - 1) / b^2): a Gaussian of small angles that closes around the circle.
        alike = ((towards[0] @ towards[1].mT - 1) / BEARING**2).exp()
        return cls(apart(a[..., :3], b[..., :3]), (a[..., 6:] == b[..., 6:].mT).to(a), alike)
