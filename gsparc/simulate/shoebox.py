"""Exact image sources in a shoebox room with absorbing boxes:
ground truth whose every path is known.

Source: J. B. Allen and D. A. Berkley, "Image method for efficiently simulating small-room
acoustics", J. Acoust. Soc. Am. 65 (1979). A path of one transmitter and one receiver is the
straight line to an image of the transmitter; the amplitude law is wavelength / (4 pi d),
the phase exp(-j 2 pi f d / c).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gsparc.data.schema import LIGHT
from gsparc.physics.decibels import from_decibels
from gsparc.simulate.effects import SPECULAR, Effects
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.survey import TracingEngine

WALLS = ("x_low", "x_high", "y_low", "y_high", "z_low", "z_high")


@dataclass(frozen=True)
class Room:
    """A box of six plane walls with absorbing boxes inside.

    Attributes:
        lower, upper: (3,) [m] opposite corners.
        reflection: (6,) real or complex amplitude reflection coefficients, ordered as `WALLS`.
        occluders: (n, 2, 3) [m] lower and upper corners of boxes that absorb what hits them.
    """

    lower: np.ndarray
    upper: np.ndarray
    reflection: np.ndarray
    occluders: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))

    def __post_init__(self) -> None:
        for name, shape in (("lower", (3,)), ("upper", (3,)), ("reflection", (6,))):
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"room.{name}: expected shape {shape}, got {np.shape(getattr(self, name))}"
                )
        if not (np.asarray(self.upper) > np.asarray(self.lower)).all():
            raise ValueError(
                f"room: upper {self.upper} must lie above lower {self.lower} on every axis"
            )
        if np.asarray(self.occluders).shape[1:] != (2, 3):
            raise ValueError(f"room.occluders: expected (n, 2, 3), got {np.shape(self.occluders)}")

    @staticmethod
    def from_size(size: ArrayLike, reflection: complex | np.ndarray = -0.7, **kwargs) -> Room:
        """Return a room from the origin to `size` (3,) [m]; `reflection` of all six walls,
        or (6,).
        """
        return Room(np.zeros(3), np.array(size, dtype=float), np.full(6, reflection), **kwargs)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell whether points (..., 3) [m] are inside the room and outside every occluder: (...)
        bool.

        >>> Room.from_size((6.0, 4.0, 3.0)).contains(np.array([[1.0, 1.0, 1.0], [7.0, 1.0, 1.0]]))
        array([ True, False])
        """
        # The room is open and its boxes are closed: places on a surface are refused.
        inside = np.all((points > self.lower) & (points < self.upper), axis=-1)
        for low, high in self.occluders:
            inside = inside & ~np.all((points >= low) & (points <= high), axis=-1)
        return np.asarray(inside)


@dataclass(frozen=True)
class RoomImages:
    """The mirror images of a room up to some order: the image of p is `signs * p + offsets`.

    Attributes:
        cell: (I, 3) int, which mirrored copy of the room the image lies in; |cell| counts
            reflections.
        signs: (I, 3) of +-1, the diagonal of the orthogonal matrix Q.
        offsets: (I, 3) [m].
        gain: (I,) complex product of the reflection coefficients on the way.
    """

    cell: np.ndarray
    signs: np.ndarray
    offsets: np.ndarray
    gain: np.ndarray

    @property
    def order(self) -> np.ndarray:
        """Number of reflections (I,)."""
        return np.abs(self.cell).sum(axis=1)

    def mirror_points(self, points: np.ndarray) -> np.ndarray:
        """Return images (..., I, 3) [m] of points (..., 3) [m]."""
        return points[..., None, :] * self.signs + self.offsets


def mirror_images(room: Room, max_order: int) -> RoomImages:
    """Return all images of order <= `max_order`, sorted by order; the first is the point itself.

    Itself, one in each wall:

    >>> mirror_images(Room.from_size((6.0, 4.0, 3.0)), max_order=1).order.tolist()
    [0, 1, 1, 1, 1, 1, 1]
    """
    reach = range(-max_order, max_order + 1)
    cells = [c for c in product(reach, repeat=3) if sum(map(abs, c)) <= max_order]
    # By number of reflections, so that the first is the point itself.
    cell = np.array(sorted(cells, key=lambda c: (sum(map(abs, c)), c)), dtype=np.int64)
    signs, offsets = _mirror(room, cell)
    steps = np.abs(cell)
    # Towards the high side the high wall comes first: cell 3 is high, low, high.
    high = np.where(cell > 0, (steps + 1) // 2, steps // 2)
    walls = np.stack([steps - high, high], axis=-1).reshape(-1, 6)
    gain = np.prod(np.asarray(room.reflection, dtype=np.complex128) ** walls, axis=1)
    return RoomImages(cell, signs, offsets, gain)


def _mirror(room: Room, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The map p -> signs * p + offsets into cells (I, 3)."""
    size = np.asarray(room.upper) - room.lower
    even = cell % 2 == 0
    # An even cell is a shifted copy of the room; an odd one is mirrored,
    # the cell -1 in the lower wall.
    return np.where(even, 1.0, -1.0), np.where(even, 0.0, 2.0 * room.lower + size) + cell * size


def visible_images(
    room: Room, images: RoomImages, source: np.ndarray, observer: np.ndarray
) -> np.ndarray:
    """Tell whether each observer sees each image of a source, exactly: (S, I) bool.

    The straight line from the observer to the image runs through mirrored copies of the room; it is
    blocked when it meets a copy of an occluder in one of them (unfolding). Source and observer are
    (S, 3) [m] inside the room, broadcast against each other.
    """
    source, observer = np.broadcast_arrays(np.atleast_2d(source), np.atleast_2d(observer))
    seen = np.ones((len(observer), len(images.cell)), dtype=bool)
    places = images.mirror_points(source)
    for i, cell in enumerate(images.cell):
        # The cells between the room and the image: a straight line to it stays within them.
        crossed = product(*(range(min(0, c), max(0, c) + 1) for c in cell))
        signs, offsets = _mirror(room, np.array(list(crossed), dtype=np.int64))
        for low, high in room.occluders:
            corner, other = signs * low + offsets, signs * high + offsets
            for box_low, box_high in zip(
                np.minimum(corner, other), np.maximum(corner, other), strict=True
            ):
                seen[:, i] &= ~segments_meet_box(observer, places[:, i], box_low, box_high)
    return seen


def segments_meet_box(
    start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Tell whether segments start -> end (S, D) meet the box from low to high (D,): (S,) bool;
    slab test.
    """
    along = end - start
    parallel = along == 0
    # Any divisor does: along a parallel axis `outside` decides alone.
    step = np.where(parallel, 1.0, along)
    near, far = (low - start) / step, (high - start) / step
    near, far = np.minimum(near, far), np.maximum(near, far)
    outside = parallel & ((start < low) | (start > high))
    near, far = np.where(parallel, -np.inf, near), np.where(parallel, np.inf, far)
    # A segment meets the box where it is between all three pairs of planes at once.
    return (np.maximum(near.max(axis=1), 0.0) <= np.minimum(far.min(axis=1), 1.0)) & ~outside.any(
        axis=1
    )


@dataclass(frozen=True)
class Trace:
    """A simulated campaign and its truth.

    Attributes:
        csi: (S, A, K) complex128, noise included.
        tx, rx: (S, 3) [m].
        frequency_hz: (K,) [Hz].
        array: (A, 3) [m], receive elements relative to `rx`, world axes.
        images: the mirror images; sources of a static transmitter are
            `images.mirror_points(tx[0])`.
        visible: (S, I) bool, seen from the array's centre.
        noise_variance: per entry of `csi`; 0 without noise.
    """

    csi: np.ndarray
    tx: np.ndarray
    rx: np.ndarray
    frequency_hz: np.ndarray
    array: np.ndarray
    images: RoomImages
    visible: np.ndarray
    noise_variance: float


def trace_room(
    room: Room,
    tx: np.ndarray,
    rx: np.ndarray,
    frequency_hz: np.ndarray | float,
    *,
    max_order: int = 2,
    array: np.ndarray | None = None,
    snr_db: float | None = None,
    seed: int = 0,
) -> Trace:
    """Compute channels of all rows: `sum_i v_i g_i exp(-j 2 pi f d_i / c) wavelength / (4 pi d_i)`.

    >>> room, tones = Room.from_size((6.0, 4.0, 3.0)), np.array([2.40e9, 2.41e9])
    >>> places = np.array([[5.0, 3.0, 1.0], [2.0, 1.0, 1.0]])
    >>> trace_room(room, np.array([1.0, 1.0, 1.0]), places, tones).csi.shape
    (2, 1, 2)

    Args:
        tx, rx: (S, 3) or (3,) [m] inside the room, broadcast against each other.
        frequency_hz: (K,) or a number [Hz].
        array: (A, 3) [m] receive elements relative to `rx`, world axes; None for one element at
            `rx`.
        snr_db: complex white noise is added this far below the mean power; None for none.
        seed: of the noise.

    Raises:
        ValueError: a position lies outside the room or inside an occluder.
    """
    tx, rx = (
        p.astype(np.float64) for p in np.broadcast_arrays(np.atleast_2d(tx), np.atleast_2d(rx))
    )
    for name, position in (("tx", tx), ("rx", rx)):
        outside = np.flatnonzero(~room.contains(position))
        if len(outside):
            row = f"row {outside[0]} = {position[outside[0]]}"
            raise ValueError(f"{name}, {row}: outside the room or inside an occluder")
    frequency = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    elements = np.zeros((1, 3)) if array is None else np.asarray(array, dtype=np.float64)
    mirrored = mirror_images(room, max_order)
    seen = visible_images(room, mirrored, tx, rx)
    amplitude = mirrored.gain * seen
    csi = np.empty((len(tx), len(elements), len(frequency)), dtype=np.complex128)
    sources = mirrored.mirror_points(tx)
    for a, element in enumerate(elements):
        distance = np.linalg.norm(sources - (rx + element)[:, None], axis=-1)
        for k, f in enumerate(frequency):
            # float64 and cycles, not radians: 10 km at 60 GHz keeps 9 digits of a cycle
            cycles = np.mod(f / LIGHT * distance, 1.0)
            wave = np.exp(-2j * np.pi * cycles) * (LIGHT / f / (4 * np.pi)) / distance
            csi[:, a, k] = (amplitude * wave).sum(axis=1)
    variance = 0.0
    if snr_db is not None:
        variance = float(np.mean(np.abs(csi) ** 2) / from_decibels(snr_db))
        rng = np.random.default_rng(seed)
        # Half of the variance in the real part, half in the imaginary one.
        csi += np.sqrt(variance / 2) * (
            rng.normal(size=csi.shape) + 1j * rng.normal(size=csi.shape)
        )
    return Trace(csi, tx, rx, frequency, elements, mirrored, seen, variance)


class ShoeboxEngine(TracingEngine):
    """A shoebox room with one transmitter (3,) [m] as a `TracingEngine`:
    direct path and mirrors.
    """

    name = "gsparc-shoebox"
    random = False

    def __init__(self, room: Room, transmitter: np.ndarray, carrier_hz: float) -> None:
        self.room = room
        self.transmitter = np.asarray(transmitter, dtype=np.float64)
        self.wavelength = LIGHT / carrier_hz
        if not room.contains(self.transmitter):
            raise ValueError(
                f"scene.transmitter_m={self.transmitter.tolist()}: outside the room or in a box"
            )

    def supported_effects(self, effects: Effects) -> Effects:
        """Keep line of sight and specular reflection; walls do not transmit,
        edges do not diffract.
        """
        return replace(
            effects.switch_off("diffuse", "diffraction", "refraction"),
            polarisation=False,
            # Without reflections only the line of sight is left, which has no bounce.
            depth=effects.depth if effects.specular else 0,
        )

    def trace(
        self, receivers: np.ndarray, effects: Effects, seed: int | None = None
    ) -> TracedPaths:
        """Trace paths to receivers (R, 3) [m]; there are no rays, so no seed matters."""
        mirrored = mirror_images(self.room, effects.depth)
        seen = visible_images(self.room, mirrored, self.transmitter[None], receivers)
        if not effects.line_of_sight:
            seen[:, mirrored.order == 0] = False
        owner, image = np.nonzero(seen)
        way = mirrored.mirror_points(self.transmitter)[image] - receivers[owner]
        distance = np.linalg.norm(way, axis=-1)
        # Friis' amplitude between isotropic antennas, without the carrier's phase.
        gain = mirrored.gain[image] * self.wavelength / (4 * np.pi * distance)
        order = mirrored.order[image].astype(np.uint8)
        return TracedPaths.from_unsorted(
            len(receivers),
            owner,
            gain[:, None].astype(np.complex64),
            distance / LIGHT,
            (way / distance[:, None]).astype(np.float32),
            np.where(order > 0, SPECULAR, 0).astype(np.uint8),
            order,
        )

    def materials(self) -> dict[str, dict[str, Any]]:
        """Return the amplitude reflection coefficients of the walls."""
        return {
            f"wall{i}": {"reflection": abs(complex(r))} for i, r in enumerate(self.room.reflection)
        }
