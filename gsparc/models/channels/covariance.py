"""Covariance of channels at two sets of places: leakage, direct wave, its images and the diffuse field.

    C = p_0 E sinc(k d) + E sum_b p_b w_b V_b(d) + R (p_c + p_d a a^H + sum_n s_n b_n b_n^H)
        + S (p_g a a^H + sum_n t_n b_n b_n^H)

with E the Matern-3/2 envelope, V_b the correlation of waves from one direction, w_b a factor by its angle to
the static end, 1 where there is one end, a and b_n the spherical waves of the static end and of its images in
mirror planes that all ends share, S a squared exponential of gains
that vary over places, and R one that is so long that it only ends far outside.
Noise, and what is correlated over the order of rows, is training's alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, Slot
from gsparc.models.channels.kernels import directed, envelope, plain, smooth, steering
from gsparc.physics.mirror_planes import Reflections, images
from gsparc.processes.kernel import apart

FAST_ROWS, DRIFT_ROWS = 3.0, 15.0  # rows over which errors are correlated
DRIFT_FIELD = 0.7  # share of the drift that is one of the diffuse field; the rest is of all places alike
BLOCK = 1_000_000  # correlations of directions that are computed at a time
HALF = 0.25  # length of the mean of directions from which they are of a half sphere
BEYOND = 10.0  # extents of the places after which nothing is known any more


@dataclass(frozen=True)
class Shape:
    """Which terms there are.

    Attributes:
        angles: (M, 3) float64, where waves of unequal power come from; none: from everywhere alike.
        concentration: of each.
        constant, direct, correlated: whether there is leakage, a direct wave, noise correlated over rows.
        middle: (3,) float64 [m] of the places learned from, where waves have their nominal power.
        reach: length of what is fixed [m].
        sequences: images of the static end in `Values.planes`.
    """

    angles: Tensor
    concentration: float
    constant: bool
    direct: bool
    correlated: bool
    middle: Tensor
    reach: float
    sequences: tuple[Reflections, ...] = ()

    @property
    def count(self) -> int:
        """Images."""
        return len(self.sequences)

    @property
    def is_real(self) -> bool:
        """Whether all covariances are real."""
        return not len(self.angles) and not self.direct and not self.count

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of all powers, in their order."""
        return (
            "isotropic",
            *["direction"] * len(self.angles),
            *["constant"] * self.constant,
            *["direct", "direct_smooth"] * self.direct,
            *["source"] * self.count,
            *["source_smooth"] * self.count,
            "noise",
            *["fast", "drift"] * self.correlated,
        )

    def where(self, name: str) -> list[int]:
        """Numbers of the powers of this name, which are consecutive."""
        return [i for i, each in enumerate(self.names) if each == name]

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Where each name's powers are."""
        return {name: slice(self.names.index(name), max(self.where(name)) + 1) for name in self.names}

    def state(self) -> dict[str, Any]:
        """Which terms there are, as it is made again of."""
        return {each.name: getattr(self, each.name) for each in fields(Shape)}


@dataclass(frozen=True, kw_only=True)
class Values(Shape):
    """The terms and their numbers.

    Attributes:
        power: (P,) float64, see `Shape.names`; relative to each group's scale.
        envelope, gain: () float64 lengths [m] of the diffuse field's envelope and of gains.
        offset: (3,) float64 [m] of static ends from where they are said to be.
        towards: (J,) float64 logarithms of factors of directions' powers, at angles to the static end from 0
            to pi; none: directions are those of the room alone.
        planes: (W, 4) float64 mirror planes that all static ends share, see `physics.mirror_planes`.
    """

    power: Tensor
    envelope: Tensor
    gain: Tensor
    offset: Tensor
    towards: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    planes: Tensor = field(default_factory=lambda: torch.zeros(0, 4, dtype=torch.float64))

    def of(self, name: str) -> Tensor:
        """Powers (m,) of this name; of one that there is not, none."""
        return self.power[self.parts.get(name, slice(0))]

    def gains(self) -> list[Tensor]:
        """Powers (W,) of the fixed gains of all `waves_of`, and of those that vary."""
        named = ("direct", "source"), ("direct_smooth", "source_smooth")
        return [torch.cat([self.of(name) for name in names]) for names in named]


def direct_wave(values: Values, slot: Slot, places: Tensor) -> Tensor:
    """(n,) complex128, of size 1 in the middle; of places (n, 6), from one moving end to the other."""
    if places.shape[1] > 3:
        between, middle = places[:, :3] - places[:, 3:], values.middle[:3] - values.middle[3:]
        away = torch.linalg.vector_norm(middle).clamp_min(2 * math.pi / slot.wavenumber)
        return steering(between, torch.zeros_like(middle), slot.wavenumber, away)
    end = slot.end + values.offset
    return steering(places, end, slot.wavenumber, torch.linalg.vector_norm(end - values.middle))


def image_waves(values: Values, slot: Slot, places: Tensor) -> Tensor:
    """(W, n) complex128 of all images, each of size 1 in the middle."""
    if not values.count:
        return places.new_zeros(0, len(places), dtype=torch.complex128)
    end = slot.end + values.offset
    sources = images(end, values.planes, values.sequences)
    reference = torch.linalg.vector_norm(sources - values.middle, dim=-1)
    waves = [
        steering(places, one, slot.wavenumber, away) for one, away in zip(sources, reference, strict=True)
    ]
    return torch.stack(waves) * mirrored(values.planes, values.sequences, end, values.middle)[:, None]


def mirrored(planes: Tensor, sequences: Sequence[Reflections], end: Tensor, middle: Tensor) -> Tensor:
    """1 for sequences (W,) whose planes all have end (3,) and the places' middle (3,) on one side, else 0."""
    sides = planes[:, :3] @ torch.stack([end, middle], 1) - planes[:, 3:]
    alike = (sides[:, 0] * sides[:, 1] > 0).tolist()
    return torch.tensor(
        [float(all(alike[index] for index in sequence)) for sequence in sequences], dtype=torch.float64
    )


def diffuse_of(values: Values, wavenumber: float, powers: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """The diffuse field's covariance (T, n, m) complex128 of T static ends, places a (n, 3) and b (m, 3) [m].

    `powers` (T, M) are the ends' of directions.
    """
    covariance = values.of("isotropic")[0] * plain(a, b, wavenumber, values.envelope)
    covariance = covariance[None].expand(len(powers), *covariance.shape)
    if not len(values.angles):
        return covariance.to(torch.complex128)
    distance = apart(a, b)
    bound = envelope(distance, values.envelope)
    block = max(BLOCK // max(distance.numel(), 1), 1)
    for angles, power in zip(values.angles.split(block), powers.split(block, dim=1), strict=False):
        if len(angles):
            correlations = directions(angles, values.concentration, wavenumber, a, b, distance)
            covariance = covariance + torch.tensordot(power.to(correlations.dtype), correlations, 1) * bound
    return covariance.to(torch.complex128)


def diffuse_fields(groups: tuple[Group, ...], values: Values) -> list[Tensor]:
    """Covariances (n, n) of the groups' diffuse fields; correlations of shared places are computed once."""
    alike: dict[tuple[bytes, float], list[int]] = {}
    for number, group in enumerate(groups):
        alike.setdefault((group.displacements, group.slot.wavenumber), []).append(number)
    covariances: list[Tensor] = [torch.empty(0)] * len(groups)
    for (_, wavenumber), numbers in alike.items():
        places = groups[numbers[0]].places
        powers = directional(values, [groups[number].slot for number in numbers])
        rows = max(BLOCK // (len(places) * max(len(values.angles), 1)), 1) if len(powers) > 1 else len(places)
        parts = [diffuse_of(values, wavenumber, powers, part, places) for part in places.split(rows)]
        whole = torch.cat(parts, 1)
        for at, number in enumerate(numbers):
            covariances[number] = whole[min(at, len(whole) - 1)]
    return covariances


def directional(values: Values, slots: Sequence[Slot]) -> Tensor:
    """Powers (T, M) of directions as ends have them; (1, M) where all have the same."""
    power = values.of("direction")
    if not len(values.towards) or not len(power):
        return power[None]
    ends = torch.stack([slot.end for slot in slots]) + values.offset
    return power * (angle_knot_weights(values, ends, len(values.towards)) @ values.towards).exp()


def angle_knot_weights(shape: Shape, ends: Tensor, knots: int) -> Tensor:
    """Weights (T, M, J) of J knots in the angle, evenly from 0 to pi, between directions and ends (T, 3).

    Directions of a half sphere stand for their mirror images as well: the nearer one counts.
    """
    towards = torch.nn.functional.normalize(ends - shape.middle, dim=1)
    cosine = towards @ shape.angles.T
    normal = shape.angles.mean(0)
    if float(torch.linalg.vector_norm(normal)) > HALF:
        normal = torch.nn.functional.normalize(normal, dim=0)
        mirrored = shape.angles - 2 * (shape.angles @ normal)[:, None] * normal
        cosine = torch.maximum(cosine, towards @ mirrored.T)
    at = torch.acos(cosine.clamp(-1, 1)) * ((knots - 1) / math.pi)
    return (1 - (at[..., None] - torch.arange(knots, dtype=torch.float64)).abs()).clamp_min(0)


def directions(
    angles: Tensor, concentration: float, wavenumber: float, a: Tensor, b: Tensor, distance: Tensor
) -> Tensor:
    """Correlations (M, n, m) complex128 of waves from each direction (M, 3), over distances (n, m) [m]."""
    middle = b[:1]  # differences of small numbers, wherever the origin is
    before, after = (wavenumber * (angles @ (places - middle).T) for places in (a, b))
    along = before[:, :, None] - after[:, None]
    return directed((wavenumber * distance).square(), along, concentration)


def waves_of(values: Values, slot: Slot, places: Tensor) -> Tensor:
    """(W, n) complex128: the direct wave where there is one, then those of all images."""
    mirrored_waves = image_waves(values, slot, places)
    if not values.direct:
        return mirrored_waves
    return torch.cat([direct_wave(values, slot, places)[None], mirrored_waves])


def explained(values: Values, slot: Slot, a: Tensor, b: Tensor) -> Tensor:
    """The images' share (n, m) of the covariance."""
    return _of_waves(values, slot, a, b, int(values.direct))


def specular(values: Values, slot: Slot, a: Tensor, b: Tensor) -> Tensor:
    """Covariance (n, m) of all but the diffuse field."""
    covariance = _of_waves(values, slot, a, b, 0)
    if not values.constant:
        return covariance
    return covariance + values.of("constant")[0] * smooth(apart(a, b), values.reach)


def _of_waves(values: Values, slot: Slot, a: Tensor, b: Tensor, first: int) -> Tensor:
    """Covariance (n, m) of the waves from number `first` on."""
    distance = apart(a, b)
    before, after = (waves_of(values, slot, places)[first:] for places in (a, b))
    if not len(before):
        return torch.zeros(len(a), len(b), dtype=torch.complex128)
    fixed, varying = ((before.T * power[first:]) @ after.conj() for power in values.gains())
    return fixed * smooth(distance, values.reach) + varying * smooth(distance, values.gain)


def signals(groups: tuple[Group, ...], values: Values) -> list[Tensor]:
    """Covariances (n, n) complex128 of the groups' signals, relative to each one's scale."""
    return [
        field + specular(values, group.slot, group.places, group.places)
        for field, group in zip(diffuse_fields(groups, values), groups, strict=True)
    ]


def prior(values: Values, slot: Slot, places: Tensor) -> Tensor:
    """Variance (n,) of the signal."""
    variance = values.of("isotropic")[0] + directional(values, [slot])[0].sum()
    variance = variance + values.of("constant").sum()
    level = waves_of(values, slot, places).abs().square()
    return (variance + torch.stack(values.gains()).sum(0) @ level).expand(len(places))


def disturbance(values: Values, group: Group) -> Tensor:
    """Covariance (n, n) float64 of what is no signal of the place: noise and drift of training rows."""
    covariance = torch.eye(len(group), dtype=torch.float64) * values.of("noise")
    if values.correlated:
        fast, drift = temporal(values.envelope, group)
        covariance = covariance + values.of("fast") * fast + values.of("drift") * drift
    return covariance


def temporal(length: Tensor | float, group: Group) -> tuple[Tensor, Tensor]:
    """Correlations (n, n) of errors over few rows and over many, between rows of the same run."""
    between = (group.order[:, None] - group.order[None]).abs()
    same = group.run[:, None] == group.run[None]
    waves = plain(group.places, group.places, group.slot.wavenumber, length)
    fast, slow = (torch.exp(-between / rows) * same for rows in (FAST_ROWS, DRIFT_ROWS))
    return fast, slow * (DRIFT_FIELD * waves + 1 - DRIFT_FIELD)
