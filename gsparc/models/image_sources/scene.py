"""A scene: image sources as sequences over mirror planes, and the waves that arrive from them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.models.image_sources.clutter.blocking import Clutter, Obstacles
from gsparc.models.image_sources.clutter.unfold import Unfolding
from gsparc.models.image_sources.rows import Rows
from gsparc.physics.mirror_planes import NO_PLANES, Reflections, all_sequences, images
from gsparc.physics.waves import point_wave, ranges
from gsparc.processes.matern import matern32_of_squares
from gsparc.processes.places import first_end

BETAS = 0.8, 0.95  # decay rates of Adam's moments: of tens of steps, not its usual thousand
JITTER = 1e-5  # of unit signal power; what float32 needs to factor the covariance
ROUNDED = 1e-3  # of a squared length, largest rounding error of a squared distance


@dataclass(frozen=True)
class KernelVisibility:
    """`c + (1 - c) Matern-3/2(direction, place)`: a constant gain plus one that varies smoothly.

    Sources do not occlude each other: each has its own gain process,
    and all share the kernel's parameters.

    Attributes:
        constant: share of the gain's variance that is the same everywhere.
        angle: length scale of the direction to the source [rad].
        length: length scale of the place [m].
    """

    constant: float | Tensor = 0.8
    angle: float | Tensor = 0.5
    length: float | Tensor = 2.0

    def correlation(
        self, places: Tensor, source: Tensor, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        """Return (n, n) in [0, 1] of the gains of a source (3,) [m] at places (n, 3) float64 [m].

        By reciprocity gains also vary over places of the static end, the last three of (n, 6)
        numbers.
        """
        squared = _squared_distances(unit_vectors(first_end(places), source, dtype)) / self.angle**2
        if not _needs_float64(places, float(torch.as_tensor(self.length).detach())):
            places = places.to(dtype)
        squared = squared + _squared_distances(places).to(dtype) / self.length**2
        return self.constant + (1 - self.constant) * matern32_of_squares(squared)

    @staticmethod
    def from_parameters(value: Tensor) -> KernelVisibility:
        """Make it from the logit of `constant` and the logarithms of both lengths;
        differentiable.
        """
        return KernelVisibility(torch.sigmoid(value[0]), value[1].exp(), value[2].exp())

    def to_parameters(self, min_share: float, *shares: float) -> Tensor:
        """Return what `from_parameters` reads, then logits of more `shares`;
        all are at least `min_share`.
        """
        # A logit has no value at 0 and 1, and hardly a slope near them.
        clipped = [min(max(float(share), min_share), 0.995) for share in (self.constant, *shares)]
        first, *rest = (math.log(share / (1 - share)) for share in clipped)
        return torch.tensor([first, math.log(self.angle), math.log(self.length), *rest])

    def to_floats(self) -> KernelVisibility:
        """Return it with numbers instead of tensors."""
        return KernelVisibility(float(self.constant), float(self.angle), float(self.length))


@final
@dataclass(frozen=True)
class SourceScene:
    """Image sources with amplitudes, visibility, clutter and noise.

    Attributes:
        transmitter: (3,) float64 [m], the sequence ().
        planes: (P, 4) float64, see `gsparc.physics.mirror_planes`.
        sequences: K of them, the transmitter first.
        log_amplitude: (K,) float32, log s_k.
        log_noise: log of the noise variance, in units of the rows' power.
        visibility: kernel of all sources' gains, beside the occlusion by clutter.
        clutter: occluding boxes and finite mirrors.
        phase: (K,) float32 [rad] of gains of constant phase; None: gains are circular.
        quadrature: in (0, 1], twice the share of a gain's variance in quadrature to its phase; 1
            with several outputs, which have no common phase.
        noise_floor: known variance of the noise, beside what is estimated, in the same units.
    """

    transmitter: Tensor
    planes: Tensor
    sequences: tuple[Reflections, ...]
    log_amplitude: Tensor
    log_noise: float
    visibility: KernelVisibility = KernelVisibility()
    clutter: Clutter = field(default_factory=Clutter.empty)
    phase: Tensor | None = None
    quadrature: float = 1.0
    noise_floor: float = JITTER

    @staticmethod
    def from_static_end(
        transmitter: Tensor, log_amplitude: Tensor, log_noise: float = 0.0
    ) -> SourceScene:
        """Return the static end (3,) [m] alone, of log amplitude (1,)."""
        return SourceScene(transmitter, NO_PLANES, ((),), log_amplitude, log_noise)

    @cached_property
    def sources(self) -> Tensor:
        """Positions (K, 3) float64 [m]."""
        return images(self.transmitter, self.planes, self.sequences)

    @cached_property
    def unfolding(self) -> Unfolding:
        """The legs of every sequence's path."""
        return Unfolding(self.transmitter, self.planes, self.sequences)

    @cached_property
    def obstacles(self) -> Obstacles:
        """What hides paths."""
        return Obstacles(self.clutter, self.planes)

    @property
    def walls(self) -> list[int]:
        """Numbers of planes that make a source of one reflection."""
        return [i for i in range(len(self.planes)) if (i,) in self.sequences]

    @property
    def phase_factors(self) -> Tensor:
        """(K,) complex64 of size 1, the phases."""
        assert self.phase is not None
        return torch.polar(torch.ones_like(self.phase), self.phase)

    def visible_share(self, places: Tensor) -> Tensor:
        """Return shares (n, K), or (1, 1), of sources that clutter lets through to places (n, 3)
        [m].
        """
        if not len(self.clutter):
            return torch.ones(1, 1)
        return self.obstacles.visible_share(self.unfolding.paths(places)).T

    def images(self, rows: Rows) -> Tensor:
        """Return images (K, 3) float64 [m] of the static end, or (E, K, 3)
        of each of its antennas.
        """
        return images(rows.static_ends(self.transmitter), self.planes, self.sequences)

    def unobstructed_waves(self, rows: Rows) -> Tensor:
        """Return waves (n, K) complex64 of sources at every row, turned by phases,
        without clutter.
        """
        waves = spherical_waves(rows, self.images(rows))
        return waves if self.phase is None else waves * self.phase_factors

    def waves(self, rows: Rows) -> Tensor:
        """Return the same, attenuated by clutter."""
        waves = spherical_waves(rows, self.images(rows)) * self.visible_share(rows.position)
        return waves if self.phase is None else waves * self.phase_factors

    def longer_sequences(self, order: int) -> list[Reflections]:
        """Return other sequences over the planes: up to `order` with one more at the end,
        and all pairs.
        """
        indices = range(len(self.planes))
        more = [
            (*w, i)
            for w in self.sequences
            if len(w) < order
            for i in indices
            if not w or w[-1] != i
        ]
        sequences = set(self.sequences)
        return [w for w in dict.fromkeys(more + all_sequences([*indices], 2)) if w not in sequences]

    def replace_sequences(self, sequences: Iterable[Reflections]) -> SourceScene:
        """Return other sequences over the same planes, of gains that are not known."""
        return replace(self, sequences=tuple(sequences), phase=None)

    def add_sequences(
        self, sequences: list[Reflections], amplitude: Tensor, phase: Tensor | None = None
    ) -> SourceScene:
        """Return more sources, with amplitudes (k,), and phases (k,)
        [rad] where gains have them.
        """
        log_amplitude = torch.cat([self.log_amplitude, amplitude.log().float()])
        if phase is not None and self.phase is not None:
            phase = torch.cat([self.phase, phase])
        return replace(
            self, sequences=(*self.sequences, *sequences), log_amplitude=log_amplitude, phase=phase
        )

    def select_sources(self, indices: list[int], planes: Iterable[int] = ()) -> SourceScene:
        """Return the sources of these indices, and the planes that they use, or that are named."""
        sequences = [self.sequences[i] for i in indices]
        used = sorted({index for sequence in sequences for index in sequence}.union(planes))
        new = {old: i for i, old in enumerate(used)}
        return replace(
            self,
            planes=self.planes[used],
            sequences=tuple(tuple(new[index] for index in sequence) for sequence in sequences),
            log_amplitude=self.log_amplitude[indices],
            clutter=self.clutter.renumber_planes(new),
            phase=None if self.phase is None else self.phase[indices],
        )


def spherical_waves(rows: Rows, sources: Tensor) -> Tensor:
    """Return the spherical waves (n, K) of sources at every row, in the precision of its targets.

    Args:
        rows: n of them.
        sources: (K, 3) float64 [m], or (E, K, 3) when the rows are of E antennas of the static end.

    Raises:
        ValueError: the images of the antennas are missing.
    """
    if rows.element is not None:
        if sources.dim() == 2:
            raise ValueError("rows of several static antennas need the images of each, (E, K, 3)")
        sources = sources.index_select(0, rows.element)  # (n, K, 3)
    return point_wave(
        ranges(rows.position, sources), rows.frequency[:, None], rows.target.real.dtype
    )


def direct_amplitude(rows: Rows, transmitter: Tensor) -> Tensor:
    """Return the amplitude () of the direct wave of the static end (3,)
    [m] if it were all there is.
    """
    waves = spherical_waves(rows, rows.static_ends(transmitter)[..., None, :])
    return (waves.mH @ rows.target).abs().mean() / waves.abs().square().sum()


def unit_vectors(places: Tensor, sources: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return unit vectors (..., n, 3) from sources (..., 3) to places (n, 3) float64 [m]."""
    return normalize(places - sources[..., None, :], dim=-1).to(dtype)


def _needs_float64(places: Tensor, length: float) -> bool:
    """Whether squared distances need float64: of 5 km those in float32 are off by a square metre.

    Elsewhere float64 would only double the time of a search.
    """
    reach = float(places.abs().max()) if places.numel() else 0.0
    return torch.finfo(torch.float32).eps * reach**2 > ROUNDED * length**2


def _squared_distances(a: Tensor) -> Tensor:
    length = a.square().sum(-1)
    # The sum cancels for near places, and rounds below 0.
    return (length[:, None] + length[None] - 2 * a @ a.T).clamp_min(0)
