"""Rays among city blocks, seen from above: walls reflect, corners diffract,
lamp posts and cars scatter.

A 2.5-D engine: buildings are taller than every ray, so what blocks is decided in the plane, and the
third dimension enters as the difference of heights, once straight and once by way of the ground.
Reflections are image sources (Allen and Berkley, 1979), edges follow Keller's half-plane
coefficient (Keller, 1962), and scatterers the radar equation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from gsparc.data.schema import LIGHT
from gsparc.simulate.shoebox import segments_meet_box

SHRINK = 1e-6  # [m]; a reflection point on a wall does not lie inside the building
STRONGEST = 64  # paths of a user
LEAST_BEND = 0.1  # [rad]; Keller's coefficient has a pole on the shadow boundary


@dataclass(frozen=True)
class Streets:
    """A few city blocks and what stands between them.

    >>> block, none = np.array([[[10.0, -5.0], [20.0, 5.0]]]), np.zeros(0)
    >>> streets = Streets(block, np.array([-0.8]), np.zeros((0, 3)), none, none, base=np.zeros(3))

    Behind it, beside it:

    >>> streets.are_blocked(np.zeros((2, 2)), np.array([[30.0, 0.0], [0.0, 30.0]]))
    array([ True, False])

    Attributes:
        buildings: (n, 2, 2) [m] lower and upper corners in the plane.
        reflection: (n,) real amplitude reflection coefficient of each building's walls.
        scatterers: (m, 3) [m].
        cross_section: (m,) [m^2] radar cross section of each.
        scatterer_phase: (m,) [rad].
        base: (3,) [m] the base station.
        ground: amplitude reflection coefficient of the ground.
    """

    buildings: np.ndarray
    reflection: np.ndarray
    scatterers: np.ndarray
    cross_section: np.ndarray
    scatterer_phase: np.ndarray
    base: np.ndarray
    ground: float = -0.5

    def are_blocked(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Tell whether a building stands between points a and b (S, 2) [m]: (S,) bool."""
        hit = np.zeros(len(a), dtype=bool)
        for low, high in self.buildings:
            hit |= segments_meet_box(a, b, low + SHRINK, high - SHRINK)
        return hit

    def are_outdoors(self, points: np.ndarray) -> np.ndarray:
        """Tell whether points (S, 2) [m] lie outside every building: (S,) bool."""
        low, high = self.buildings[:, 0], self.buildings[:, 1]
        inside = (points[:, None] >= low) & (points[:, None] <= high)
        return ~np.any(np.all(inside, axis=-1), axis=1)


@dataclass(frozen=True)
class StreetPaths:
    """The strongest P paths of U users; silent ones have gain 0.

    Attributes:
        gain: (U, P) complex128 amplitude without carrier phase.
        delay: (U, P) [s].
        direction: (U, P, 3) unit vectors from the base station towards the first interaction.
    """

    gain: np.ndarray
    delay: np.ndarray
    direction: np.ndarray

    def select_users(self, users: np.ndarray) -> StreetPaths:
        """Return the paths of some users (n,)."""
        return StreetPaths(self.gain[users], self.delay[users], self.direction[users])

    def response(
        self, array: np.ndarray, carrier_hz: float, frequency_hz: np.ndarray
    ) -> np.ndarray:
        """Return channels (U, A, K) complex128 at (K,) [Hz] of elements (A, 3)
        [m] about the base.
        """
        steering = np.exp(2j * np.pi * carrier_hz / LIGHT * (self.direction @ array.T))  # (U, P, A)
        turns = np.mod(self.delay[..., None] * frequency_hz, 1.0)
        return np.swapaxes(steering, 1, 2) @ (self.gain[..., None] * np.exp(-2j * np.pi * turns))


@dataclass(frozen=True)
class _Route:
    """One way from the base to those users (rows) that it reaches, in the plane."""

    users: np.ndarray
    length: np.ndarray
    towards: np.ndarray
    gain: np.ndarray


def trace_streets(streets: Streets, users: np.ndarray, wavelength: float) -> StreetPaths:
    """Trace paths from the base to users (U, 3) [m]: direct, two reflections,
    scatterers and edges.
    """
    routes = list(_routes(streets, users, wavelength))
    gain = np.zeros((len(users), 2 * len(routes)), complex)
    delay, direction = np.zeros(gain.shape), np.zeros((*gain.shape, 3))
    for i, route in enumerate(routes):
        for j, (sign, loss) in enumerate(((1.0, 1.0), (-1.0, streets.ground))):
            # By way of the ground the user is seen at minus its height.
            climb = sign * users[route.users, 2] - streets.base[2]
            length = np.hypot(route.length, climb)
            at = route.users, np.full(len(route.users), 2 * i + j)
            # Gains of routes are of lengths in the plane;
            # amplitudes fall with the lengths in space.
            gain[at] = route.gain * loss * route.length / length
            delay[at] = length / LIGHT
            flat = route.towards * (route.length / length)[:, None]
            direction[at] = np.concatenate([flat, (climb / length)[:, None]], axis=1)
    keep = np.argsort(-np.abs(gain), axis=1)[:, :STRONGEST]
    rows = np.arange(len(users))[:, None]
    return StreetPaths(gain[rows, keep], delay[rows, keep], direction[rows, keep])


def _routes(streets: Streets, users: np.ndarray, wavelength: float) -> Iterator[_Route]:
    base, flat = streets.base[:2], users[:, :2]
    spread = wavelength / (4 * np.pi)
    shadow = streets.are_blocked(np.broadcast_to(base, flat.shape), flat)
    lit = np.flatnonzero(~shadow)
    if len(lit):
        length = np.linalg.norm(flat[lit] - base, axis=1)
        yield _Route(lit, length, (flat[lit] - base) / length[:, None], spread / length + 0j)
    yield from _reflections(streets, flat, spread)
    for place, area, phase in zip(
        streets.scatterers, streets.cross_section, streets.scatterer_phase, strict=True
    ):
        amplitude = np.sqrt(area / (4 * np.pi)) * np.exp(1j * phase)
        yield from _bounce(streets, flat, place[:2], lambda d, e, g=amplitude: spread * g / (d * e))
    number = 2 * np.pi / wavelength
    low, high = streets.buildings[:, 0], streets.buildings[:, 1]
    signs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    # In the street
    for corner in np.concatenate([np.where(s < 0, low, high) + 1e-3 * s for s in signs]):
        yield from _edge(streets, flat, corner, shadow, spread, number)


def _reflections(streets: Streets, flat: np.ndarray, spread: float) -> Iterator[_Route]:
    """One and two reflections: the straight line to an image must cross its walls,
    and nothing else.
    """
    base = streets.base[:2]
    walls = [  # axis, coordinate, low, high, outward sign, reflection
        (axis, place[axis], low[1 - axis], high[1 - axis], sign, reflection)
        for (low, high), reflection in zip(streets.buildings, streets.reflection, strict=True)
        for axis in (0, 1)
        for place, sign in ((low, -1.0), (high, 1.0))
    ]
    for sequence in (*permutations(range(len(walls)), 1), *permutations(range(len(walls)), 2)):
        # The base in the first wall, that image in the next, and so on.
        images = [base]
        for i in sequence:
            axis, coordinate = walls[i][:2]
            image = images[-1].copy()
            image[axis] = 2 * coordinate - image[axis]
            images.append(image)
        first = walls[sequence[0]]
        if first[4] * (base[first[0]] - first[1]) <= 0:  # the base looks at this wall's back
            continue
        users, target = np.arange(len(flat)), flat
        points: list[np.ndarray] = []
        # Back from the user: where the line to each image meets its wall.
        for i, image in zip(reversed(sequence), reversed(images), strict=False):
            axis, coordinate, low, high, sign, _ = walls[i]
            front = sign * (target[:, axis] - coordinate) > 0
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (coordinate - image[axis]) / (target[:, axis] - image[axis])
                at = image + share[:, None] * (target - image)
            good = (
                front
                & (share > 0)
                & (share < 1)
                & (at[:, 1 - axis] > low)
                & (at[:, 1 - axis] < high)
            )
            users, points, target = users[good], [p[good] for p in points] + [at[good]], at[good]
        if not len(users):
            continue
        stops = [flat[users], *points, np.broadcast_to(base, (len(users), 2))]
        clear = np.ones(len(users), bool)
        for a, b in pairwise(stops):
            clear[clear] = ~streets.are_blocked(a[clear], b[clear])
        users, towards = users[clear], points[-1][clear] - base
        if len(users):
            length = np.linalg.norm(flat[users] - images[-1], axis=1)
            loss = np.prod([walls[i][5] for i in sequence])
            unit = towards / np.linalg.norm(towards, axis=1, keepdims=True)
            yield _Route(users, length, unit, spread * loss / length + 0j)


def _bounce(streets: Streets, flat: np.ndarray, place: np.ndarray, law) -> Iterator[_Route]:
    """Base to `place` to the users in its line of sight;
    amplitude `law(first leg, second leg)` [m].
    """
    base = streets.base[:2]
    if streets.are_blocked(base[None], place[None])[0]:
        return
    users = np.flatnonzero(~streets.are_blocked(np.broadcast_to(place, flat.shape), flat))
    if len(users):
        near, far = np.linalg.norm(place - base), np.linalg.norm(flat[users] - place, axis=1)
        # The far field of a scatterer: at the scatterer itself a user would hear infinite power.
        far = np.maximum(far, 1.0)
        unit = np.broadcast_to((place - base) / near, (len(users), 2))
        yield _Route(users, near + far, unit, law(near, far) + 0j)


def _edge(
    streets: Streets,
    flat: np.ndarray,
    corner: np.ndarray,
    shadow: np.ndarray,
    spread: float,
    number: float,
) -> Iterator[_Route]:
    """Round one corner into the shadow (Keller's coefficient of a half-plane)."""
    for route in _bounce(streets, flat, corner, lambda d, e: 1 / np.sqrt(d * e * (d + e))):
        hidden = shadow[route.users]
        users = route.users[hidden]
        if not len(users):
            continue
        onward = flat[users] - corner
        onward /= np.maximum(np.linalg.norm(onward, axis=1, keepdims=True), 1e-9)
        # The angle by which a ray is bent into the shadow.
        bend = np.arccos(np.clip((onward * route.towards[hidden]).sum(1), -1, 1))
        keller = 1 / (2 * np.sqrt(2 * np.pi * number)) / np.sin(np.maximum(bend, LEAST_BEND) / 2)
        gain = spread * keller * route.gain[hidden] * np.exp(-0.25j * np.pi)
        yield _Route(users, route.length[hidden], route.towards[hidden], gain)
