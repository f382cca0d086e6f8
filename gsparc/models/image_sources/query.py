"""Batched queries of an ensemble: sources of all searches concatenated,
rows of one place summed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple
from functools import cached_property

import torch
from torch import Tensor

from gsparc.models.closed_form import Moments
from gsparc.models.image_sources.gp_likelihood import GainPosterior, quadrature_variances
from gsparc.models.image_sources.rows import ranges_at
from gsparc.models.image_sources.scene import unit_vectors
from gsparc.models.predicting import to_double
from gsparc.physics.mirror_planes import image_rotations
from gsparc.physics.waves import wave_over_band
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.kernel import distances
from gsparc.processes.places import first_end

CHUNK = 128  # places at a time: sources x places x rows floats in memory
MATERN32 = 3  # factor of squared distances over lengths in Matern-3/2
VARIANCE_ROWS = 350  # that a variance is computed from: fewer overestimate it


class EnsembleMeans:
    """Means of every process, and the variance of one, at new places.

    Args:
        members: processes over the same rows, of K sources together.
        variance_rows: rows that the variance is computed from; with 0 it is not.

    Attributes:
        counts: sources of each process.
        sources: (K, 3) float64 [m].
        orientations: (K, 3, 3) float64, how antennas of the static end are turned about each
            source.
        places: (n, 3) float64 [m] of the rows, or (n, 6) with the static end's antennas; see
            `Rows.places`.
        by_angle, by_length: (K, 1, 1) float32 `6 / angle^2` and `3 / length^2` of each source's
            visibility.
        towards: (K, 3, n) float32, unit vectors from source to place times `-6 / angle^2`.
        level: (K, 1, 2 R), what does not vary of the gains, real and imaginary.
        weights: (K, n, 2 R), of what varies.
        hiding: paths of each scene's sources and what occludes them; none where no scene has
            clutter.
    """

    def __init__(
        self, members: Sequence[GainPosterior], variance_rows: int = VARIANCE_ROWS
    ) -> None:
        exact = [member.in_float64 for member in members]
        rows, scenes = members[0].rows, [member.scene for member in members]
        self.places, place_of = torch.unique(rows.places, dim=0, return_inverse=True)
        self.counts = [len(scene.sequences) for scene in scenes]
        self.sources = torch.cat([scene.sources for scene in scenes])
        self.orientations = torch.cat(
            [image_rotations(scene.planes, scene.sequences) for scene in scenes]
        )
        numbers = torch.tensor([astuple(scene.visibility) for scene in scenes], dtype=torch.float64)
        each = torch.repeat_interleave(numbers, torch.tensor(self.counts), 0)[:, :, None, None]
        constant, angle, length = each.unbind(1)
        # |u - v|^2 of unit vectors is 2 - 2 u.v.
        self.by_angle = (2 * MATERN32 / angle**2).float()
        self.by_length = (MATERN32 / length**2).float()
        toward = unit_vectors(first_end(self.places), self.sources)
        self.towards = (toward * -self.by_angle).mT.contiguous()
        # Not at the first query, which may be for inference alone.
        hides = any(len(scene.clutter) for scene in scenes)
        self.hiding = [(scene.unfolding, scene.obstacles) for scene in scenes] if hides else []
        dual = torch.cat(
            [member.dual_weights * member.scene.phase_factors[:, None, None] for member in exact]
        )
        weight = torch.zeros(len(dual), len(self.places), rows.target.shape[1], dtype=dual.dtype)
        real = torch.view_as_real(weight.index_add_(1, place_of, dual)).flatten(2)  # (K, n, 2 R)
        self.weights = (real * (1 - constant)).float().contiguous()
        self.level = (real.sum(1, keepdim=True) * constant).float()
        self.variance = RowVariance(exact[0], place_of, variance_rows) if variance_rows else None

    def visible_share(self, queries: Tensor) -> Tensor | None:
        """Return visible shares (K, m) of sources from queries (m, 3 or 6) [m];
        None without clutter.
        """
        if not self.hiding:
            return None
        places = first_end(queries)
        return torch.cat([hidden.visible_share(legs.paths(places)) for legs, hidden in self.hiding])

    def ranges(self, queries: Tensor) -> Tensor:
        """Return ranges (m, K) float64 [m] of sources,
        or of their images of antennas of queries (m, 6).
        """
        return ranges_at(queries, self.sources, self.orientations)

    def varying_correlations(self, queries: Tensor) -> Tensor:
        """Return correlations (K, m, n) of varying gains at queries (m, 3 or 6)
        [m] and at the places.

        With what does not vary, a visibility's correlation is `constant + (1 - constant) varying`.
        """
        dtype = self.towards.dtype
        squared = distances(queries, self.places).square().to(dtype)
        scaled = torch.addcmul(self.by_angle, squared, self.by_length)
        scaled = torch.baddbmm(
            scaled, unit_vectors(first_end(queries), self.sources, dtype), self.towards
        )
        root = scaled.clamp_min(1e-9).sqrt()  # Matern-3/2 of 3 times the squared distances
        decay = torch.exp(-root)
        return torch.addcmul(decay, root, decay)

    @cached_property
    def in_float64(self) -> EnsembleMeans:
        """The same in float64."""
        return to_double(self)

    def predict(self, queries: Tensor, tones: Tensor) -> Moments:
        """Return means (M, m, R, F) at queries (m, 3 or 6) [m] and tones (F,) [Hz],
        variance and prior (m,).

        Variance and the power expected without any rows hold at the middle of the band; 0 and 1
        where no variance is computed.
        """
        parts = [self._predict_part(part, tones) for part in queries.split(CHUNK)]
        if len(parts) == 1:
            return parts[0]
        means, variances, priors = zip(*parts, strict=True)
        return Moments(torch.cat(means, 1), torch.cat(variances), torch.cat(priors))

    def _predict_part(self, part: Tensor, tones: Tensor) -> Moments:
        gains, varying, seen = self._gains_and_shares(part)
        waves = wave_over_band(self.ranges(part), tones, varying.dtype)  # (m, K, F)
        split = zip(
            gains.permute(1, 2, 0).split(self.counts, 2), waves.split(self.counts, 1), strict=True
        )
        means = torch.stack([gain @ each for gain, each in split])
        if self.variance is None:
            return Moments(means, torch.zeros(len(part)), torch.ones(len(part)))
        first = self.counts[0]
        arriving = waves[:, :first, len(tones) // 2]
        if seen is not None:
            arriving = arriving * seen[:first].T
        return Moments(means, *self.variance(arriving, varying[:first]))

    def gains(self, queries: Tensor) -> Tensor:
        """Return complex gains (K, m, R) of the sources of all processes at queries."""
        return torch.cat([self._gains_and_shares(part)[0] for part in queries.split(CHUNK)], 1)

    def _gains_and_shares(self, part: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Gains (K, m, R), see `varying_correlations`, and visible shares (K, m)."""
        varying, seen = self.varying_correlations(part), self.visible_share(part)
        real = torch.baddbmm(self.level, varying, self.weights)
        gains = torch.view_as_complex(real.unflatten(2, (-1, 2)))
        return gains if seen is None else gains * seen[:, :, None], varying, seen


class RowVariance:
    """Variance of a process at new places, from some of its rows.

    Args:
        member: the process, over n rows, in float64.
        place_of: (n,) int64, number of each row's place.
        count: of the rows used.
    """

    def __init__(self, member: GainPosterior, place_of: Tensor, count: int) -> None:
        few = torch.from_numpy(evenly_spaced(len(member.rows), count))
        if len(few) < len(member.rows):
            member = GainPosterior(member.rows.select_rows(few), member.scene)
        scene, kernel = member.scene, member.scene.visibility
        self.place_of, self.root = (
            place_of[few],
            member.conditioned.factor.root.T.float().contiguous(),
        )
        self.phasor, self.power = (
            scene.phase_factors.to(torch.complex64),
            scene.log_amplitude.mul(2).exp().float(),
        )
        self.noise = math.exp(scene.log_noise)
        # (K, 1, 2, n)
        there = torch.stack([member.waves.real.T, member.waves.imag.T], 1)[:, None].float()
        there = there * self.power[:, None, None, None]
        self.level, self.there = (
            there * float(kernel.constant),
            there * (1 - float(kernel.constant)),
        )
        self.along, across = quadrature_variances(scene.quadrature).tolist()
        self.across = across * torch.tensor([[1.0, -1.0], [-1.0, 1.0]])[..., None]

    def __call__(self, arriving: Tensor, varying: Tensor) -> tuple[Tensor, Tensor]:
        """Variance and prior (m,) of visible waves (m, K) before phases;
        see `varying_correlations`.
        """
        steered = torch.view_as_real(arriving * self.phasor)  # (m, K, 2)
        # (K, m, 2, n)
        there = torch.addcmul(self.level, varying[:, :, None, self.place_of], self.there)
        # Real and imaginary parts of queries with those of rows, (m, 2, 2, n); those in quadrature
        # are the same products, the other way round and with signs.
        product = torch.bmm(steered.mT, there.flatten(2).transpose(0, 1)).unflatten(2, (2, -1))
        cross = torch.addcmul(self.along * product, product.flip(1, 2), self.across)
        prior = steered.square().sum(2) @ self.power + self.noise
        reduction = (cross.flatten(2).flatten(0, 1) @ self.root).square().sum(1)
        return (prior - reduction.view(-1, 2).sum(1)).clamp_min(0), prior
