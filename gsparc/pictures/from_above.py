"""A site from above, as all plans draw it: equal scales, walls, stations, measured places,
a scale bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike
from scipy.ndimage import label as areas_of

from gsparc.pictures.drawing import LABEL, colour_bar, panels
from gsparc.processes.few_rows import evenly_spaced

Frame = tuple[np.ndarray, np.ndarray]  # corners (2,) [m]
INCHES = 6.5  # longer side of a map
BETWEEN = 10  # squares along the longer side, of which an empty one parts patches
MOST_COVERED, MOST_PATCHES = 0.6, 3  # of a map's area by patches, which then have panels
MOST_POINTS = 1500  # measured places that are drawn
# A city's mesh has millions of triangles; the short ones are not seen at this scale.
MOST_WALLS = 50_000
DART = Path([(-0.22, 0.75), (0.0, 0.0), (0.22, 0.75), (0.0, 1.0), (-0.22, 0.75)], closed=True)
OUTLINE = [withStroke(linewidth=2.5, foreground="white")]


def set_bounds(
    axis: Any, low: ArrayLike, high: ArrayLike, origin: Any = None, **labels: str
) -> None:
    """Set equal scales from corner (2,) to corner (2,) [m],
    in plain numbers about an `origin` that axes name.
    """
    names = {"xlabel": "x [m]", "ylabel": "y [m]"}
    if origin is not None:
        where = f"{abs(origin.longitude):g}° {'E' if origin.longitude >= 0 else 'W'}"
        north = f"{abs(origin.latitude):g}° {'N' if origin.latitude >= 0 else 'S'}"
        names = {"xlabel": f"metres east of {where}", "ylabel": f"metres north of {north}"}
    across, up = np.transpose([low, high])
    axis.set(xlim=across, ylim=up, aspect="equal", **names | labels)
    # UTM northings, 5e6 m, would be shown as small numbers beside an offset at the axis' end.
    axis.ticklabel_format(useOffset=False, style="plain")
    # Equal scales take more than their share
    axis.figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)


def frame_of(places: np.ndarray, share: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (2,) of a map: the known ones of places
    (n, 2) and a share of their extent around them.
    """
    finite_places = places[np.isfinite(places).all(axis=1)]
    low, high = finite_places.min(axis=0), finite_places.max(axis=0)
    # 1 mm: a single place, or places at one point, have a frame all the same.
    margin = max(float((high - low).max()), 1e-3) * share
    return low - margin, high + margin


def split_frame(places: np.ndarray, margin: float | None = None) -> list[Frame]:
    """Return frames of patches of places (n, 2), the largest first; one of all, where that leaves
    no large part of it empty. See `frame_of`, of `margin` [m] in place of its share.
    """

    def frame(some: np.ndarray) -> Frame:
        return frame_of(some) if margin is None else (some.min(0) - margin, some.max(0) + margin)

    whole = frame(places)
    side = max(float((whole[1] - whole[0]).max()), 1e-6) / BETWEEN
    where, which = np.unique(((places - whole[0]) / side).astype(int), axis=0, return_inverse=True)
    used = np.zeros(where.max(axis=0) + 1, bool)
    used[tuple(where.T)] = True
    # Squares that touch, also at corners, are of one patch.
    number = areas_of(used, np.ones((3, 3)))[0][tuple(where.T)][which.reshape(-1)]
    order = np.argsort(-np.bincount(number)[1:]) + 1
    frames = [frame(places[number == patch]) for patch in order]
    covered = sum(float(np.prod(high - low)) for low, high in frames)
    most = MOST_COVERED * float(np.prod(whole[1] - whole[0]))
    return frames if 1 < len(frames) <= MOST_PATCHES and covered < most else [whole]


def map_panels(
    frames: Sequence[Frame], rows: int = 1, beside: float = 0.0, least: float = 0.0
) -> tuple[Figure, np.ndarray, Any]:
    """Return a figure, axes (rows, frames) for maps of these, and axes `beside` them, so many
    inches wide, over all rows; None of 0. `least`: inches that it is high.
    """
    sides = np.array([high - low for low, high in frames])
    tall = np.clip(sides[:, 1] / sides.max(), 0.45, 1.0).max() * INCHES / (1 + 0.3 * (rows > 1))
    wide = np.clip(tall * sides[:, 0] / sides[:, 1], 0.45 * INCHES, INCHES)
    ratios = [*wide, beside] if beside else [*wide]
    height = max(rows * tall + 1.6, least)
    figure, axes = panels(
        sum(ratios) + 1.9, height, rows, len(ratios), width_ratios=ratios, grid=False
    )
    if not beside:
        return figure, axes, None
    place = axes[0, -1].get_gridspec()[:, -1]
    for axis in axes[:, -1]:
        axis.remove()
    return figure, axes[:, :-1], place


def draw_stations(axis: Any, places: np.ndarray, label: str | None = "station", **how: Any) -> None:
    """Mark places (n, 2) [m], black unless `how` says another colour."""
    marks = {
        "marker": "^",
        "color": "k",
        "markersize": 9,
        "markeredgecolor": "white",
        "linestyle": "",
    }
    axis.plot(*places.T, label=label, **{**marks, "zorder": 4, **how})


def draw_sectors(axis: Any, places: np.ndarray, azimuth: np.ndarray) -> None:
    """Draw a dart at each of places (n, 2) [m] towards its azimuth (n,) [deg from north]."""
    # Azimuths turn clockwise from north, matplotlib's angles anticlockwise: hence the sign.
    for where, turn in zip(places, azimuth, strict=True):
        dart = MarkerStyle(DART, transform=Affine2D().rotate_deg(-turn))
        draw_stations(axis, where, None, marker=dart, markersize=17)
    draw_stations(axis, places[:0], "sector", marker="d", markersize=7)


def draw_measured(axis: Any, places: np.ndarray) -> None:
    """Mark places (n, 2) [m] that are seen on cells of any colour, the more the smaller."""
    if len(places):
        few = places[evenly_spaced(len(places), MOST_POINTS)]
        # By the root of their number, so that the area that marks hide stays the same.
        size = float(np.clip(60 / np.sqrt(len(few)), 2.5, 6.0))
        axis.plot(
            *few.T,
            "o",
            markersize=size,
            label="measured",
            zorder=3,
            linestyle="",
            markerfacecolor="black",
            markeredgecolor="white",
            markeredgewidth=0.2 * size,
        )


def draw_values(
    axes: Any,
    places: np.ndarray,
    values: np.ndarray,
    size: float,
    clipped: float,
    label: str,
    **bar: Any,
) -> None:
    """Mark places (n, 2) [m] on axes, in the colours of values (n,), told by one `bar`.

    A share `clipped` of the values has the colour at either end:
    a few outliers would leave one for the rest.
    """
    low, high = np.quantile(values, [clipped, 1 - clipped])
    for axis in np.ravel(axes):
        dots = axis.scatter(*places.T, c=values, s=size, vmin=low, vmax=high, linewidths=0)
    colour_bar(dots, axes, label, **bar)


def draw_walls(axis: Any, triangles: np.ndarray) -> None:
    """Draw upright triangles (n, 3, 3) [m] as lines; at most `MOST_WALLS`, the longest."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    # .1 = sin 6 degrees from upright; 1e-12 m^2 keeps triangles without area from dividing by 0.
    upright = triangles[np.abs(normal[:, 2]) < 0.1 * np.linalg.norm(normal, axis=1).clip(1e-12)][
        :, :, :2
    ]
    ends = np.stack([upright, np.roll(upright, -1, axis=1)], axis=2)  # three sides of each
    length = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    longest = ends[np.arange(len(ends)), length.argmax(1)]
    rows = np.argsort(-length.max(1, initial=0))[:MOST_WALLS]
    axis.add_collection(LineCollection(longest[rows], colors="0.45", linewidths=0.5, zorder=0))


def annotate(axis: Any, text: str, where: np.ndarray, colour: str = "black") -> None:
    """Write beside a point, where `save` finds room."""
    note = axis.annotate(
        text,
        where,
        xytext=(6, 6),
        textcoords="offset points",
        fontsize="small",
        color=colour,
        path_effects=OUTLINE,
        zorder=5,
        gid=LABEL,
    )
    # Text at the rim would otherwise take width from the axes, whose scales are equal.
    note.set_in_layout(False)


def scale_bar(axis: Any) -> None:
    """Draw a bar of a round length, about a fifth of the map wide."""
    (west, east), (south, north) = axis.get_xlim(), axis.get_ylim()
    decade = 10.0 ** np.floor(np.log10((east - west) / 5))
    length = max(value for value in (1, 2, 5) if value * decade <= (east - west) / 5) * decade
    x, y = west + 0.04 * (east - west), south + 0.05 * (north - south)
    axis.plot(
        [x, x + length],
        [y, y],
        color="black",
        linewidth=4,
        solid_capstyle="butt",
        zorder=6,
        path_effects=[withStroke(linewidth=6, foreground="white")],
    )
    unit, metres = next(
        scale
        for scale in (("km", 1000), ("m", 1), ("cm", 0.01))
        if length >= scale[1] or scale[1] < 1
    )
    axis.annotate(
        f"{length / metres:g} {unit}",
        (x + length / 2, y),
        xytext=(0, 5),
        ha="center",
        textcoords="offset points",
        fontsize="small",
        path_effects=OUTLINE,
        zorder=6,
    )


def legend_below(figure: Any, columns: int = 3) -> Any:
    """Say beneath the map what marks are; returns the legend, None where nothing has a label."""
    marks: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            marks.setdefault(label, handle)  # of several panels once
    if not marks:
        return None
    return figure.legend(
        marks.values(),
        marks.keys(),
        loc="outside lower left",
        ncols=columns,
        fontsize="small",
        frameon=False,
    )
