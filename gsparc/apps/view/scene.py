"""What is drawn, as plain arrays: points, lines, faces, pictures and marks in world metres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsparc.apps.maps.pictures import Legend

EXTENT = 10.0  # of a site in drawn units: near and far planes, controls and camera are then alike everywhere


@dataclass(frozen=True)
class Frame:
    """Between world metres and drawn units.

    Attributes:
        middle: (3,) float64 world [m], drawn at the origin.
        scale: drawn units per metre.
    """

    middle: np.ndarray
    scale: float

    @classmethod
    def around(cls, places: np.ndarray) -> Frame:
        """Return a frame in which places (n, 3) [m] are about `EXTENT` wide."""
        low, high = places.min(axis=0), places.max(axis=0)
        # 1 mm: a single place has a frame, too.
        return cls((low + high) / 2, EXTENT / max(float((high - low).max()), 1e-3))

    def drawn(self, places: np.ndarray) -> np.ndarray:
        """World places (..., 3) [m] as float32 in drawn units; float64 until the middle is taken away."""
        # Float32 of UTM metres moves in steps of half a metre.
        return np.asarray((places - self.middle) * self.scale, np.float32)

    def world(self, points: np.ndarray) -> np.ndarray:
        """Return the inverse of `drawn`, float64."""
        return np.asarray(points, np.float64) / self.scale + self.middle


@dataclass(frozen=True)
class Points:
    """Dots at (n, 3) [m] in colours (n, 3) uint8, `size` metres wide."""

    name: str
    places: np.ndarray
    colours: np.ndarray
    size: float


@dataclass(frozen=True)
class Lines:
    """Segments (n, 2, 3) [m] in colours (n, 3) uint8."""

    name: str
    segments: np.ndarray
    colours: np.ndarray


@dataclass(frozen=True)
class Faces:
    """Triangles (f, 3) between vertices (v, 3) [m], in one colour."""

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    colour: tuple[int, int, int]
    opacity: float


@dataclass(frozen=True)
class Sheet:
    """A picture (h, w, 3 or 4) uint8 that lies in space: its upper left corner, its upper and its left edge.

    Attributes:
        corner, right, down: (3,) [m], world.
    """

    name: str
    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    image: np.ndarray


@dataclass(frozen=True)
class Mark:
    """A named place (3,) [m]."""

    name: str
    place: np.ndarray
    text: str


Part = Points | Lines | Faces | Sheet | Mark


@dataclass(frozen=True)
class Scene:
    """Everything that stands still.

    Attributes:
        title: of pages and pictures.
        frame: of drawing.
        parts: what is drawn.
        ground: height of a grid beneath all [m].
        legends: of parts, by their names.
        notes: what a reader must know, one line each.
    """

    title: str
    frame: Frame
    parts: tuple[Part, ...]
    ground: float
    legends: dict[str, Legend] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def part(self, name: str) -> Part | None:
        """Return the part of that name, if it is there."""
        return next((part for part in self.parts if part.name == name), None)
