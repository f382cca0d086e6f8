"""Batched queries of an ensemble: sources of all searches concatenated, rows of one place summed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import Obstacles
from gsparc.models.image_sources.clutter.unfold import Unfolding
from gsparc.models.image_sources.gp_likelihood import Posterior, shares
from gsparc.models.image_sources.rows import ranges_at
from gsparc.models.image_sources.scene import Scene
from gsparc.models.image_sources.visibility_kernel import directions
from gsparc.models.in_double import in_double
from gsparc.physics.mirror_planes import orientations
from gsparc.physics.waves import wave_over_band
from gsparc.processes.kernel import apart

CHUNK = 128  # places at a time: sources x places x rows floats in memory
VARIANCE_ROWS = 350  # that a variance is computed from: fewer overestimate it


@dataclass(frozen=True)
class PackedSources:
    """Sources of one or more processes over the same n places.

    Attributes:
        sources: (K, 3) float64 [m].
        constant: (K, 1, 1) float32, share of each gain's variance that is the same everywhere.
        by_angle, by_length: (K, 1, 1) float32 `6 / angle^2` and `3 / length^2` of each source's visibility.
        places: (n, 3) float64 [m], or (n, 6) with the static end's antennas; see `Rows.places`.
        orientations: (K, 3, 3) float64, how antennas of the static end are turned about each source.
        towards: (K, 3, n) float32, unit vectors from source to place times `-6 / angle^2`.
        unfolding, obstacles: paths of the K sources and what occludes them; None without clutter.
    """

    sources: Tensor
    constant: Tensor
    by_angle: Tensor
    by_length: Tensor
    places: Tensor
    orientations: Tensor
    towards: Tensor
    unfolding: Unfolding | None
    obstacles: Obstacles | None

    @staticmethod
    def of(scenes: list[Scene], places: Tensor) -> PackedSources:
        """All sources of the scenes, in order."""
        sources = torch.cat([scene.sources for scene in scenes])
        kernels = torch.cat([_kernel_parameters(scene) for scene in scenes])[:, :, None, None]
        turned = torch.cat([orientations(scene.planes, scene.sequences) for scene in scenes])
        towards = (directions(places[:, :3], sources) * -kernels[:, 1]).mT.contiguous()
        one, two, three = kernels.unbind(1)
        packed = PackedSources(sources, one, two, three, places, turned, towards, None, None)
        if not any(len(scene.clutter) for scene in scenes):
            return packed
        first = torch.tensor([0] + [len(scene.planes) for scene in scenes]).cumsum(0).tolist()
        unfolding = Unfolding.concatenate(
            [scene.unfolding.with_offset(start) for scene, start in zip(scenes, first, strict=False)]
        )
        obstacles = Obstacles.concatenate(
            [Obstacles.of(s.clutter, s.planes, len(s.sequences)) for s in scenes]
        )
        return replace(packed, unfolding=unfolding, obstacles=obstacles)

    def visible_share(self, queries: Tensor) -> Tensor | None:
        """Visible share (K, m) of each source from queries (m, 3 or 6) [m]; None without clutter."""
        if self.unfolding is None or self.obstacles is None:
            return None
        return self.obstacles.visible_share(self.unfolding.paths(queries[:, :3]))

    def ranges(self, queries: Tensor) -> Tensor:
        """Ranges (m, K) float64 [m] of each source, or of its image of the antenna of queries (m, 6)."""
        return ranges_at(queries, self.sources, self.orientations)

    def varying(self, queries: Tensor) -> Tensor:
        """Correlations (K, m, n) of what varies of the gains, at queries (m, 3 or 6) [m] and the places.

        With what does not vary, a visibility's correlation is `constant + (1 - constant) varying`.
        """
        dtype = self.towards.dtype
        squared = apart(queries, self.places).square().to(dtype)
        scaled = torch.addcmul(self.by_angle, squared, self.by_length)
        scaled = torch.baddbmm(scaled, directions(queries[:, :3], self.sources, dtype), self.towards)
        root = scaled.clamp_min(1e-9).sqrt()  # Matern-3/2 of 3 times the squared distances
        decay = torch.exp(-root)
        return torch.addcmul(decay, root, decay)


class Means:
    """Means of every process, and the variance of one, at new places.

    Args:
        members: processes over the same rows.
        variance_rows: rows that the variance is computed from; with 0 it is not.
    """

    def __init__(self, members: list[Posterior], variance_rows: int = VARIANCE_ROWS) -> None:
        rows, scenes = members[0].rows, [member.scene for member in members]
        places, place_of = torch.unique(rows.places, dim=0, return_inverse=True)
        self.pack = PackedSources.of(scenes, places)
        self.counts = [len(scene.sequences) for scene in scenes]
        dual = torch.cat([member.dual_weights for member in members])
        dual = dual * torch.cat([scene.turns for scene in scenes])[:, None, None]
        weight = torch.zeros(len(dual), len(places), rows.target.shape[1], dtype=dual.dtype)
        real = torch.view_as_real(weight.index_add_(1, place_of, dual)).flatten(2)  # (K, n, 2 R)
        self.weights = (real * (1 - self.pack.constant)).contiguous()
        self.level = real.sum(1, keepdim=True) * self.pack.constant
        self.variance = RowVariance(members[0], place_of, variance_rows) if variance_rows else None

    @cached_property
    def exact(self) -> Means:
        """The same in float64."""
        return in_double(self)

    def means(self, queries: Tensor, tones: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means (M, m, R, F) at queries (m, 3 or 6) [m] and tones (F,) [Hz], variance (m,), prior (m,).

        Variance and the power expected without any rows hold at the middle of the band; 0 and 1 where no
        variance is computed.
        """
        parts = [self._part(part, tones) for part in queries.split(CHUNK)]
        if len(parts) == 1:
            return parts[0]
        means, variances, priors = zip(*parts, strict=True)
        return torch.cat(means, 1), torch.cat(variances), torch.cat(priors)

    def _part(self, part: Tensor, tones: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gains, varying, seen = self._gains(part)
        waves = wave_over_band(self.pack.ranges(part), tones, varying.dtype)  # (m, K, F)
        split = zip(gains.permute(1, 2, 0).split(self.counts, 2), waves.split(self.counts, 1), strict=True)
        means = torch.stack([gain @ each for gain, each in split])
        if self.variance is None:
            return means, torch.zeros(len(part)), torch.ones(len(part))
        first = self.counts[0]
        arriving = waves[:, :first, len(tones) // 2]
        if seen is not None:
            arriving = arriving * seen[:first].T
        return means, *self.variance(arriving, varying[:first])

    def gains(self, queries: Tensor) -> Tensor:
        """Complex gains (K, m, R) of the sources of all processes at queries."""
        return torch.cat([self._gains(part)[0] for part in queries.split(CHUNK)], 1)

    def _gains(self, part: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Gains (K, m, R), see `PackedSources.varying`, and visible shares (K, m)."""
        varying, seen = self.pack.varying(part), self.pack.visible_share(part)
        real = torch.baddbmm(self.level, varying, self.weights)
        gains = torch.view_as_complex(real.unflatten(2, (-1, 2)))
        return gains if seen is None else gains * seen[:, :, None], varying, seen


class RowVariance:
    """Variance of a process at new places, from some of its rows.

    Args:
        member: the process, over n rows.
        place_of: (n,) int64, number of each row's place.
        count: of the rows used.
    """

    def __init__(self, member: Posterior, place_of: Tensor, count: int) -> None:
        few = torch.linspace(0, len(member.rows) - 1, min(count, len(member.rows))).long()
        if len(few) < len(member.rows):
            member = Posterior(member.rows.take(few), member.scene)
        scene, kernel = member.scene, member.scene.visibility
        self.place_of, self.root = place_of[few], member.conditioned.factor.root.T.contiguous()
        self.phasor, self.power = scene.turns, scene.log_amplitude.mul(2).exp()
        self.noise = math.exp(scene.log_noise)
        there = torch.stack([member.waves.real.T, member.waves.imag.T], 1)[:, None]  # (K, 1, 2, n)
        there = there * self.power[:, None, None, None]
        self.level, self.there = there * float(kernel.constant), there * (1 - float(kernel.constant))
        self.along, across = shares(scene.quadrature).tolist()
        self.across = across * torch.tensor([[1.0, -1.0], [-1.0, 1.0]])[..., None]

    def __call__(self, arriving: Tensor, varying: Tensor) -> tuple[Tensor, Tensor]:
        """Variance and prior (m,) of visible waves (m, K) before phases; see `PackedSources.varying`."""
        here = torch.view_as_real(arriving * self.phasor)  # (m, K, 2)
        there = torch.addcmul(self.level, varying[:, :, None, self.place_of], self.there)  # (K, m, 2, n)
        # Real and imaginary parts of queries with those of rows, (m, 2, 2, n); those in quadrature are the
        # same products, the other way round and with signs.
        product = torch.bmm(here.mT, there.flatten(2).transpose(0, 1)).unflatten(2, (2, -1))
        cross = torch.addcmul(self.along * product, product.flip(1, 2), self.across)
        prior = here.square().sum(2) @ self.power + self.noise
        known = (cross.view(2 * len(here), -1) @ self.root).square().sum(1)
        return (prior - known.view(-1, 2).sum(1)).clamp_min(0), prior


def _kernel_parameters(scene: Scene) -> Tensor:
    """Of each source: constant, 6 / angle^2 and 3 / length^2."""
    kernel = scene.visibility
    numbers = [float(kernel.constant), 6 * float(kernel.angle) ** -2, 3 * float(kernel.length) ** -2]
    return torch.tensor(numbers).expand(len(scene.sequences), 3)
