"""A site from above: where was measured, what looks wrong,
and what a field found beside what is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import cKDTree

from gsparc.data.outliers import find_outliers, too_far
from gsparc.data.schema import ENDS, Measurements
from gsparc.data.site_objects import SiteObjects
from gsparc.data.walls import SceneWalls
from gsparc.datasets.describe import (
    distinct_places,
    held_out_block_rows,
    propose_side,
    spacing_words,
)
from gsparc.physics.decibels import to_decibels
from gsparc.pictures.drawing import PALETTE, panels, save
from gsparc.pictures.from_above import (
    OUTLINE,
    annotate,
    draw_stations,
    draw_values,
    frame_of,
    legend_below,
    set_bounds,
)
from gsparc.tables.checks.level_steps import LevelStep
from gsparc.tables.checks.link_levels import LinkLevels
from gsparc.tables.checks.plausibility import find_outlier_rows

NAMED = 15  # stations; of more only their number is said
MOST_JUMPS = 4  # stations in the second column: those that change most
MOST_MARKS = 8  # suspicious places that are named
INCHES = 6.5  # longer side of the map


@dataclass(frozen=True)
class Spots:
    """Distinct places of the moving end.

    Attributes:
        place: (n, 2) world x and y [m].
        level_db: (n,) [dB], NaN where nothing was heard; None of spectra.
        label: what the level is.
        rows: (n,) what messages call the first row at each.
        far: (n,) bool, too far from all others to be drawn among them.
        suspicious: (n,) bool, rows of outliers and of levels far from those around.
    """

    place: np.ndarray
    level_db: np.ndarray | None
    label: str
    rows: list[str]
    far: np.ndarray
    suspicious: np.ndarray


def find_spots(data: Measurements, levels: LinkLevels | None) -> Spots:
    """Return places of the moving end, levels there and what looks wrong;
    of the receiver where both move.
    """
    site = data.site
    of_row = data.moving[:, -3:]
    # np.unique sorts by coordinate; `first` leads back to the order of measuring.
    place, first, which = np.unique(of_row, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # as measured: later ones are drawn above
    which = np.argsort(order)[which.reshape(-1)]
    place, count = place[order], len(place)
    far, suspicious = np.zeros((2, count), bool)
    far[which[too_far(data.moving)]] = True
    for rows in find_outliers(data).values():
        suspicious[which[rows]] = True
    if levels is not None:
        outliers = [rows for _, rows, _ in find_outlier_rows(levels)]
        wild = levels.position[np.concatenate([np.zeros(0, np.int64), *outliers])]
        suspicious[cKDTree(place + site.origin).query(wild)[1]] = True
    level, label = _levels(data, which, count)
    names = [data.row_names[i].partition(", station")[0] for i in first[order]]
    return Spots(place[:, :2] + site.origin[:2], level, label, names, far, suspicious)


def _levels(data: Measurements, which: np.ndarray, count: int) -> tuple[np.ndarray | None, str]:
    """Level (count,) [dB] at each place that rows `which` (S,) are of, and what it is."""
    several = data.site.several
    if data.site.target.is_image:
        return None, ""
    power = data.powers()
    heard = np.ones(power.shape, bool) if data.mask is None else data.mask.reshape(power.shape)
    heard = heard | (data.censored_side() < 0)[:, None]  # in saturation, too
    row, entry = np.nonzero(heard & (power > 0))
    in_decibels, value = data.site.target.is_level, power[row, entry]
    # Powers of channels are averaged linearly, levels of a station in decibels.
    value = to_decibels(value) if in_decibels else value
    each = [which[row], data.stations_of(row) if in_decibels else which[row]]
    level = (
        pd.Series(value)
        .groupby(each)
        .mean()
        .groupby(level=0)
        .max()
        .reindex(range(count))
        .to_numpy()
    )
    if in_decibels:
        of = " of the strongest station" if several else ""
        return level, f"received power{of} [{data.site.level_unit}]"
    with np.errstate(divide="ignore"):
        return to_decibels(level), "mean channel power" + (
            " of all stations" if several else ""
        ) + " [dB]"


def draw_site(
    data: Measurements,
    path: Path,
    levels: LinkLevels | None,
    steps: Sequence[tuple[int, LevelStep]] = (),
) -> None:
    """Save a map of places and stations as PNG and, beside it, the levels of stations that jump.

    `levels` are the `link_levels` of powers, `steps` their `level_steps.find_level_steps`.
    """
    places = find_spots(data, levels)
    points = [places.place[~places.far], static_positions(data)]  # but those far outside
    points += [data.ends[end][:, :2] + data.site.origin[:2] for end in data.site.moving_ends[:-1]]
    low, high = frame_of(np.concatenate(points))
    width, height = (high - low) / (high - low).max() * INCHES
    width, height = max(width, 0.45 * INCHES) + 1.9, max(height, 0.35 * INCHES) + 1.6
    jumping = sorted(
        {t for t, _ in steps}, key=lambda t: -max(abs(s.change_db) for u, s in steps if u == t)
    )
    jumping = jumping[:MOST_JUMPS]
    if not jumping or levels is None:
        figure, axes = panels(width, height)
        axis = axes[0, 0]
    else:
        how: dict[str, Any] = {"width_ratios": [width, 6.0]}
        figure, axes = panels(width + 6.0, max(height, 2.2 * len(jumping)), len(jumping), 2, **how)
        place = axes[0, 0].get_gridspec()[:, 0]
        for panel in axes[:, 0]:
            panel.remove()
        axis = figure.add_subplot(place)
        axis.grid(alpha=0.3)
        for panel, t in zip(axes[:, 1], jumping, strict=True):
            _draw_level(
                panel, levels, t, [step for u, step in steps if u == t], data.site.level_unit
            )
    _draw_map(axis, data, places, low, high, jumping)
    legend_below(figure, 4)
    figure.suptitle(_title(data, places))
    save(figure, path)


def _title(data: Measurements, places: Spots) -> str:
    stations, called = data.site.stations, data.site.target.called
    at = "" if stations is None else f", {len(stations)} station{'s' * (len(stations) > 1)}"
    spacing = spacing_words(distinct_places(data), data.site.carriers).partition(";")[0]
    return f"{data.site.name}: {len(data)} {called} at {len(places.place)} places{at}\n{spacing}"


def static_positions(data: Measurements) -> np.ndarray:
    """Return world x and y (T, 2) of the ends that stand still, where that is known."""
    place = data.site.every_station.position[:, :2] + data.site.origin[:2]
    return place if np.isfinite(place).any() else place[:0]


def _draw_map(
    axis: Any,
    data: Measurements,
    places: Spots,
    low: np.ndarray,
    high: np.ndarray,
    jumping: Sequence[int],
) -> None:
    site, inside = data.site, ~places.far
    size = _size(places.place[inside], float((high - low).max()))
    for end in site.moving_ends[:-1]:
        other = np.unique(data.ends[end][:, :2], axis=0) + site.origin[:2]
        axis.scatter(*other.T, s=10, c="0.55", marker="s", linewidths=0, label=ENDS[end])
    name = ENDS[site.moving_end]
    if places.level_db is None or not np.isfinite(places.level_db[inside]).any():
        axis.scatter(*places.place[inside].T, s=size, c=PALETTE[0], linewidths=0, label=name)
    else:
        heard = inside & np.isfinite(places.level_db)
        if (inside & ~heard).any():
            silent = places.place[inside & ~heard]
            axis.scatter(*silent.T, s=size, c="0.8", linewidths=0, label=f"{name}, nothing heard")
        bar: dict[str, Any] = {"label": places.label, "extend": "both", "shrink": 0.85, "pad": 0.02}
        draw_values(axis, places.place[heard], places.level_db[heard], size, 0.01, **bar)
        axis.scatter([], [], s=25, c="0.4", linewidths=0, label=name)  # whose colours are the bar's
    side = propose_side(data)
    test = np.zeros(0, np.int64) if side is None else held_out_block_rows(data, side)
    if len(test):
        ring = np.unique(data.moving[test, -3:-1], axis=0) + site.origin[:2]
        how: dict[str, Any] = {"facecolors": "none", "edgecolors": "black", "linewidths": 0.7}
        axis.scatter(
            *ring.T, s=size, label=f"held out by split=blocks split.side_m={side:g}", **how
        )
    set_bounds(axis, low, high, site.georeference)
    _draw_stations(axis, data, jumping)
    _draw_suspicious(axis, places, low, high)


def _size(place: np.ndarray, extent: float) -> float:
    """Area [points^2] of a mark as large as the distance between neighbours."""
    spacing = (
        float(np.median(cKDTree(place).query(place, k=2)[0][:, 1])) if len(place) > 1 else extent
    )
    # 72 points are an inch; clipped to what is seen (2.5) and hides no neighbours (9).
    return float(np.clip(72 * INCHES * spacing / extent, 2.5, 9.0)) ** 2


def _draw_stations(axis: Any, data: Measurements, jumping: Sequence[int]) -> None:
    place, site = static_positions(data), data.site
    if not len(place):
        return
    noun = ENDS[site.still_end]
    label = f"the {noun}" if len(place) == 1 else f"{len(place)} stations ({noun}s)"
    draw_stations(axis, place, label, zorder=2)
    if jumping:
        draw_stations(axis, place[list(jumping)], "its level jumps", zorder=2, color="red")
    if site.stations is None or len(place) > NAMED:
        return
    names = site.stations.label or site.stations.name
    # All sectors of a mast in one text: one above the other the last alone would be read.
    masts, mast = np.unique(place.round(1), axis=0, return_inverse=True)
    for number, where in enumerate(masts):
        sectors = np.flatnonzero(mast.reshape(-1) == number).tolist()
        if np.isfinite(where).all():
            colour = "red" if set(sectors) & set(jumping) else "black"
            annotate(axis, ", ".join(names[t] for t in sectors), where, colour)


def _draw_suspicious(axis: Any, places: Spots, low: np.ndarray, high: np.ndarray) -> None:
    near, far = np.flatnonzero(places.suspicious & ~places.far), np.flatnonzero(places.far)
    if len(near):
        marks = {"s": 90, "facecolors": "none", "edgecolors": "red", "linewidths": 1.5}
        label = f"suspicious level ({len(near)} place{'s' * (len(near) > 1)})"
        axis.scatter(*places.place[near].T, label=label, zorder=3, **marks)
    if len(far):
        # At the edge, 2 % inside: at its place it would shrink the site to a point.
        edge = np.clip(
            places.place[far],
            *(corner + s * 0.02 * (high - low) for corner, s in ((low, 1), (high, -1))),
        )
        axis.scatter(
            *edge.T,
            c="red",
            marker="x",
            s=60,
            zorder=3,
            label=f"far outside, at the edge ({len(far)})",
        )
        for row, where in zip(far[:MOST_MARKS], edge, strict=False):
            at = ", ".join(f"{v:.4g}" for v in places.place[row])
            annotate(axis, f"{places.rows[row]} at ({at})", where, "red")
    for row in near[:MOST_MARKS]:
        annotate(axis, places.rows[row], places.place[row], "red", above=False)


def _draw_level(
    axis: Any, levels: LinkLevels, station: int, steps: Sequence[LevelStep], unit: str
) -> None:
    """Levels of a station by row; those between two steps in one colour."""
    rows = np.flatnonzero(levels.station == station)
    level = levels.level_db[rows]
    number = np.arange(len(rows))
    edges = [0, *(int(np.searchsorted(rows, step.first)) for step in steps), len(rows)]
    for k, (start, stop) in enumerate(pairwise(edges)):
        axis.plot(number[start:stop], level[start:stop], ".", markersize=2.5, color=f"C{k}")
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.2 * (high - low))  # room for words
    for k, step in enumerate(steps):
        last, first = (int(np.searchsorted(rows, row)) for row in (step.last, step.first))
        # At least one place wide, or a step between neighbours would not be seen.
        axis.axvspan(last, max(first, last + 1), facecolor="red", alpha=0.2)
        axis.axvline(first, color="red", linewidth=1.2)
        note = (
            f" {step.change_db:+.0f} dB from {levels.rows[step.last]} to {levels.rows[step.first]} "
        )
        axis.text(
            first,
            0.97 - 0.1 * k,
            note,
            color="red",
            fontsize="small",
            va="top",
            ha="left" if first < len(rows) / 2 else "right",
            transform=axis.get_xaxis_transform(),
            path_effects=OUTLINE,
        )
    wild = [bad for t, bad, _ in find_outlier_rows(levels) if t == station]
    for row in np.concatenate([np.zeros(0, np.int64), *wild]):
        axis.plot(np.searchsorted(rows, row), levels.level_db[row], "o", mec="red", mfc="none")
    axis.set(
        title=f"{levels.names[station]}: steps that the places do not explain",
        ylabel=f"level [{unit}]",
    )
    axis.set_xlabel("place, in the order of measuring")


UPRIGHT = 0.3  # vertical part of a unit normal, below which a plane is drawn as a wall
FARTHEST = 4.0  # extents of the places, at which a wall is on the map
AROUND, MARGIN = 0.5, 0.06  # of the extent of the places, drawn around them with walls and without


def draw_found(
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
    width, height = (high - low) / (high - low).max() * INCHES
    figure, axes = panels(max(width, 3.0) + 1.9, max(height, 2.3) + 1.6)
    axis = axes[0, 0]
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
    how = {"color": "0.25", "lw": 3.0, "alpha": 0.5, "solid_capstyle": "butt"}
    label: str | None = "known walls"
    for face in known.faces:
        cut = _cut(face, height)
        if len(cut) >= 2:
            axis.plot(*cut[:2, :2].T, label=label, **how)
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
