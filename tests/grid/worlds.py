"""Small measured worlds of every kind: a shoebox with clutter and noise,
as arrays of the documented schema.

Nothing of gsparc is used, so that a mistake of ours is not in both.
"""

import itertools
import zlib
from collections.abc import Iterator
from dataclasses import astuple, dataclass

import numpy as np

LIGHT = 299_792_458.0
CARRIER = 920e6
ROOM = np.array([7.0, 5.0, 3.0])  # [m]
UTM = np.array([500_000.0, 5_400_000.0, 0.0])
DEGREES = np.array([48.7, 9.1])  # of the room's corner
SHAPE = (12, 36)  # directions of a spectrum
NOISE = 0.1  # of the mean power of channels
LEVELS_DB = 1.5  # noise of powers [dB]
SPECKLE = 0.02  # noise of spectra

CHOICES = {
    "kind": ("array", "moving_array", "image", "tone", "tones", "antennas", "power"),
    "runs": (1, 5),
    "stations": (1, 4),
    "moving": ("rx", "tx", "both"),
    "frame": ("metres", "utm", "degrees"),
    "missing": ("none", "silent", "masked"),
    "split": ("random", "blocks", "runs"),
    "rows": (30, 300, 3000),
}


@dataclass(frozen=True)
class World:
    """One combination of properties.

    Attributes:
        kind: `array`, spectra of a static array; `moving_array`; `image`, spectra without an array;
            `tone`, `tones` (30) and `antennas` (4), channels; `power`.
        runs: how many; channels of each have a phase of their own.
        stations: how many static ends.
        moving: which end moves.
        frame: of places: metres about 0, UTM metres, or degrees.
        missing: a tenth of the rows is below what is heard (`silent`) or was not measured
            (`masked`).
        split: what is held out.
        rows: places.
    """

    kind: str
    runs: int
    stations: int
    moving: str
    frame: str
    missing: str
    split: str
    rows: int

    @property
    def name(self) -> str:
        """Of a test, and of a file."""
        return "-".join(str(value) for value in astuple(self))

    @property
    def possible(self) -> bool:
        """Whether there can be such measurements."""
        if (self.split == "runs" and self.runs == 1) or (
            self.moving == "both" and self.stations > 1
        ):
            return False
        if self.moving == "both" and self.frame == "degrees":  # such files have no degrees
            return False
        return {"array": self.moving == "tx", "moving_array": self.moving == "rx"}.get(
            self.kind, True
        )


def every(rows: tuple[int, ...] = CHOICES["rows"]) -> list[World]:
    """All that are possible, of some numbers of rows."""
    return [
        w
        for c in itertools.product(*CHOICES.values())
        if (w := World(*c)).possible and w.rows in rows
    ]


def covering(worlds: list[World], seed: int = 0) -> list[World]:
    """A small set in which every pair of values of two properties meets that meets
    in any of `worlds`.
    """
    order = np.random.default_rng(seed).permutation(len(worlds))
    pairs = [possible_pairs([worlds[i]]) for i in order]
    missing, chosen = set().union(*pairs), []
    while missing:
        best = int(np.argmax([len(own & missing) for own in pairs]))
        missing -= pairs[best]
        chosen.append(worlds[order[best]])
    return chosen


def possible_pairs(worlds: list[World]) -> set[tuple[tuple[int, object], ...]]:
    """Pairs of values of two properties that meet in any of them."""
    return {
        pair for world in worlds for pair in itertools.combinations(enumerate(astuple(world)), 2)
    }


def drawn(worlds: list[World], count: int, seed: int) -> Iterator[World]:
    """`count` of them, by a seed."""
    for number in np.random.default_rng(seed).permutation(len(worlds))[:count]:
        yield worlds[number]


def arrays(world: World, seed: int) -> dict[str, np.ndarray]:
    """The measurements of a world as arrays of the schema in docs/reference/schema.md."""
    rng = np.random.default_rng([seed, zlib.crc32(world.name.encode())])
    count = world.stations
    fixed = np.c_[rng.uniform(0.3, 0.7, count) * ROOM[0], [0.2] * count, [2.6] * count]
    fixed[:, 0] += np.arange(count) - (count - 1) / 2
    place, run = _walk(world, rng)
    other = fixed[:, None]
    if world.moving == "both":
        other = _walk(world, rng)[0] * [1, 1, 0.5] + [0, 0, 1.5]
    other = np.broadcast_to(other, (count, world.rows, 3))
    walls = _Room(rng)
    measured = np.stack([_measured(world, walls, place, other[t], rng) for t in range(count)], 1)
    if world.kind in ("tone", "tones", "antennas"):
        measured = measured * np.exp(2j * np.pi * rng.random(world.runs))[run][:, None, None, None]
    found = _values(world, measured, rng)
    found |= _places(world, place, fixed, other[0])
    if world.runs > 1:
        found["run"] = run
    return found


def _walk(world: World, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places (S, 3) [m] along lines through a part of the room, at least one for each run,
    and runs (S,).
    """
    side = {30: 1.0, 300: 1.5, 3000: 3.0}[world.rows]  # dense enough for channels to be related
    lines = max(world.runs, world.rows // 30)
    line = np.arange(world.rows) * lines // world.rows
    start, end = rng.uniform(0, side, (2, lines, 2))
    along = rng.random(world.rows)[:, None]
    flat = (1 - along) * start[line] + along * end[line] + [2.0, 1.5]
    height = rng.uniform(1.0, 1.3, lines)[line]
    return np.c_[flat, height], line % world.runs


class _Room:
    """Images of an end in the walls, and scatterers."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.scatterers = rng.uniform([0, 0, 0], ROOM, (6, 3))
        self.strength = rng.uniform(0.2, 0.6, 6)

    def channel(self, place: np.ndarray, end: np.ndarray, hertz: np.ndarray) -> np.ndarray:
        """(S, K) complex of ends (S, 3) and (S, 3)."""
        return sum(
            gain * np.exp(-2j * np.pi * hertz * far[:, None] / LIGHT) / far[:, None]
            for gain, far, _ in self.paths(place, end)
        )

    def paths(
        self, place: np.ndarray, end: np.ndarray
    ) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Gain, length (S,) [m], and the point (S, 3) that the receiver at `place` sees,
        of each path.
        """
        images = [(1.0, end)]
        for axis, wall in itertools.product(range(3), (0, 1)):
            mirrored = end.copy()
            mirrored[:, axis] = 2 * wall * ROOM[axis] - mirrored[:, axis]
            images.append((-0.6, mirrored))
        found = [(gain, np.linalg.norm(place - image, axis=1), image) for gain, image in images]
        for at, strength in zip(self.scatterers, self.strength, strict=True):
            far = np.linalg.norm(place - at, axis=1) + np.linalg.norm(end - at, axis=1)
            found.append((strength, far, np.broadcast_to(at, place.shape)))
        return found


def _measured(
    world: World, room: _Room, place: np.ndarray, other: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(S, ...) of one static end, before noise is drawn for what is measured in decibels."""
    rx, tx = (other, place) if world.moving == "tx" else (place, other)
    if world.kind == "image":
        return _image(room, rx, tx, rng)
    if world.kind == "power":
        hertz = CARRIER + np.linspace(-20e6, 20e6, 8)
        return (abs(room.channel(rx, tx, hertz)) ** 2).mean(1)
    hertz = _tones(world)
    elements = _elements(world)
    h = np.stack([room.channel(rx + element, tx, hertz) for element in elements], 1)  # (S, A, K)
    noise = rng.standard_normal((*h.shape, 2)) @ [1, 1j]
    h = h + np.sqrt(NOISE * (abs(h) ** 2).mean() / 2) * noise
    if world.kind in ("tone", "tones", "antennas"):
        return h
    steering = np.exp(2j * np.pi * CARRIER / LIGHT * _directions() @ elements.T)  # (D, A)
    image = abs(h[:, :, 0] @ steering.conj().T)
    return (image / image.max(1, keepdims=True)).reshape(-1, *SHAPE)


def _tones(world: World) -> np.ndarray:
    """(K,) [Hz]"""
    return CARRIER + (np.linspace(-10e6, 10e6, 30) if world.kind == "tones" else np.zeros(1))


def _elements(world: World) -> np.ndarray:
    """(A, 3) [m]"""
    half = LIGHT / CARRIER / 2
    if world.kind == "antennas":
        return np.c_[np.arange(4) * half, np.zeros((4, 2))]
    if world.kind in ("array", "moving_array"):
        return np.array([[i * half, j * half, 0.0] for i in range(3) for j in range(3)])
    return np.zeros((1, 3))


def _directions() -> np.ndarray:
    """Unit vectors (D, 3), rows of elevation 0 to 90 degrees first."""
    elevation, azimuth = np.meshgrid(
        np.arange(SHAPE[0]) * np.pi / 2 / SHAPE[0],
        np.arange(SHAPE[1]) * 2 * np.pi / SHAPE[1],
        indexing="ij",
    )
    flat = np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1
    ).reshape(-1, 3)


def _image(room: _Room, rx: np.ndarray, tx: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Power by direction of arrival, each path a blob."""
    total = np.zeros((len(rx), len(_directions())))
    for gain, far, seen in room.paths(rx, tx):
        towards = (seen - rx) / np.linalg.norm(seen - rx, axis=1, keepdims=True)
        total += (gain / far[:, None]) ** 2 * np.exp(30 * (towards @ _directions().T - 1))
    total = total / total.max(1, keepdims=True)
    return np.clip(total + SPECKLE * rng.standard_normal(total.shape), 0, 1).reshape(-1, *SHAPE)


def _values(world: World, measured: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The measured arrays, by the names of the schema; (S, T, ...) where there are stations."""
    gone = rng.random(world.rows) < (0.1 if world.missing != "none" else 0.0)
    found: dict[str, np.ndarray] = {}
    if world.kind == "power":
        level = 10 * np.log10(measured) + LEVELS_DB * rng.standard_normal(measured.shape)
        name, value = "rssi_db", level - 60
        if world.missing == "silent":
            heard = np.quantile(value, 0.1)
            found["sensitivity_db"] = np.array(heard)
            value = np.where(value < heard, np.nan, value)
        elif world.missing == "masked":
            value[gone] = np.nan
    else:
        name = "csi" if world.kind in ("tone", "tones", "antennas") else "spectrum"
        value = measured.astype(np.complex64 if name == "csi" else np.float32)
        if world.missing == "silent":
            value[gone] = 0
        elif world.missing == "masked":
            found["mask"] = np.broadcast_to(
                ~gone.reshape(-1, *[1] * (value.ndim - 1)), value.shape
            ).copy()
    if world.stations == 1:
        value = value[:, 0]
        if "mask" in found:
            found["mask"] = found["mask"][:, 0]
    if name == "csi":
        found["frequency_hz"] = _tones(world)
    else:
        found["carrier_hz"] = np.array(CARRIER)
    if len(_elements(world)) > 1:
        found["array_position"] = _elements(world)
    if name == "spectrum":
        found["attributes"] = np.array('{"normalisation": "max"}')
    return {**found, name: value}


def _places(
    world: World, place: np.ndarray, fixed: np.ndarray, other: np.ndarray
) -> dict[str, np.ndarray]:
    """Positions in the frame of the world."""
    still = "tx" if world.moving == "rx" else "rx"
    if world.frame == "degrees":
        latitude, longitude = _degrees(place)
        stations = dict(
            zip(("station_latitude", "station_longitude"), _degrees(fixed), strict=True)
        )
        heights = {f"{world.moving}_height": place[:, 2], "station_height": fixed[:, 2]}
        return {"latitude": latitude, "longitude": longitude, **stations, **heights}
    origin = UTM if world.frame == "utm" else np.zeros(3)
    if world.moving == "both":
        return {"rx_position": place + origin, "tx_position": other + origin}
    found = {f"{world.moving}_position": place + origin}
    if world.stations > 1:
        return {**found, "station_position": fixed + origin}
    return {**found, f"{still}_position": fixed[0] + origin}


def _degrees(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude of metres east and north of the corner,
    on a sphere as large as the Earth.
    """
    metre = 360 / 40_030_000
    return DEGREES[0] + place[:, 1] * metre, DEGREES[1] + place[:, 0] * metre / np.cos(
        np.radians(DEGREES[0])
    )
