"""What is drawn, as plain arrays: points, lines, Gaussians, faces, pictures and marks in world metres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from matplotlib import colormaps

GREY = (170, 170, 170)  # of values that are not known
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
        """A frame in which places (n, 3) [m] are about `EXTENT` wide."""
        low, high = places.min(axis=0), places.max(axis=0)
        return cls((low + high) / 2, EXTENT / max(float((high - low).max()), 1e-3))

    def drawn(self, places: np.ndarray) -> np.ndarray:
        """World places (..., 3) [m] as float32 in drawn units; float64 until the middle is taken away."""
        return np.asarray((places - self.middle) * self.scale, np.float32)

    def world(self, drawn: np.ndarray) -> np.ndarray:
        """The inverse of `drawn`, float64."""
        return np.asarray(drawn, np.float64) / self.scale + self.middle


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
class Splats:
    """Gaussians of means (n, 3) [m], covariances (n, 3, 3) [m^2], colours (n, 3) uint8, opacities (n,)."""

    name: str
    means: np.ndarray
    covariances: np.ndarray
    colours: np.ndarray
    opacities: np.ndarray


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


Part = Points | Lines | Splats | Faces | Sheet | Mark


@dataclass(frozen=True)
class Legend:
    """What colours mean: from `low` to `high` of `label`, in a matplotlib colour map."""

    label: str
    low: float
    high: float
    colours: str = "viridis"

    def of(self, values: np.ndarray) -> np.ndarray:
        """Colours (..., 3) uint8 of values (...); grey where they are not finite."""
        with np.errstate(invalid="ignore"):
            share = np.clip((values - self.low) / max(self.high - self.low, 1e-30), 0, 1)
        known = np.isfinite(values)
        found = np.round(255 * colormaps[self.colours](np.where(known, share, 0.0))[..., :3]).astype(np.uint8)
        found[~known] = GREY
        return found

    @classmethod
    def over(cls, label: str, values: np.ndarray, colours: str = "viridis") -> Legend:
        """From the 1 to the 99 % quantile of those values that are finite."""
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 1.0)
        return cls(label, float(low), float(high if high > low else low + 1.0), colours)

    def strip(self) -> np.ndarray:
        """Colours (16, 3) uint8 from low to high."""
        return self.of(np.linspace(self.low, self.high, 16))


@dataclass(frozen=True)
class Scene:
    """Everything that stands still.

    Attributes:
        title: of pages and pictures.
        frame: of drawing.
        parts: what is drawn.
        ground: height of a grid beneath all [m].
        legends: of parts, by their names.
        hidden: names of parts that are drawn when asked for.
        notes: what a reader must know, one line each.
    """

    title: str
    frame: Frame
    parts: tuple[Part, ...]
    ground: float
    legends: dict[str, Legend] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def part(self, name: str) -> Part | None:
        """The part of that name, if it is there."""
        return next((part for part in self.parts if part.name == name), None)
