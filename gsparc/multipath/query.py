"""Batched queries of an ensemble: sources of all searches concatenated, rows of one place summed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsparc.multipath.clutter.blocking import Obstacles
from gsparc.multipath.clutter.unfold import Unfolding
from gsparc.multipath.gp_likelihood import Scene
from gsparc.multipath.phased_gp import PhasedPosterior, shares, stacked
from gsparc.multipath.rows import ranges_at
from gsparc.multipath.visibility_kernel import directions, matern32
from gsparc.physics.mirror_planes import orientations
from gsparc.physics.waves import wave, wave_over_band

CHUNK = 128  # places at a time: sources x places x rows floats in memory


@dataclass(frozen=True)
class PackedSources:
    """Sources of one or more processes over the same n places.

    Attributes:
        sources: (K, 3) float64 [m].
        kernel: (K, 3) float32: constant, 1 / angle^2, 1 / length^2 of each source's visibility.
        places: (n, 3) float64 [m], or (n, 6) with the static end's antennas; see `Rows.places`.
        orientations: (K, 3, 3) float64, how antennas of the static end are turned about each source.
        directions: (K, n, 3) float32, unit vectors from source to place.
        unfolding, obstacles: paths of the K sources and what occludes them; None without clutter.
    """

    sources: Tensor
    kernel: Tensor
    places: Tensor
    orientations: Tensor
    directions: Tensor
    unfolding: Unfolding | None
    obstacles: Obstacles | None

    @staticmethod
    def of(scenes: list[Scene], places: Tensor) -> PackedSources:
        """All sources of the scenes, in order."""
        sources = torch.cat([scene.sources for scene in scenes])
        kernels = torch.cat([_kernel_parameters(scene) for scene in scenes])
        turned = torch.cat([orientations(scene.planes, scene.words) for scene in scenes])
        away = directions(places[:, :3], sources)
        packed = PackedSources(sources, kernels, places, turned, away, None, None)
        if not any(len(scene.clutter) for scene in scenes):
            return packed
        first = torch.tensor([0] + [len(scene.planes) for scene in scenes]).cumsum(0).tolist()
        unfolding = Unfolding.concatenate(
            [scene.unfolding.with_offset(start) for scene, start in zip(scenes, first, strict=False)]
        )
        obstacles = Obstacles.concatenate([Obstacles.of(s.clutter, s.planes, len(s.words)) for s in scenes])
        return replace(packed, unfolding=unfolding, obstacles=obstacles)

    def visible_share(self, queries: Tensor) -> Tensor:
        """Visible share of each source from queries (m, 3 or 6) [m]: (K, m), or (1, 1) for all."""
        if self.unfolding is None or self.obstacles is None:
            return torch.ones(1, 1)
        return self.obstacles.visible_share(self.unfolding.paths(queries[:, :3]))

    def ranges(self, queries: Tensor) -> Tensor:
        """Ranges (m, K) float64 [m] of each source, or of its image of the antenna of queries (m, 6)."""
        return ranges_at(queries, self.sources, self.orientations)

    def correlation(self, queries: Tensor) -> Tensor:
        """Visibility correlations (K, m, n) between queries (m, 3 or 6) float64 [m] and the places."""
        cosine = torch.bmm(directions(queries[:, :3], self.sources), self.directions.mT)
        constant, by_angle, by_length = (self.kernel[:, i, None, None] for i in range(3))
        apart = torch.cdist(queries, self.places).square().float()
        squared = (2 - 2 * cosine).clamp_min(0) * by_angle + apart * by_length
        return constant + (1 - constant) * matern32(squared)


class Query:
    """Means of every process, and the variance of one, at new places.

    Args:
        members: processes over the same rows.
        variance_rows: rows that the variance is computed from: fewer overestimate it.
    """

    def __init__(self, members: list[PhasedPosterior], variance_rows: int = 350) -> None:
        rows, scenes = members[0].rows, [member.scene for member in members]
        places, self.place_of = torch.unique(rows.places, dim=0, return_inverse=True)
        self.pack = PackedSources.of(scenes, places)
        self.counts = [len(scene.words) for scene in scenes]
        dual_weights = [member.dual_weights for member in members]
        phases = torch.cat([member.phased.phase for member in members])
        self.phasor = torch.polar(torch.ones(()), phases)[:, None, None]
        weight = torch.zeros(sum(self.counts), len(places), rows.target.shape[1], dtype=torch.complex64)
        weight.index_add_(1, self.place_of, torch.cat(dual_weights))
        self.real, self.imag = weight.real.contiguous(), weight.imag.contiguous()
        few = torch.linspace(0, len(rows) - 1, min(variance_rows, len(rows))).long()
        self.first = members[0]
        if len(few) < len(rows):
            self.first = PhasedPosterior(rows.take(few), members[0].phased, members[0].noise_floor)
        self.few = few
        self.root = self.first.factor.root

    def means(self, queries: Tensor, tones: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means (M, m, R, F) at queries (m, 3 or 6) [m] and tones (F,) [Hz], variance (m,), prior (m,).

        Variance and the power expected without any rows hold at the middle of the band.
        """
        means, variances, priors = [], [], []
        middle = tones[len(tones) // 2]
        for part in queries.split(CHUNK):
            gains, correlation, seen = self._gains(part)
            away = self.pack.ranges(part)
            waves = wave_over_band(away, tones)  # (m, K, F)
            split = zip(gains.split(self.counts), waves.split(self.counts, 1), strict=True)
            means.append(torch.stack([torch.einsum("kmr,mkf->mrf", g, w) for g, w in split]))
            first = slice(self.counts[0])
            arriving = wave(away[:, first], middle)
            variance, prior = self._variance(arriving, correlation[first], seen[first].T)
            variances.append(variance)
            priors.append(prior)
        return torch.cat(means, 1), torch.cat(variances), torch.cat(priors)

    def gains(self, queries: Tensor) -> Tensor:
        """Complex gains (K, m, R) of the sources of all processes at queries."""
        return torch.cat([self._gains(part)[0] for part in queries.split(CHUNK)], 1)

    def _gains(self, part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gains (K, m, R), visibility correlations (K, m, n), and visible shares (K, m)."""
        correlation, seen = self.pack.correlation(part), self.pack.visible_share(part)
        gains = torch.complex(correlation @ self.real, correlation @ self.imag) * self.phasor
        return gains * seen[:, :, None], correlation, seen

    def _variance(
        self, arriving: Tensor, correlation: Tensor, visible_share: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Variance and prior (m,) of waves (m, K) that arrive, before phases and clutter."""
        phased, count = self.first.phased, len(arriving)
        power = phased.scene.log_amplitude.mul(2).exp()
        waves = arriving * torch.polar(torch.ones(()), phased.phase) * visible_share
        seen = correlation[:, :, self.place_of[self.few]]
        # Covariance of queries and rows, in phase with the gain and in quadrature.
        here, there = torch.stack(stacked(waves * power), -1), torch.stack(stacked(self.first.waves), -1)
        here = here * shares(phased.quadrature)
        cross = torch.zeros(2 * count, 2 * len(self.few))
        for k in range(len(power)):
            cross += (here[:, k] @ there[:, k].T) * seen[k].repeat(2, 2)
        prior = (waves.abs().square() * power).sum(1) + math.exp(phased.scene.log_noise)
        known = (self.root @ cross.T).square().sum(0)
        return (prior - known[:count] - known[count:]).clamp_min(0), prior


def _kernel_parameters(scene: Scene) -> Tensor:
    kernel = scene.visibility
    numbers = [float(kernel.constant), float(kernel.angle) ** -2, float(kernel.length) ** -2]
    return torch.tensor(numbers).expand(len(scene.words), 3)


class MeanQuery(Query):
    """Means alone: the variance is most of a query's time."""

    def _variance(self, arriving: Tensor, *unused: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(arriving)), torch.ones(len(arriving))
