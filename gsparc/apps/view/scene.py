"""What is drawn, as plain arrays: points, lines, faces, pictures and marks in world metres."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gsparc.apps.maps.layers import Legend

THICKNESS = 1.5  # of lines [pixels]
STATION = (40, 40, 40)
# Of a site in drawn units: near and far planes, controls and camera are then alike everywhere
EXTENT = 10.0


@dataclass(frozen=True)
class DrawingFrame:
    """Between world metres and drawn units.

    Attributes:
        middle: (3,) float64 world [m], drawn at the origin.
        scale: drawn units per metre.
    """

    middle: np.ndarray
    scale: float

    @classmethod
    def around(cls, places: np.ndarray) -> DrawingFrame:
        """Return a frame in which places (n, 3) [m] are about `EXTENT` wide."""
        low, high = places.min(axis=0), places.max(axis=0)
        # 1 mm: a single place has a frame, too.
        return cls((low + high) / 2, EXTENT / max(float((high - low).max()), 1e-3))

    def to_drawn(self, places: np.ndarray) -> np.ndarray:
        """Return world places (..., 3) [m] as float32 in drawn units.

        Float64 until the middle is taken away.
        """
        # Float32 of UTM metres moves in steps of half a metre.
        return np.asarray((places - self.middle) * self.scale, np.float32)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Return the inverse of `drawn`, float64."""
        return np.asarray(points, np.float64) / self.scale + self.middle


@dataclass(frozen=True)
class Points:
    """Dots at (n, 3) [m] in colours (n, 3) uint8, `size` metres wide."""

    name: str
    places: np.ndarray
    colours: np.ndarray
    size: float

    def draw(self, api: Any, frame: DrawingFrame) -> Any:
        """Add it to a scene of viser under its name, in place of what had it;
        returns viser's handle.
        """
        return api.add_point_cloud(
            node_path(self.name),
            frame.to_drawn(self.places),
            self.colours,
            point_shape="circle",
            point_size=self.size * frame.scale,
            precision="float32",
            point_shading="flat",
        )


@dataclass(frozen=True)
class Lines:
    """Segments (n, 2, 3) [m] in colours (n, 3) uint8."""

    name: str
    segments: np.ndarray
    colours: np.ndarray

    def draw(self, api: Any, frame: DrawingFrame) -> Any:
        """See `Points.draw`."""
        places, colours = frame.to_drawn(self.segments), np.repeat(self.colours[:, None], 2, axis=1)
        return api.add_line_segments(
            node_path(self.name), places, colours, thickness=THICKNESS, thickness_units="screen"
        )


@dataclass(frozen=True)
class Faces:
    """Triangles (f, 3, 3) [m], in one colour."""

    name: str
    triangles: np.ndarray
    colour: tuple[int, int, int]
    opacity: float

    def draw(self, api: Any, frame: DrawingFrame) -> Any:
        """See `Points.draw`."""
        corners = frame.to_drawn(self.triangles).reshape(-1, 3)
        return api.add_mesh_simple(
            node_path(self.name),
            corners,
            np.arange(len(corners)).reshape(-1, 3),
            color=self.colour,
            opacity=self.opacity,
            side="double",
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
        )


@dataclass(frozen=True)
class PlacedPicture:
    """A picture (h, w, 3 or 4) uint8 that lies in space: its upper left corner,
    its upper and its left edge.

    Attributes:
        corner, right, down: (3,) [m], world.
    """

    name: str
    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    image: np.ndarray

    def draw(self, api: Any, frame: DrawingFrame) -> Any:
        """See `Points.draw`."""
        wide, tall = np.linalg.norm(self.right), np.linalg.norm(self.down)
        # A picture's columns run along x of its node, its rows along y.
        x, y = self.right / wide, self.down / tall
        turn = Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)])).as_quat(
            scalar_first=True
        )
        return api.add_image(
            node_path(self.name),
            self.image,
            float(wide * frame.scale),
            float(tall * frame.scale),
            cast_shadow=False,
            receive_shadow=False,
            wxyz=turn,
            position=frame.to_drawn(self.corner + (self.right + self.down) / 2),
        )


@dataclass(frozen=True)
class Mark:
    """A named place (3,) [m]."""

    name: str
    place: np.ndarray
    text: str

    def draw(self, api: Any, frame: DrawingFrame) -> Any:
        """See `Points.draw`."""
        name, where = node_path(self.name), frame.to_drawn(self.place)
        ball = api.add_icosphere(name, radius=0.012 * EXTENT, color=STATION, position=where)
        if self.text:
            api.add_label(
                f"{name}/name", self.text, position=(0, 0, 0.02 * EXTENT), anchor="bottom-center"
            )
        return ball


def node_path(name: str) -> str:
    """Return the path of a node, its name without what separates nodes."""
    return "/" + name.replace("/", " ")


Part = Points | Lines | Faces | PlacedPicture | Mark


@dataclass(frozen=True)
class DrawnScene:
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
    frame: DrawingFrame
    parts: tuple[Part, ...]
    ground: float
    legends: dict[str, Legend] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def part(self, name: str) -> Part | None:
        """Return the part of that name, if it is there."""
        return next((part for part in self.parts if part.name == name), None)
