"""Known walls and boxes of a scene out of a YAML file, that of a simulated room too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError, Problems
from gsparc.base.files import read_yaml
from gsparc.base.instantiate import from_settings, suggest_or_list
from gsparc.base.limits import Checked, Limit, finite_array, or_null, setting

EXPECTED = "`walls` (a list of `corners_m`) or `room` (`size_m`, `boxes_m`)"
SIMULATED = {  # of scenes that are simulated: known, and not needed here
    "name",
    "transmitter_m",
    "area_m",
    "height_m",
    "num_receivers",
    "carrier_hz",
    "bandwidth_hz",
    "subcarriers",
    "test_share",
    "builder",
    "builtin",
    "xml",
    "open_sky",
    "scattering",
    "seed",
    "file",
    "transmitters",
    "receivers",
    "over",
    "moved",
}
FLAT_M = 0.01  # [m], of corners from their plane
SMALLEST_M2 = 1e-6  # [m^2], of faces that are read


@dataclass(frozen=True)
class SceneWalls:
    """What stands in a scene, in the coordinates of the measurements.

    Attributes:
        faces: flat polygons, each (C, 3) float64 [m] of at least 3 corners in order.
        boxes: (B, 2, 3) float64 [m], lower and upper corners of solids that let nothing through.
    """

    faces: tuple[np.ndarray, ...]
    boxes: np.ndarray

    def __len__(self) -> int:
        return len(self.faces) + len(self.boxes)


def _are_boxes(value: Any) -> bool:
    corners = finite_array(value)
    return corners.shape[1:] == (2, 3) and bool((corners[:, 0] < corners[:, 1]).all())


SIZE = Limit("a list of three lengths above 0 [m]", lambda value: _are_boxes([[[0, 0, 0], value]]))
BOXES = Limit(
    "a list of [[x, y, z], [x, y, z]], lower corner first [m],", lambda v: not v or _are_boxes(v)
)


@dataclass(frozen=True)
class RoomSettings(Checked):
    """A room from the origin, and boxes in it.

    Attributes:
        size_m: (3,) [m]; None: its walls are unknown.
        boxes_m: lower and upper corner of each [m].
        reflection: amplitude coefficient of all walls or of each, for a simulation.
    """

    size_m: Sequence[float] | None = setting(None, or_null(SIZE))
    boxes_m: Sequence[Any] | None = setting(None, BOXES)
    reflection: complex | Sequence[complex] = -0.7

    @property
    def boxes(self) -> np.ndarray:
        """(B, 2, 3) [m]."""
        return finite_array(self.boxes_m or []).reshape(-1, 2, 3)


def read_walls(path: str | Path | None) -> SceneWalls:
    """Read walls out of `*.yaml` or `*.yml`; lengths are metres.

    Raises:
        DataError: none is named, no such file, of another kind, or with walls that cannot be.
    """
    if path is None:
        raise DataError(f"init.file is missing; expected a file of {EXPECTED}")
    path, problems = Path(path), Problems(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        meshes = "write a mesh's faces as `walls`: corners_m of each"
        raise DataError(f"{path}: walls are read from *.yaml; {meshes}")
    walls = _table(path, problems)
    if not problems and not len(walls):
        problems.add(path, f"no walls in it; expected {EXPECTED}")
    problems.raise_if_any()
    return walls


def _table(path: Path, problems: Problems) -> SceneWalls:
    content = read_yaml(path, f"a table of {EXPECTED}", f"a table of {EXPECTED}")
    for key in content:
        if key not in SIMULATED | {"walls", "room"}:
            problems.add(path, f"{key}: no such key{suggest_or_list(str(key), ['walls', 'room'])}")
    settings = {} if content.get("room") is None else content["room"]
    if not isinstance(settings, dict):
        settings = problems.add(path, "room: expected size_m and boxes_m") or {}
    room = (
        problems.attempt(lambda: from_settings(RoomSettings, settings, f"{path}: room"))
        or RoomSettings()
    )
    faces = [] if room.size_m is None else box_faces(np.zeros(3), finite_array(room.size_m))
    walls = content.get("walls") or []
    if not isinstance(walls, list):
        problems.add(path, "walls: expected a list, each with corners_m: [[x, y, z], ...]")
        walls = []
    for number, wall in enumerate(walls):
        where = f"{path}: walls[{number}]"
        corners = finite_array(wall.get("corners_m") if isinstance(wall, dict) else wall)
        if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3:
            problems.add(where, "expected corners_m: [[x, y, z], ...] of at least 3 corners [m]")
        # Corners on a line span no plane, and their normal would be rounding.
        elif polygon_area(corners) < SMALLEST_M2:
            problems.add(where, "its corners lie on a line")
        elif (off := distance_from_plane(corners)) > FLAT_M:
            problems.add(where, f"its corners lie up to {off:.2g} m off a plane; split it")
        else:
            faces.append(corners)
    return SceneWalls(tuple(faces), room.boxes)


def box_faces(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Return the six faces, each (4, 3), of a box between two corners (3,)."""
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for end in (low, high):
            face = np.tile(np.asarray(low, np.float64), (4, 1))
            face[:, axis] = end[axis]
            face[1:3, u], face[2:4, v] = high[u], high[v]
            faces.append(face)
    return faces


def polygon_normal(corners: np.ndarray) -> np.ndarray:
    """Return the normal (3,) of a polygon (C, 3), of length twice its area [m^2],
    by Newell's method.
    """
    # About the mean, as far from the origin the cross products would cancel each other.
    about = corners - corners.mean(0)
    return np.asarray(np.cross(about, np.roll(about, -1, axis=0)).sum(0))


def polygon_area(corners: np.ndarray) -> float:
    """Return the area of a polygon (C, 3) [m^2]."""
    return float(np.linalg.norm(polygon_normal(corners)) / 2)


def distance_from_plane(corners: np.ndarray) -> float:
    """Return the largest distance of corners (C, 3) from their plane [m]."""
    normal = polygon_normal(corners)
    return float(np.abs((corners - corners.mean(0)) @ (normal / np.linalg.norm(normal))).max())
