"""What rows that came later say of a map of levels: a mixture of kinds of change,
each a process of its own.

A later row misses the map by the map's own error, by what changed, and by noise. What changed is
one of `KINDS`: nothing, one offset, a part of the place, or all of it. Every kind is a Gaussian
process, so that what rows say of other places is in closed form; the answer is the mean over kinds,
weighed by how likely they make the rows of a station (Bayesian model averaging), and shares of
kinds follow from all stations together. Only systems of a station's nearest rows are solved, never
one of all rows that a map was learned from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.processes.averages import MeanVariance
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import distances
from gsparc.processes.later_rows import LaterRows
from gsparc.processes.matern import matern32
from gsparc.processes.stored import Stored

ERRORS = 1 / 20  # length of a map's own errors between its rows, as a share of the site
NEAR, LOOKED = 64, 60  # rows that tell of a place; ones of a station that tell its kind of change
BLOCK = 64  # queries at a time where each has neighbours of its own: memory
NOISES = torch.tensor(
    (0.0, 1.0, 4.0, 12.0, 36.0)
).double()  # what later rows of a station may have on top [dB^2]
# Shares of stations before any row, of a garage and a library that were surveyed again
NOISY = torch.tensor((0.8, 0.05, 0.1, 0.04, 0.01)).double()
NAMED = 120  # rows that name a change: of fewer a small part of the place may have too few
STRENGTH = 10.0  # stations that shares of kinds before any row count as
SETTLED, LEAST = 25, 0.02  # rounds of shares; weight below which a kind is not asked
COMMON, OFFSETS = 5, 2.0  # stations that an offset of all of them is told from; its deviation [dB]
ALIKE, COUNTS = (
    1.0,
    2,
)  # prior variance of what all stations of a place miss alike [dB^2]; places it counts as
WHOLE = 4  # power of the share of the place that rows lie in: whether a lone station was moved
# Length over which rows of a lone station that seems moved void the map: a local change's
AWAY = 1 / 10
UNTOLD = 1e9  # noise of a row that is not there [dB^2]
REFITTED = 200  # latest rows of a station that tell the lengths of changes
# Of a scale that are tried; deviations of an octave
STEPS, OCTAVES = (1.0, 0.5, 2**-0.5, 2**0.5, 2.0), 2.0


class Kind(NamedTuple):
    """A kind of change, as a process.

    Attributes:
        name: see `KINDS`.
        offset, local: deviations [dB] of an offset, and of what differs by place.
        size: length of the latter as a share of the site.
        keeps: 1 where the map still tells, 0 where it does not.
        share: of stations before any row.
    """

    name: str
    offset: float
    local: float
    size: float
    keeps: float
    share: float


KINDS = (
    Kind("none", 0.0, 0.0, 0.1, 1.0, 0.8),
    Kind("offset", 2.5, 0.0, 0.1, 1.0, 0.06),
    Kind("offset", 10.0, 0.0, 0.1, 1.0, 0.04),
    Kind("local", 0.5, 6.0, 1 / 10, 1.0, 0.04),
    Kind("local", 3.0, 3.0, 1 / 4, 1.0, 0.04),
    Kind("moved", 10.0, 8.0, 1 / 4, 0.0, 0.02),
)
SAME = torch.tensor([kind.name == "none" for kind in KINDS])
OFFSET, LOCAL, SIZE, KEEPS, SHARE = (
    torch.tensor(part).double() for part in zip(*(k[1:] for k in KINDS), strict=True)
)


@dataclass(frozen=True)
class Belief(Stored):
    """What all stations' rows say together.

    Attributes:
        extent: of the site [m].
        common: offset that all stations share [dB].
        noise: (T,) variance that a station's later rows have on top of their noise [dB^2].
        share: (K,) of stations by kind of change.
        weight: (T, K) of each kind, by station.
        names: (T,) numbers of these stations.
        scale: of the lengths of local changes.
    """

    extent: float
    common: float = 0.0
    noise: Tensor | float = 0.0
    share: Tensor = SHARE
    weight: Tensor = SHARE[None, :0]
    names: tuple[int, ...] = ()
    scale: float = 1.0

    def of(self, station: int) -> tuple[Tensor, Tensor]:
        """Return weights (K,) of the kinds of a station, and its noise on top [dB^2]."""
        if station not in self.names:
            return self.share, torch.zeros(())
        index = self.names.index(station)
        return self.weight[index], torch.as_tensor(self.noise).expand(len(self.names))[index]


def covariance_by_kind(
    a: Tensor,
    b: Tensor,
    doubt_a: Tensor,
    doubt_b: Tensor,
    extent: float,
    scale: float = 1.0,
    kinds: Tensor | slice = slice(None),
) -> Tensor:
    """Return covariances (..., K, n, m) of what is missed at places (..., n, D) and (..., m, D),
    by kind.
    """
    distance = distances(a, b)[..., None, :, :]
    doubt = (doubt_a[..., :, None] * doubt_b[..., None, :]).sqrt()[..., None, :, :]
    map_errors = doubt * matern32(distance, extent * ERRORS)
    sizes = SIZE * extent * torch.where(KEEPS > 0, scale, 1.0)
    each = (part[kinds, None, None] for part in (OFFSET.square(), LOCAL.square(), sizes, KEEPS))
    offset, local, length, keeps = each
    return keeps * map_errors + offset + local * matern32(distance, length)


def _values(rows: LaterRows, common: float) -> Tensor:
    """What each kind has to explain (K, n) [dB]."""
    return rows.missed + (1 - KEEPS)[:, None] * (rows.level - rows.middle) - common


def change_log_evidence(
    stations: Sequence[LaterRows],
    extent: float,
    common: float,
    scale: float = 1.0,
    looked: int = LOOKED,
) -> Tensor:
    """Return log densities (T, len(NOISES), K) of `looked` rows of each station,
    spread over places [nats].

    Args:
        stations: rows of each.
        extent, common, scale: see `Belief`.
        looked: rows of a station, at most.
    """
    spread = [rows.spread(extent, looked) for rows in stations]
    most = max(len(rows) for rows in spread)
    # Stations of fewer rows get rows of endless noise, which tell nothing of kinds.
    missed = torch.stack([_padded(_values(rows, common).T, most) for rows in spread]).mT
    parts = (
        torch.stack([_padded(getattr(rows, n), most) for rows in spread])
        for n in ("places", "doubt")
    )
    places, doubt = parts
    noise = torch.stack([_padded(rows.noise, most, UNTOLD) for rows in spread])[:, None]
    gram = covariance_by_kind(places, places, doubt, doubt, extent, scale)[:, None].repeat(
        1, len(NOISES), 1, 1, 1
    )
    gram.diagonal(dim1=-2, dim2=-1).add_((NOISES[:, None] + noise)[:, :, None])
    factor = Factor.from_gram(gram, "raise")
    white = factor.whiten(missed[:, None, ..., None].expand(-1, len(NOISES), -1, -1, -1))
    lacking = torch.tensor([most - len(rows) for rows in spread])[:, None, None]
    determinant = factor.log_determinant - lacking * math.log(UNTOLD)
    return -0.5 * (white.square().sum((-1, -2)) + determinant)


def _padded(values: Tensor, length: int, filling: float = 0.0) -> Tensor:
    """Values (n, ...) and as many more of `filling` as `length` lacks."""
    return torch.cat([values, values.new_full((length - len(values), *values.shape[1:]), filling)])


def learn_changes(
    stations: Mapping[int, LaterRows], extent: float, scale: float = 1.0, looked: int = LOOKED
) -> Belief:
    """Return what the stations' rows say together: the common offset, the noise,
    and kinds of change.

    Args:
        stations: rows of each.
        extent, scale: see `Belief`.
        looked: places of a station that tell its kind of change.
    """
    names = tuple(sorted(name for name, rows in stations.items() if len(rows)))
    if not names:
        return Belief(extent, scale=scale)
    common = common_offset([stations[name] for name in names])
    log_density = change_log_evidence(
        [stations[name].merge() for name in names], extent, common, scale, looked
    )
    share, noisy = SHARE, NOISY
    for _ in range(SETTLED):
        weight = (noisy.log()[:, None] + share.log() + log_density).flatten(1).softmax(1)
        weight = weight.unflatten(1, log_density.shape[1:])
        share = (weight.sum((0, 1)) + STRENGTH * SHARE) / (len(names) + STRENGTH)
        noisy = (weight.sum((0, 2)) + STRENGTH * NOISY) / (len(names) + STRENGTH)
    noise = weight.sum(2) @ NOISES
    return Belief(extent, common, noise, share, weight.sum(1), names, scale)


def refit_scale(stations: Mapping[int, LaterRows], belief: Belief) -> float:
    """Return the scale of local changes, among halves and doubles of what it was,
    that makes rows likeliest.

    1 is likeliest before any row, and one an octave off `OCTAVES` deviations away.
    """
    parts, scales = (
        [rows for rows in stations.values() if len(rows)],
        [belief.scale * step for step in STEPS],
    )
    if not parts:
        return belief.scale
    common, before = common_offset(parts), NOISY.log()[:, None] + SHARE.log()
    parts = [rows.merge() for rows in parts]
    density = [
        change_log_evidence(parts, belief.extent, common, scale, REFITTED) + before
        for scale in scales
    ]
    likely = torch.stack(density).flatten(2).logsumexp(2).sum(1)
    return scales[int((likely - (OCTAVES * torch.tensor(scales).log2()).square() / 2).argmax())]


def common_offset(stations: Sequence[LaterRows]) -> float:
    """Return what all stations' latest rows miss alike [dB]: 0 of few stations,
    shrunk by how unsure it is.

    Either it is 0, or normal with deviation `OFFSETS`. Its error has two parts: stations differ,
    and so do places, as a phone that is turned misses all stations of a place alike.
    """
    if len(stations) < COMMON:
        return 0.0
    latest = reduce(LaterRows.join, (rows[-LOOKED:] for rows in stations))
    mean = torch.stack([rows.missed[-LOOKED:].mean() for rows in stations])
    middle = mean.median()
    # A median's standard error, by the median absolute deviation of a normal variable.
    error = (1.253 * 1.483 * (mean - middle).abs().median()).square() / len(mean)
    which, count = latest.places.unique(dim=0, return_inverse=True, return_counts=True)[1:]
    by_place = latest.missed.new_zeros(len(count)).index_add(0, which, latest.missed) / count
    spread = (by_place - by_place.mean()).square().sum() + ALIKE * COUNTS
    error = error + spread / (len(count) - 1 + COUNTS) / len(count)
    total = OFFSETS**2 + error
    odds = (error / total).sqrt() * (0.5 * middle.square() * (1 / error - 1 / total)).exp()
    return float(middle * OFFSETS**2 / total * odds / (1 + odds))


@torch.no_grad()
def correct(
    belief: Belief, station: int, rows: LaterRows, places: Tensor, level: Tensor, doubt: Tensor
) -> MeanVariance:
    """Return means (B,) [dB] and variances (B,) [dB^2], noise excluded, at places of a station now.

    Args:
        belief: of all stations.
        station: its number.
        rows: its later rows; none: the common offset alone is added.
        places: (B, D) float64 [m].
        level, doubt: (B,) of the map there [dB, dB^2].
    """
    if not len(rows):
        return MeanVariance(level + belief.common, doubt)
    weight, added = belief.of(station)
    kinds = (weight >= LEAST).nonzero()[:, 0]
    weight = weight[kinds] / weight[kinds].sum()
    rows = rows.merge()
    values = _values(rows, belief.common)[kinds]
    if len(rows) <= NEAR:
        mean, variance, near = _solve(belief, rows, added, values, kinds, places[None], doubt[None])
        mean, variance, near = mean[0], variance[0], near[0]
    else:
        nearest = torch.from_numpy(cKDTree(rows.places.numpy()).query(places.numpy(), NEAR)[1])
        blocks = zip(nearest.split(BLOCK), places.split(BLOCK), doubt.split(BLOCK), strict=True)
        parts = [
            _solve(
                belief,
                rows[index],
                added,
                values[:, index].movedim(0, 1),
                kinds,
                place[:, None],
                map_doubt[:, None],
            )
            for index, place, map_doubt in blocks
        ]
        mean, variance, near = (torch.cat(part)[..., 0].T for part in zip(*parts, strict=True))
    # Rows in a part of the place cannot tell what was moved elsewhere;
    # of many stations their share does.
    seen = (
        float(torch.linalg.vector_norm(rows.places.amax(0) - rows.places.amin(0))) / belief.extent
    )
    seen = 1.0 if len(belief.names) > 1 else min(seen, 1.0) ** WHOLE
    away = (1 - KEEPS[kinds, None]) * (near + (1 - near) * seen)
    mean = belief.common + level + (KEEPS[kinds, None] + away) * mean + away * (rows.middle - level)
    middle = weight @ mean
    return MeanVariance(middle, weight @ (variance + (mean - middle).square()))


@torch.no_grad()
def main_effect(rows: LaterRows, extent: float) -> tuple[str, float, Tensor]:
    """Return the name of the change that does most to predictions at a station's rows, decibels
    that are added where it is, and shares (n,) of it of these rows' places, merged.
    """
    belief, rows = learn_changes({0: rows}, extent, looked=NAMED), rows.merge()
    weight, added = belief.of(0)
    kinds = torch.arange(len(KINDS))
    mean, _, _ = _solve(
        belief, rows, added, _values(rows, 0.0), kinds, rows.places[None], rows.doubt[None]
    )
    # Of a map that tells nothing any more its middle is what is left.
    mean = mean[0] - (1 - KEEPS)[:, None] * (rows.level - rows.middle)
    none = torch.zeros_like(rows.missed)
    effects = {
        name: sum((weight[k] * mean[k] for k, kind in enumerate(KINDS) if kind.name == name), none)
        for name in dict.fromkeys(kind.name for kind in KINDS if kind.name != "none")
    }
    name = max(effects, key=lambda name: float(effects[name].square().mean()))
    applied = sum(effects.values(), none)
    share = torch.ones_like(applied) if name == "offset" else applied.square()
    share = share / share.sum()
    return name, float(share @ applied), share


def _solve(
    belief: Belief,
    rows: LaterRows,
    added: Tensor,
    values: Tensor,
    kept: Tensor,
    places: Tensor,
    doubt: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, variances and correlations with the nearest row (G, K', B).

    Of groups of places (G, B, D) by rows (G or none, n).
    """
    lengths = belief.extent, belief.scale, kept
    gram = covariance_by_kind(rows.places, rows.places, rows.doubt, rows.doubt, *lengths)
    gram.diagonal(dim1=-2, dim2=-1).add_((rows.noise + added).unsqueeze(-2))
    cross = covariance_by_kind(places, rows.places, doubt, rows.doubt, *lengths)
    factor = Factor.from_gram(gram, "raise")
    mean = (cross @ factor.solve(values[..., None]))[..., 0]
    prior = KEEPS[kept, None] * doubt[:, None] + (OFFSET.square() + LOCAL.square())[kept, None]
    reduction = factor.whiten(cross.mT.contiguous()).square().sum(-2)
    near = matern32(distances(places, rows.places), belief.extent * AWAY).amax(-1)
    return mean, (prior - reduction).clamp_min(0.0), near[:, None].expand_as(mean)
