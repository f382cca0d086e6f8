"""What a field found from above, beside what is known: mirror planes, boxes, walls."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Polygon, Rectangle

from gsparc.data.schema import Measurements
from gsparc.data.site_objects import SiteObjects
from gsparc.data.walls import SceneWalls
from gsparc.pictures.drawing import PALETTE, save
from gsparc.pictures.from_above import (
    draw_stations,
    frame_of,
    legend_below,
    map_panels,
    set_bounds,
)
from gsparc.pictures.site_plan import static_positions

UPRIGHT = 0.3  # vertical part of a unit normal, below which a plane is drawn as a wall


AROUND, MARGIN = 0.5, 0.06  # of the extent of the places, drawn around them with walls and without
FARTHEST = 4.0  # extents of the places, at which a wall is on the map


def draw_site_objects(
    data: Measurements, objects: SiteObjects, path: Path, known: SceneWalls | None = None
) -> None:
    """Save a map of mirror planes and boxes over the measured places as PNG.

    `objects` are in local coordinates, `known` walls and boxes in those of the measurements.
    """
    origin = data.site.origin
    places = np.unique(data.moving[:, -3:], axis=0) + origin
    ends = static_positions(data)
    points = np.concatenate([places[:, :2], ends])
    # Walls that stand apart from all places are on the map, too;
    # those far away would make it a dot.
    middle, extent = points.mean(0), np.linalg.norm(np.ptp(points, axis=0))
    feet = np.array([foot for _, foot in _upright(objects.planes, origin, middle)]).reshape(-1, 2)
    points = np.concatenate(
        [points, feet[np.linalg.norm(feet - middle, axis=1) <= FARTHEST * extent]]
    )
    low, high = frame_of(points, AROUND if len(objects.planes) else MARGIN)
    figure, ((axis,),), _ = map_panels([(low, high)])
    axis.scatter(*places[:, :2].T, s=3, c="0.75", linewidths=0, label="measured places")
    if known is not None:
        _draw_known(axis, known, float(np.median(places[:, 2])))
    for number, box in enumerate(objects.boxes + origin):
        label = f"boxes found ({len(objects.boxes)})" if not number else None
        axis.add_patch(
            Rectangle(
                box[0, :2],
                *(box[1] - box[0])[:2],
                fill=False,
                hatch="///",
                ec=PALETTE[0],
                label=label,
            )
        )
    level = _draw_planes(axis, objects.planes, origin, low, high)
    if len(ends):
        draw_stations(axis, ends, "ends that stand")
    set_bounds(axis, low, high)
    legend_below(figure)
    title = f"{data.site.name}: what the field found"
    figure.suptitle(title if not level else f"{title}\n{level}", fontsize="medium")
    save(figure, path)


def _draw_planes(
    axis: Any, planes: np.ndarray, origin: np.ndarray, low: np.ndarray, high: np.ndarray
) -> str:
    """Upright planes as lines; returns where the others are, in words."""
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low))
    label: str | None = "mirror planes found"
    for across, foot in _upright(planes, origin, middle):
        ends = foot + np.array([[-1.0], [1.0]]) * reach * np.array([-across[1], across[0]])
        axis.plot(*ends.T, "-", color="tab:red", lw=1.5, label=label)
        label = None
    # Between the two limits planes are neither wall nor floor: not drawn, not listed.
    lying = [n for n in range(len(planes)) if abs(planes[n, 2]) > 1 - UPRIGHT]
    heights = sorted((planes[n, 3] + planes[n, :3] @ origin) / planes[n, 2] for n in lying)
    heights_text = ", ".join(f"{height:.2f}" for height in heights)
    return f"horizontal planes at z = {heights_text} m" if heights_text else ""


def _upright(
    planes: np.ndarray, origin: np.ndarray, middle: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the direction (2,) across each upright plane, and its point nearest to `middle` (2,)
    [m].
    """
    for normal, offset in zip(planes[:, :3], planes[:, 3] + planes[:, :3] @ origin, strict=True):
        # .3 = sin 17.5 degrees from upright: a plane that leans more is no line from above.
        if abs(normal[2]) <= UPRIGHT:
            # On the plane n.x = d, n_z left out: the line n_xy.x = d is d / |n_xy| from the origin.
            flat = np.linalg.norm(normal[:2])
            across = normal[:2] / flat
            yield across, middle + (offset / flat - across @ middle) * across


def _draw_known(axis: Any, known: SceneWalls, height: float) -> None:
    """Known walls where they cut a height, and boxes."""
    label: str | None = "known walls"
    for face in known.faces:
        cut = _cut(face, height)
        if len(cut) >= 2:
            axis.plot(
                *cut[:2, :2].T, label=label, color="0.25", lw=3.0, alpha=0.5, solid_capstyle="butt"
            )
            label = None
    for number, box in enumerate(known.boxes):
        axis.add_patch(
            Polygon(
                [box[0, :2], (box[1, 0], box[0, 1]), box[1, :2], (box[0, 0], box[1, 1])],
                fc="0.8",
                ec="0.5",
                label=None if number else "known boxes",
                zorder=0,
            )
        )


def _cut(face: np.ndarray, height: float) -> np.ndarray:
    """Points (m, 3) where the edges of a polygon (C, 3) pass a height [m]."""
    start, end = face, np.roll(face, -1, axis=0)
    # Half-open on purpose: a corner exactly at the height is passed once, not by both its edges.
    passing = (start[:, 2] <= height) != (end[:, 2] <= height)
    start, end = start[passing], end[passing]
    share = (height - start[:, 2]) / (end[:, 2] - start[:, 2])
    return start + share[:, None] * (end - start)
