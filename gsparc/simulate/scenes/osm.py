"""A piece of OpenStreetMap as a scene: buildings extruded by height or levels, ground,
materials by tag.

The format: an extract *.osm in OSM XML, read by `osmnx` without a network. Tags:
wiki.openstreetmap.org, `Key:building`, `Key:height`, `Key:building:levels`,
`Key:building:material`.
"""

from __future__ import annotations

import importlib.util
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.georeference import Georeference, find_invalid_coordinate
from gsparc.simulate.scenes.solid import LISTED_MATERIALS, Solid, sheet

LEVEL_M = 3.0  # of a storey
USUAL_LEVELS = 3  # of a building that says neither height nor levels
TALLEST_M = 1000.0
MARGIN_M = 50.0  # of ground around everything
GROUND = "ground"
# Materials of ITU-R P.2040 by words of building:material, facade and wall tags.
MATERIALS = {word: row["material"] for row in LISTED_MATERIALS for word in row["words"].split()}
TAGS = ("building:material", "building:facade:material", "facade:material", "wall")
WALKED = ("motorway", "motorway_link", "construction", "proposed")  # highways that nobody stands on
FEET_M = 0.3048
NEEDED = ("osmnx", "trimesh", "mapbox_earcut")
LARGEST_M = 20_000.0  # of an extract


@dataclass(frozen=True)
class Town:
    """What an extract holds, in metres east and north of its origin.

    Attributes:
        solids: the ground and one object per material.
        streets: (n, 2) [m] each.
        box: (2, 2) lower and upper corner of the buildings [m].
        georeference: of the origin.
        notes: what was guessed or left out, one line each.
    """

    solids: list[Solid]
    streets: list[np.ndarray]
    box: np.ndarray
    georeference: Georeference
    notes: tuple[str, ...]


def read_town(path: str | Path, carrier_hz: float) -> Town:
    """Read buildings and streets of an extract.

    The ground's model is of 1 to 10 GHz; at other carriers [Hz] it is of concrete.

    Raises:
        ValueError: no such file, not OSM's XML, or no building in it.
    """
    path = Path(path)
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f"scene=osm needs {', '.join(missing)}; pip install 'gsparc[scenes]'")
    import trimesh

    features = _features(path)
    shapes = [
        (shape, tags)
        for geometry, tags in features
        if _tag(tags, "building") not in (None, "no") and (_tag(tags, "location") != "underground")
        for shape in _polygons(geometry)
    ]
    if not shapes:
        raise ValueError(
            f"scene.file={path}: no building in it; expected ways or relations with building=*"
        )
    degrees = np.concatenate([np.array(shape.exterior.coords)[:, :2] for shape, _ in shapes])
    fault = find_invalid_coordinate(degrees[:, 1], degrees[:, 0])
    if fault is not None:
        raise ValueError(f"scene.file={path}: {fault[1]}")
    origin = Georeference.from_coordinates(degrees[:, 1], degrees[:, 0])
    guesses: Counter[str] = Counter()
    meshes: dict[str, list[Any]] = {}
    for shape, tags in shapes:
        low, high = _heights(tags, guesses)
        mesh = _extruded(shape, low, high, origin)
        if mesh is None:
            guesses["footprints that cannot be are left out"] += 1
        else:
            meshes.setdefault(_material(tags, guesses), []).append(mesh)
    if not meshes:
        raise ValueError(f"scene.file={path}: none of {len(shapes)} footprints can be a building")
    solids = []
    for material, parts in sorted(meshes.items()):
        whole: Any = trimesh.util.concatenate(parts)
        solids.append(
            Solid(
                f"buildings_{material}", material, np.array(whole.vertices), np.array(whole.faces)
            )
        )
    corners = np.concatenate([solid.vertices[:, :2] for solid in solids])
    box = np.stack([corners.min(0), corners.max(0)])
    if np.ptp(box, axis=0).max() > LARGEST_M:
        raise ValueError(
            f"scene.file={path}: buildings over {np.ptp(box, axis=0).max() / 1e3:.0f} km; cut it"
        )
    soil = "medium_dry_ground" if 1e9 <= carrier_hz <= 10e9 else "concrete"
    count = len(shapes)
    notes = (
        f"{count} buildings about {origin.latitude:g}, {origin.longitude:g} degrees",
        *(f"{number} of {count} buildings: {guess}" for guess, number in sorted(guesses.items())),
    )
    streets = [line for geometry, tags in features for line in _streets(geometry, tags, origin)]
    (x0, y0), (x1, y1) = box + np.array([[-MARGIN_M], [MARGIN_M]])
    ground = sheet(GROUND, soil, (x0, y0, 0), (x1 - x0, 0, 0), (0, y1 - y0, 0))
    return Town([ground, *solids], streets, box, origin, notes)


def _features(path: Path) -> list[tuple[Any, Mapping[str, Any]]]:
    """Geometry [deg] and tags of everything that is a building or a street."""
    if not path.is_file():
        raise ValueError(
            f"scene.file={path}: no such file; expected an extract of OpenStreetMap, *.osm"
        )
    import osmnx

    try:
        table = osmnx.features_from_xml(path, tags={"building": True, "highway": True})
    except Exception as error:  # of XML, of osmnx, of shapely
        words = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(
            f"scene.file={path}: not an extract in OSM's XML ({words[:120]})"
        ) from None
    columns = [name for name in table.columns if name != "geometry"]
    rows = table[columns].to_dict("records")
    return list(zip(table.geometry, rows, strict=True))


def _tag(tags: Mapping[str, Any], name: str) -> str | None:
    """A tag in lower case; None where it is absent (or NaN, in a table)."""
    value = tags.get(name)
    return value.strip().lower() if isinstance(value, str) and value.strip() else None


def _polygons(geometry: Any) -> list[Any]:
    if geometry is None or geometry.is_empty:
        return []
    if geometry.geom_type == "Polygon":
        return [geometry]
    return list(geometry.geoms) if geometry.geom_type == "MultiPolygon" else []


def _metres(text: str | None) -> float | None:
    """A length as OSM writes it: `12`, `12.5 m`, `40 ft`, `40'`; None where it is none."""
    match = re.fullmatch(r"(\d+(?:[.,]\d+)?)\s*(m|metres?|meters?|ft|feet|')?", text or "")
    if not match:
        return None
    return float(match[1].replace(",", ".")) * (FEET_M if match[2] in ("ft", "feet", "'") else 1.0)


def _heights(tags: Mapping[str, Any], guesses: Counter[str]) -> tuple[float, float]:
    """Lowest and highest z [m] of a building."""
    low = _metres(_tag(tags, "min_height"))
    levels = _metres(_tag(tags, "building:levels"))
    high = _metres(_tag(tags, "height")) or _metres(_tag(tags, "building:height"))
    if low is None:
        low = (_metres(_tag(tags, "building:min_level")) or 0.0) * LEVEL_M
    if high is None and levels:
        guesses[f"height from levels of {LEVEL_M:g} m"] += 1
        high = (levels + (_metres(_tag(tags, "roof:levels")) or 0.0)) * LEVEL_M
    if high is None or not low < high <= TALLEST_M:
        guesses[f"no height that can be: {USUAL_LEVELS * LEVEL_M:g} m taken"] += 1
        low, high = 0.0, USUAL_LEVELS * LEVEL_M
    return low, high


def _material(tags: Mapping[str, Any], guesses: Counter[str]) -> str:
    for name in TAGS:
        word = _tag(tags, name)
        if word in MATERIALS:
            return MATERIALS[word]
    guesses["no material: concrete taken"] += 1
    return "concrete"


def _extruded(shape: Any, low: float, high: float, origin: Georeference) -> Any:
    """A closed mesh of a footprint [deg]; None where it has no area."""
    import shapely
    import trimesh

    def metres(corners: np.ndarray) -> np.ndarray:
        return origin.from_degrees(corners[:, 1], corners[:, 0])

    flat = shapely.make_valid(shapely.transform(shapely.force_2d(shape), metres))
    # Below a square metre: slivers that repairing a footprint leaves.
    parts = [p for p in _polygons(flat) if p.area > 1.0]
    if not parts:
        return None
    meshes = [trimesh.creation.extrude_polygon(p, high - low, engine="earcut") for p in parts]
    mesh = trimesh.util.concatenate(meshes)
    # Extruded from 0: what begins above the ground is lifted there.
    mesh.apply_translation([0, 0, low])
    return mesh


def _streets(geometry: Any, tags: Mapping[str, Any], origin: Georeference) -> list[np.ndarray]:
    kind = _tag(tags, "highway")
    if (
        kind in (None, *WALKED)
        or _tag(tags, "tunnel") == "yes"
        or geometry.geom_type != "LineString"
    ):
        return []
    corners = np.array(geometry.coords)
    return [origin.from_degrees(corners[:, 1], corners[:, 0])]
