"""Measured channels as rows of one regression: a place, a frequency and what was measured there.

To a receiver all sources are fixed points: a mirror image of the static end, or a small object,
whose leg to the static end is the same for every receiver and folds into the complex gain.
They differ when it moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.physics.waves import ranges
from gsparc.processes import few_rows
from gsparc.processes.places import first_end

LEAST_ROWS = 8  # that a search may be limited to


@dataclass(frozen=True)
class Rows:
    """n complex numbers per output, each at one place and one frequency.

    Attributes:
        position: (n, 3) float64 [m], local.
        frequency: (n,) float64 [Hz].
        target: (n, R) complex64; R outputs share sources and visibility but not gains.
        receiver: (n,) int64, which measurement a row belongs to.
        array: (E, 3) float64 [m], antennas of the static end from its position, site axes; None for
            one.
        element: (n,) int64, which of these a row was measured with; None without `array`.
    """

    position: Tensor
    frequency: Tensor
    target: Tensor
    receiver: Tensor
    array: Tensor | None = None
    element: Tensor | None = None

    def __len__(self) -> int:
        return len(self.position)

    def select_rows(self, index: Tensor) -> Rows:
        """Return the rows with these numbers."""
        element = None if self.element is None else self.element[index]
        measured = (self.target[index], self.receiver[index])
        return Rows(self.position[index], self.frequency[index], *measured, self.array, element)

    @property
    def places(self) -> Tensor:
        """(n, 3) [m], or (n, 6) with the static end's antennas: what visibility depends on."""
        if self.array is None or self.element is None:
            return self.position
        return torch.cat([self.position, self.array[self.element]], 1)

    def static_ends(self, static: Tensor) -> Tensor:
        """Return the static end (3,) [m], or its antennas (E, 3), given its position (3,)."""
        return static if self.array is None else static + self.array


def static_array(site: Site, antennas: int) -> np.ndarray | None:
    """Return antennas (E, 3) float64 [m] of a static receiver from its position, site axes;
    None for one.

    By reciprocity the moving transmitter receives from each of them;
    those of unknown places are outputs.
    """
    if site.static_end != "rx" or site.array is None or antennas == 1:
        return None
    array = np.asarray(site.array, np.float64)
    return array if site.rx_rotation is None else array @ np.asarray(site.rx_rotation, np.float64).T


def antenna_positions(site: Site, position: Tensor, rotation: Tensor, antennas: int) -> Tensor:
    """Return places (S, E, 3) [m] of antennas at positions (S, 3);
    E = 1 where the geometry is unknown.

    Rotations (S, 3, 3), or one (1, 3, 3) for all; differentiable.
    """
    if site.array is None or antennas == 1:
        return position[:, None]
    return position[:, None] + torch.einsum(
        "sij,ej->sei", rotation, torch.as_tensor(site.array).double()
    )


def channel_places(site: Site, antennas: int, position: Tensor, rotation: Tensor) -> Tensor:
    """Return where antennas' channels are measured (`Rows.places`): (S, E, 3) or (S, E, 6)
    float64 [m].

    Args:
        site: where.
        antennas: A, outputs of a measurement.
        position: (S, 3) float64 [m] of the moving end.
        rotation: (S, 3, 3), or (1, 3, 3), float64 of a moving receiver.
    """
    array = static_array(site, antennas)
    if array is not None:
        moving = position[:, None].expand(-1, len(array), -1)
        return torch.cat([moving, torch.from_numpy(array).expand_as(moving)], 2)
    # Antennas of a static receiver without a known array are outputs at the transmitter's place.
    if site.static_end == "rx":
        return position[:, None]
    return antenna_positions(site, position, rotation, antennas)


def rows_of_measurements(data: Measurements, index: np.ndarray, limit: int, seed: int) -> Rows:
    """Return at most `limit` rows from the given measurements.

    Every measurement gives as many antennas of known places as the limit allows, drawn at random,
    and each of these the same number of tones, a comb over the band with a random start, so that
    together they cover it. When one row each exceeds the limit, measurements are subsampled.

    Args:
        data: kind csi; a transmitter that moves is, by reciprocity, a moving receiver.
        index: (S,) measurements to draw from.
        limit: largest number of rows.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    index = np.asarray(index)
    antennas, tones = data.target.shape[1:]
    frequency, array = data.site.tones(), static_array(data.site, antennas)
    if len(index) > limit:
        index = index[few_rows.sample_row_numbers(len(index), limit, rng)]
    places = measured_places(data, index).numpy()
    per = places.shape[1]
    # Antennas first, tones from what is left of the limit.
    most = min(max(limit // max(len(index), 1), 1), per)
    wanted = min(max(limit // max(len(index) * most, 1), 1), tones)
    parts = []
    for row, place in zip(index, places, strict=True):
        values = data.target[row].astype(np.complex64)  # (A, K)
        measured = np.ones((antennas, tones), bool) if data.mask is None else data.mask[row]
        for e in few_rows.sample_row_numbers(per, most, rng) if most < per else range(per):
            # Antennas of unknown places are outputs of one row,
            # so that a tone must be measured at all.
            bins = np.flatnonzero(measured[e] if per > 1 else measured.all(0))
            count = min(wanted, len(bins))
            if count == 0:
                continue
            comb = bins[np.floor((np.arange(count) + rng.random()) * len(bins) / count).astype(int)]
            # `element` names the static end's antenna.
            at, target = np.repeat(first_end(place[e, None]), count, 0), values[e, comb][:, None]
            target = target if per > 1 else values[:, comb].T
            parts.append((at, frequency[comb], target, np.full(count, row), np.full(count, e)))
    *columns, element = (
        torch.from_numpy(np.concatenate(column)) for column in zip(*parts, strict=True)
    )
    rows = Rows(*columns)
    return rows if array is None else replace(rows, array=torch.from_numpy(array), element=element)


def measured_places(data: Measurements, index: np.ndarray) -> Tensor:
    """Return `channel_places` of measurements (S,)."""
    position, rotation = (
        torch.from_numpy(of[index]).double() for of in (data.moving, data.rx_rotation)
    )
    return channel_places(data.site, data.target.shape[1], position, rotation)


def ranges_at(places: Tensor, sources: Tensor, rotations: Tensor) -> Tensor:
    """Return ranges (m, K) float64 [m] from places (m, 3),
    or of images of antennas from places (m, 6).

    Args:
        places: see `Rows.places`.
        sources: (K, 3) float64 [m].
        rotations: (K, 3, 3), see `mirror_planes.orientations`.
    """
    position = first_end(places)
    if places.shape[1] > position.shape[1]:
        # A mirror turns the array with its middle:
        # offsets of antennas are mirrored about the image.
        sources = sources + torch.einsum("kij,mj->mki", rotations, places[:, position.shape[1] :])
    return ranges(position, sources)
