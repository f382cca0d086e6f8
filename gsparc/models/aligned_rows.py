"""Channels whose rows have phases, delays and gains of their own,
turned until they fit their neighbours.

With one unknown factor a row, what rows share is their shape. Rows are turned along a spanning tree
of near places, then each to what a process of all other rows says of it, in turns with the
process's settings. Many phases fit: those that vary slowly over places ("neighbours") are as good
as the carrier's, unless several antennas at known places see the same factor: then only phases of
waves ("carrier") fit all of them. What predicts rows left out better,
after the same unknown factor, is taken.
"""

from __future__ import annotations

import logging
import math
import weakref
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.data.moments import Snapshots, number_moments
from gsparc.data.schema import Measurements, Site
from gsparc.data.spacing import neighbour_distance
from gsparc.data.splits import Fold
from gsparc.physics.decibels import TINY_POWER
from gsparc.physics.row_factors import UnknownFactor, align_factors, describe_factor
from gsparc.processes.averages import mean_at_places
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.fit_kernel import fit_two_lengths, initial_kernel
from gsparc.processes.kernel import IsotropicWaves, Kernel, WhiteNoise
from gsparc.processes.nearest import neighbour_weights
from gsparc.processes.neighbourhood import rows_with_nearest

log = logging.getLogger(__name__)

NEIGHBOURS = 50  # rows that tell of a row
AT_ONCE = 4_096  # rows whose weights are solved together: memory
TREE = 2_000  # rows of the spanning tree; others hang on the nearest of these
ROUNDS, SWEEPS = 6, 10  # of settings and factors in turn; of all factors in a round
WAVE_SWEEPS = 40
WAVE_NOISE = 0.1  # of the signal's power
ANTENNAS = 4  # with one factor, from which on only phases of waves fit all
SHARED = 0.5  # of antennas heard at a moment, from which on stations have their factors in common
SPACINGS = 4.0  # median distances to the next row that stand for a wavelength where none is known


@dataclass(frozen=True)
class Alignment:
    """Factors that turn rows to each other.

    Attributes:
        factors: (n, K) complex128.
        error: of rows predicted from the others after the same unknown factor, relative to their
            power.
        phase_reference: see `Site`.
    """

    factors: np.ndarray
    error: float
    phase_reference: Literal["carrier", "neighbours"]


def align_phases(data: Measurements, fold: Fold) -> tuple[Measurements, Fold]:
    """Return measurements with training and validation rows turned to each other,
    and rows to learn from.

    Several packets of one place and station become one, the first of them, whose channel is their
    mean. Rows keep what `site.unknown_factor` leaves them; test rows are not looked at.
    Without one nothing is done.
    """
    site = data.site
    if site.unknown_factor == "none" or site.phase_reference is not None:
        return data, fold
    fit_rows = np.sort(fold.learned())
    key = (fold.train.tobytes(), fold.val.tobytes(), site.sha256.encode())
    for data_ref, its, result in _LAST:
        if data_ref() is data and its == key:
            return result
    target, noise, alignments = np.array(data.target), data.noise_variance, []
    for rows in _group_snapshots(data, fit_rows):
        best, channels = align_rows(rows, site.unknown_factor, site), target[rows.rows]
        alignments.append(best)
        factors = rows.to_rows(best.factors)
        if site.unknown_factor == "phase+delay+gain":
            # Where gains are free rows have no level of their own: all are learned at unit power.
            level = _rms_of_rows(rows.values)[rows.moment]
            factors = factors / level[:, None, None]
            if noise is not None:
                noise = np.array(noise)
                noise[rows.rows] /= level**2
        target[rows.rows] = (channels * factors).astype(target.dtype)
    reference: Literal["carrier", "neighbours"] = (
        "carrier"
        if all(alignment.phase_reference == "carrier" for alignment in alignments)
        else "neighbours"
    )
    log.info(
        "aligned %d rows by %s: each is predicted by the others to NMSE %.3g; phases over places "
        "are %s",
        len(fit_rows),
        describe_factor(site.unknown_factor),
        float(np.mean([alignment.error for alignment in alignments])),
        "the carrier's" if reference == "carrier" else "relative to neighbours",
    )
    turned = replace(
        data,
        target=target,
        noise_variance=noise,
        run=None,
        site=replace(site, phase_reference=reference),
    )
    train, turned = average_packets(turned, fold.train)
    val, turned = average_packets(turned, fold.val)
    result = turned, Fold(train, val, fold.test)
    _LAST[:] = [(weakref.ref(data), key, result)]
    return result


def average_packets(data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, Measurements]:
    """Return the first of `rows` at each place and station,
    and measurements where these are the means.
    """
    station = data.stations_of(rows)
    packets, seen = (
        np.c_[data.moving[rows], station],
        None if data.mask is None else data.mask[rows],
    )
    first, mean, count = mean_at_places(packets, data.target[rows], seen)
    if len(first) == len(rows):
        return rows, data
    means = {"target": mean}
    if seen is not None:  # an entry that any of the packets measured
        means["mask"] = mean_at_places(packets, seen.astype(np.float32))[1] > 0
    if (noise := data.noise_variance) is not None:
        means["noise_variance"] = noise[rows[first]] / count.reshape(-1, *[1] * (noise.ndim - 1))
    for name, values in means.items():
        means[name] = whole = np.array(getattr(data, name))
        whole[rows[first]] = values
    return np.sort(rows[first]), replace(data, **means)  # type: ignore[arg-type]


def _group_snapshots(data: Measurements, rows: np.ndarray) -> list[Snapshots]:
    """Rows (n,) of all stations where most are heard at each moment,
    else those of each station alone.
    """
    numbers = data.stations_of(rows)
    stations = np.unique(numbers)
    if len(rows) >= SHARED * len(stations) * (number_moments(data, rows).max() + 1):
        return [Snapshots.from_rows(data, rows)]
    return [Snapshots.from_rows(data, rows[numbers == station]) for station in stations]


def _rms_of_rows(values: np.ndarray) -> np.ndarray:
    """Root mean square (n,) of what was measured in rows (n, A, K), above 0."""
    count = np.maximum((values != 0).sum((1, 2)), 1)
    return np.maximum(np.sqrt((np.abs(values) ** 2).sum((1, 2)) / count), TINY_POWER)


# Of the last alignment the measurements, what else it depends on, and its result:
# baselines share it.
_LAST: list[tuple[weakref.ref[Measurements], tuple[bytes, ...], tuple[Measurements, Fold]]] = []


def align_rows(rows: Snapshots, unknown_factor: UnknownFactor, site: Site) -> Alignment:
    """Return the better of phases relative to neighbours and, where several antennas tell,
    the carrier's.
    """
    if len(rows.values) == 1:  # a row alone has no other to be turned to
        return Alignment(np.ones((1, len(rows.tones)), np.complex128), 1.0, "neighbours")
    power = np.sqrt((np.abs(rows.values) ** 2).mean((0, 2), keepdims=True))
    # Unit power at every antenna: the strongest would decide the factor of all.
    values = rows.values / np.maximum(power, np.finfo(float).tiny)
    if unknown_factor == "phase+delay+gain":
        values = values / _rms_of_rows(values)[:, None, None]
    length = site.wavelength or SPACINGS * (neighbour_distance(rows.places) or 1.0)
    aligner = _Rows(rows.places, values, rows.tones, unknown_factor, length)
    alignments = [aligner.refine_by_neighbours(aligner.align_along_tree(None))]
    direct = _direct_wave(rows, site)
    if direct is not None:
        alignments.append(aligner.refine_by_waves(aligner.align_along_tree(direct)))
    return min(alignments, key=lambda each: each.error)


@dataclass(frozen=True)
class _Rows:
    """Rows of unit power at every antenna, and what of them is free."""

    places: np.ndarray
    values: np.ndarray
    tones: np.ndarray
    unknown_factor: UnknownFactor
    length: float

    def align_along_tree(self, direct_wave: np.ndarray | None) -> np.ndarray:
        """Return factors (n, K) that turn each row to the next of a tree of near places,
        about a direct wave.
        """
        values = self.values if direct_wave is None else self.values * direct_wave.conj()
        factors = np.ones((len(values), len(self.tones)), np.complex128)
        trunk = covering_rows(self.places, TREE, 0)
        # A distance of 0 would be no edge, and several rows may lie at one place.
        tree = minimum_spanning_tree(cdist(self.places[trunk], self.places[trunk]) + 1e-12)
        order, before = breadth_first_order(tree, 0, directed=False)
        child, parent = trunk[order[1:]], trunk[before[order[1:]]]
        rest = np.setdiff1d(np.arange(len(values)), trunk)
        if len(rest):
            next_to = cKDTree(self.places[trunk]).query(self.places[rest])[1]
            child, parent = np.r_[child, rest], np.r_[parent, trunk[next_to]]
        steps = align_factors(values[child], values[parent], self.tones, self.factor_without_gain)
        for row, onto, step in zip(child, parent, steps, strict=True):
            factors[row] = step * factors[onto]
        return factors

    @property
    def factor_without_gain(self) -> UnknownFactor:
        """Without the gain, which unit rows have lost."""
        return "phase" if self.unknown_factor == "phase" else "phase+delay"

    def refine_by_neighbours(self, factors: np.ndarray) -> Alignment:
        """Go on from these factors by a process of two lengths;
        return the round that tells rows best.
        """
        kernel, alignments = initial_kernel(self.length, neighbour_distance(self.places)), []
        for _ in range(ROUNDS):
            factors = self._sweep_factors(factors, self._neighbour_weights(kernel), SWEEPS)
            error = self._left_out_error(factors, self._neighbour_weights(kernel))
            alignments.append(Alignment(factors, error, "neighbours"))
            turned = (self.values * factors[:, None]).reshape(len(factors), -1)
            kernel = fit_two_lengths(self.places, turned, self.length, kernel)
        return min(alignments, key=lambda each: each.error)

    def refine_by_waves(self, factors: np.ndarray) -> Alignment:
        """Go on from these factors by waves from everywhere alike."""
        # An envelope of a thousand wavelengths is none within a site.
        waves = IsotropicWaves(1e3 * self.length, wavenumber=2 * math.pi / self.length)
        weights = self._neighbour_weights(Kernel((waves, WhiteNoise(WAVE_NOISE))))
        factors = self._sweep_factors(factors, weights, WAVE_SWEEPS)
        return Alignment(factors, self._left_out_error(factors, weights), "carrier")

    def _neighbour_weights(self, kernel: Kernel) -> csr_array:
        """Weights (n, n) of the neighbours of each row in what the others say of it."""
        near = rows_with_nearest(self.places, np.arange(len(self.places)), NEIGHBOURS)[:, 1:]
        weight = np.empty(near.shape)
        for part in np.array_split(np.arange(len(near)), -(-len(near) // AT_ONCE)):
            at, around = (
                torch.from_numpy(self.places[part]),
                torch.from_numpy(self.places[near[part]]),
            )
            noise = torch.full(around.shape[:2], float(kernel.noise), dtype=torch.float64)
            weight[part] = neighbour_weights(kernel, at, around, noise)[0].numpy()
        count, starts = len(near), np.arange(len(near) + 1) * near.shape[1]
        return csr_array((weight.ravel(), near.ravel(), starts), (count, count))

    def _predict_left_out(self, factors: np.ndarray, weights: csr_array) -> np.ndarray:
        """Rows (n, A, K) as the others say."""
        turned = self.values * factors[:, None]
        return (weights @ turned.reshape(len(turned), -1)).reshape(turned.shape)

    def _sweep_factors(self, factors: np.ndarray, weights: csr_array, sweeps: int) -> np.ndarray:
        for _ in range(sweeps):
            predictions = self._predict_left_out(factors, weights)
            factors = align_factors(self.values, predictions, self.tones, self.factor_without_gain)
        return factors

    def _left_out_error(self, factors: np.ndarray, weights: csr_array) -> float:
        predictions = self._predict_left_out(factors, weights)
        predictions = (
            predictions
            * align_factors(predictions, self.values, self.tones, self.unknown_factor)[:, None]
        )
        missed = np.abs(self.values - predictions) ** 2 * (self.values != 0)
        return float(missed.sum() / (np.abs(self.values) ** 2).sum())


def _direct_wave(rows: Snapshots, site: Site) -> np.ndarray | None:
    """The direct wave (n, A, 1) where enough antennas at known places see one factor;
    None elsewhere.
    """
    if site.wavelength is None or rows.values.shape[1] < ANTENNAS or rows.places.shape[1] != 3:
        return None
    if site.stations is not None:
        ends = site.stations.position[rows.stations]
    elif site.array is not None and site.static_position is not None and site.static_end == "rx":
        turned = np.eye(3) if site.rx_rotation is None else site.rx_rotation
        ends = site.static_position + site.array @ turned.T
    else:
        return None
    if len(ends) != rows.values.shape[1] or not np.isfinite(ends).all():
        return None
    distance = np.linalg.norm(rows.places[:, None] - ends[None], axis=2)
    return np.exp(-2j * np.pi / site.wavelength * distance)[..., None]
