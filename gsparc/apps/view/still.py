"""A still picture of a scene and one answer, for a paper: no browser and no `viser` are needed."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from gsparc.apps.maps.pictures import Legend
from gsparc.apps.view.answer import ask
from gsparc.apps.view.building import GAUSSIANS, PATHS, RAYS, SOURCES, VALUES, rays_of
from gsparc.apps.view.panel import RED, draw_answer
from gsparc.apps.view.plane import thinned
from gsparc.apps.view.reasons import ENDS, headline
from gsparc.apps.view.scene import Faces, Lines, Mark, Points
from gsparc.apps.view.site_view import SiteView
from gsparc.data.blocks import evenly
from gsparc.evaluation.drawing import panels, save

WIDTH, HEIGHT, DPI = 8.0, 4.4, 150  # readable at 600 pixels
MOST_DOTS = 3000
CELLS = 120  # along the longer side of a plane
LETTERS = 42  # of a line above the panel
AZIMUTH = -70  # from where it is looked at [degrees]
ACROSS = np.array([-np.sin(np.radians(AZIMUTH)), np.cos(np.radians(AZIMUTH))])  # to the right, of (x, y)
FLATTEST = 0.2  # of height to width, that a flat site is drawn with


def draw_still(view: SiteView, path: Path) -> None:
    """Save the scene of the first station with the answer at the first place as PNG."""
    name = view.viewed.stations[0]
    one, viewed = view.station(name), view.viewed
    answer = ask(viewed.predictor_of(name), view.starts(name))
    figure, axes = panels(WIDTH, HEIGHT, 1, 2, width_ratios=[1.6, 1.0])
    place = axes[0, 0].get_subplotspec()
    axes[0, 0].remove()
    axis: Any = figure.add_subplot(place, projection="3d")
    axis.computed_zorder = False  # parts are sorted as wholes: a plane would hide the walls on it
    low, high = _limits(view, name)
    plane = [] if view.grid is None else [_plane(axis, view, name, one.power)]
    marks = [part for part in one.scene.parts if isinstance(part, Mark)]
    rays = rays_of(answer, view.extent(name)) or ()
    for part in (*one.scene.parts, *rays):
        if isinstance(part, Points):
            _dots(axis, part, low, high)
        elif isinstance(part, Lines) and part.name == RAYS:
            _rays(axis, part, low, high)
        elif isinstance(part, Faces):
            corners = np.clip(part.vertices, low, high)[part.triangles]
            colour = np.array(part.colour) / 255
            axis.add_collection3d(Poly3DCollection(corners, facecolor=(*colour, part.opacity), zorder=2))
    ends = {end: answer.ends[end] for end in viewed.moving}
    for mark in marks:
        _mark(axis, mark.place, mark.text, "k^", list(ends.values()))
    for end, place in ends.items():
        _mark(axis, place, ENDS[end], "o", [mark.place for mark in marks if mark.text], color=RED)
    _look(axis, low, high)
    legends = [legend for key, legend in one.scene.legends.items() if key in (VALUES, GAUSSIANS)]
    legends += [] if legends else plane
    legends += [PATHS] if rays else []
    for legend in legends:
        scale = ScalarMappable(Normalize(legend.low, legend.high), legend.colours)
        bar = figure.colorbar(scale, ax=axis, shrink=0.7, pad=0.01, location="bottom", aspect=40)
        bar.set_label(legend.label, fontsize="small")
        bar.ax.tick_params(labelsize="small")
        bar.locator = MaxNLocator(5)
    draw_answer(axes[0, 1], answer, viewed.site, one.about.usual, view.unit)
    axes[0, 1].set_title(fill(headline(answer, view.unit), LETTERS), fontsize="small")
    figure.suptitle(one.scene.title)
    save(figure, path, DPI)


def _limits(view: SiteView, name: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of what is drawn [m]: the frame across, what was measured and the ends upwards."""
    middle, half = view.station(name).scene.frame.middle, 0.55 * view.extent(name)
    stands = [part.place for part in view.station(name).scene.parts if isinstance(part, Mark)]
    height = np.concatenate([view.viewed.box()[:, 2], [place[2] for place in stands]])
    low, high = middle - half, middle + half
    if view.station(name).scene.part(GAUSSIANS) is None:  # else as tall as wide: they lie all around
        tall = max(float(np.ptp(height)) * 1.1, FLATTEST * 2 * half)
        low[2] = height.min() - 0.05 * tall
        high[2] = low[2] + tall
    return low, high


def _dots(axis: Any, part: Points, low: np.ndarray, high: np.ndarray) -> None:
    inside = np.flatnonzero(((part.places >= low) & (part.places <= high)).all(axis=1))
    if part.name not in (VALUES, GAUSSIANS, SOURCES) or not len(inside):
        return
    few = inside[evenly(len(inside), MOST_DOTS)]
    how = {"alpha": 0.4, "s": 9} if part.name == GAUSSIANS else {"alpha": 0.9, "s": 6}
    axis.scatter(
        *part.places[few].T, c=part.colours[few] / 255, linewidths=0, depthshade=False, zorder=3, **how
    )


def _rays(axis: Any, part: Lines, low: np.ndarray, high: np.ndarray) -> None:
    for (start, end), colour in zip(part.segments, part.colours / 255, strict=True):
        along = end - start
        with np.errstate(divide="ignore", invalid="ignore"):
            edge = np.where(along == 0, np.inf, (np.where(along > 0, high, low) - start) / along)
        end = start + along * float(np.clip(edge.min(), 0, 1))
        axis.plot(*np.stack([start, end]).T, color=colour, lw=1.0, zorder=4)


def _mark(axis: Any, place: np.ndarray, text: str, mark: str, others: list[Any], **how: Any) -> None:
    """A mark with its text on the side away from `others`, where it stands beside all of them."""
    x, y, z = place
    axis.plot([x], [y], [z], mark, ms=7, mec="white", zorder=20, **how)
    side = "right" if others and all((place - other)[:2] @ ACROSS < 0 for other in others) else "left"
    note = axis.text(x, y, z, f"  {text}  ", fontsize="small", zorder=21, va="center", ha=side)
    note.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def _plane(axis: Any, view: SiteView, name: str | None, legend: Legend | None) -> Legend:
    """Draw the power over a plane; returns what its colours mean."""
    grid = view.grid
    assert grid is not None
    coarse = thinned(grid, CELLS)
    level = view.plane(name, coarse).level_db
    legend = legend or Legend.over(f"received power [{view.unit}]", level)
    clear = np.where(np.isfinite(level), 0.75, 0.0)[..., None]
    colours = np.concatenate([legend.of(level) / 255, clear], axis=-1)
    x, y = np.meshgrid(coarse.x, coarse.y)
    height = np.full_like(x, coarse.height)
    axis.plot_surface(
        x, y, height, facecolors=colours, shade=False, rstride=1, cstride=1, linewidth=0, zorder=1
    )
    return legend


def _look(axis: Any, low: np.ndarray, high: np.ndarray) -> None:
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_xlabel("x [m]", labelpad=-4)
    axis.set_ylabel("y [m]", labelpad=-4)
    axis.set_zlabel("z [m]", labelpad=-6)
    axis.tick_params(labelsize="x-small", pad=0)
    for one, count in ((axis.xaxis, 5), (axis.yaxis, 5), (axis.zaxis, 3)):
        one.set_major_locator(MaxNLocator(count))
    axis.set_box_aspect(high - low, zoom=1.15)
    axis.view_init(elev=30, azim=AZIMUTH)
