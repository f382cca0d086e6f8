"""A scene: image sources as sequences over mirror planes, and the waves that arrive from them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, final

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import Clutter, visible_share
from gsparc.models.image_sources.clutter.unfold import Unfolding
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.physics.mirror_planes import Reflections, images
from gsparc.physics.waves import ranges, wave

JITTER = 1e-5  # of unit signal power; what float32 needs to factor the covariance


@final
@dataclass(frozen=True)
class Scene:
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
        quadrature: in (0, 1], twice the share of a gain's variance in quadrature to its phase; 1 with several
            outputs, which have no common phase.
        noise_floor: known variance of the noise, beside what is estimated, in the same units.
    """

    transmitter: Tensor
    planes: Tensor
    sequences: tuple[Reflections, ...]
    log_amplitude: Tensor
    log_noise: float
    visibility: KernelVisibility = KernelVisibility()  # noqa: RUF009 frozen
    clutter: Clutter = field(default_factory=Clutter.none)
    phase: Tensor | None = None
    quadrature: float = 1.0
    noise_floor: float = JITTER

    @staticmethod
    def direct(transmitter: Tensor, log_amplitude: Tensor, log_noise: float = 0.0) -> Scene:
        """The static end (3,) [m] alone, of log amplitude (1,)."""
        return Scene(transmitter, torch.zeros(0, 4, dtype=torch.float64), ((),), log_amplitude, log_noise)

    @cached_property
    def sources(self) -> Tensor:
        """Positions (K, 3) float64 [m]."""
        return images(self.transmitter, self.planes, self.sequences)

    @cached_property
    def unfolding(self) -> Unfolding:
        """The legs of every sequence's path."""
        return Unfolding.of(self.transmitter, self.planes, self.sequences)

    @property
    def walls(self) -> list[int]:
        """Numbers of planes that make a source of one reflection."""
        return [i for i in range(len(self.planes)) if (i,) in self.sequences]

    @property
    def turns(self) -> Tensor:
        """(K,) complex64 of size 1, the phases."""
        assert self.phase is not None
        return torch.polar(torch.ones(()), self.phase)

    def visible_share(self, places: Tensor) -> Tensor:
        """Share of each source that clutter lets through to places (n, 3) [m]: (n, K), or (1, 1)."""
        if not len(self.clutter):
            return torch.ones(1, 1)
        return visible_share(self.unfolding.paths(places), self.clutter, self.planes).T

    def images(self, rows: Rows) -> Tensor:
        """Images (K, 3) float64 [m] of the static end, or (E, K, 3) of each of its antennas."""
        return images(rows.static_ends(self.transmitter), self.planes, self.sequences)

    def unobstructed(self, rows: Rows) -> Tensor:
        """Waves (n, K) complex64 of the sources at every row, turned by their phases, without clutter."""
        waves = steering(rows, self.images(rows))
        return waves if self.phase is None else waves * self.turns

    def waves(self, rows: Rows) -> Tensor:
        """The same, attenuated by clutter."""
        waves = steering(rows, self.images(rows)) * self.visible_share(rows.position)
        return waves if self.phase is None else waves * self.turns

    def over(self, sequences: Iterable[Reflections]) -> Scene:
        """Other sequences over the same planes, of gains that are not known."""
        return replace(self, sequences=tuple(sequences), phase=None)

    def with_sequences(
        self, sequences: list[Reflections], amplitude: Tensor, phase: Tensor | None = None
    ) -> Scene:
        """More sources, with amplitudes (k,), and phases (k,) [rad] where gains have them."""
        log_amplitude = torch.cat([self.log_amplitude, amplitude.log().float()])
        if phase is not None and self.phase is not None:
            phase = torch.cat([self.phase, phase])
        return replace(
            self, sequences=(*self.sequences, *sequences), log_amplitude=log_amplitude, phase=phase
        )

    def only(self, indices: list[int], planes: Iterable[int] = ()) -> Scene:
        """The sources of these indices, and the planes that they use, or that are named."""
        sequences = [self.sequences[i] for i in indices]
        used = sorted({index for sequence in sequences for index in sequence}.union(planes))
        new = {old: i for i, old in enumerate(used)}
        return replace(
            self,
            planes=self.planes[used],
            sequences=tuple(tuple(new[index] for index in sequence) for sequence in sequences),
            log_amplitude=self.log_amplitude[indices],
            clutter=self.clutter.renamed(new),
            phase=None if self.phase is None else self.phase[indices],
        )

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers of a scene with phases, without the noise floor."""
        kernel = self.visibility
        return {
            "transmitter": self.transmitter,
            "planes": self.planes,
            "sequences": [list(sequence) for sequence in self.sequences],
            "log_amplitude": self.log_amplitude,
            "log_noise": self.log_noise,
            "visibility": [float(kernel.constant), float(kernel.angle), float(kernel.length)],
            "phase": self.phase,
            "turning": self.quadrature,
            "boxes": self.clutter.boxes,
            "patches": self.clutter.patches,
            "patched": list(self.clutter.plane),
        }

    @staticmethod
    def from_state(state: dict[str, Any], noise_floor: float) -> Scene:
        """Inverse of `state`."""
        return Scene(
            state["transmitter"],
            state["planes"],
            tuple(map(tuple, state["sequences"])),
            state["log_amplitude"],
            float(state["log_noise"]),
            KernelVisibility(*state["visibility"]),
            Clutter(state["boxes"], state["patches"], tuple(state["patched"])),
            state["phase"],
            float(state["turning"]),
            noise_floor,
        )


def steering(rows: Rows, sources: Tensor) -> Tensor:
    """Spherical waves (n, K) complex64 of sources at every row.

    Args:
        rows: n of them.
        sources: (K, 3) float64 [m], or (E, K, 3) when the rows are of E antennas of the static end.

    Raises:
        ValueError: the images of the antennas are missing.
    """
    if rows.element is not None:
        if sources.dim() != 3:
            raise ValueError("rows of several static antennas need the images of each, (E, K, 3)")
        sources = sources.index_select(0, rows.element)  # (n, K, 3)
    return wave(ranges(rows.position, sources), rows.frequency[:, None])


def direct_amplitude(rows: Rows, transmitter: Tensor) -> Tensor:
    """Amplitude () of the direct wave of the static end (3,) [m] if it were all there is."""
    waves = steering(rows, rows.static_ends(transmitter)[..., None, :])
    return (waves.mH @ rows.target).abs().mean() / waves.abs().square().sum()


def correlations(rows: Rows, sources: Tensor, kernel: KernelVisibility) -> Tensor:
    """Visibility correlations (K, n, n) float32."""
    return torch.stack([kernel.correlation(rows.places, source) for source in sources])
