"""A still picture of a scene and one answer, for a paper: no browser and no `viser` are needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from gsparc.evaluation.drawing import panels, save
from gsparc.view.answer import ask
from gsparc.view.building import GAUSSIANS, VALUES, rays_of
from gsparc.view.panel import draw_answer
from gsparc.view.plane import refining
from gsparc.view.scene import Faces, Legend, Lines, Mark, Points
from gsparc.view.site_view import SiteView
from gsparc.view.words import ENDS, headline

WIDTH, HEIGHT, DPI = 8.0, 4.3, 150  # readable at 600 pixels
MOST_DOTS = 3000
CELLS = 60  # along the longer side of a plane
FLATTEST = 0.25  # of height to width, that a flat site is drawn with


def draw_still(view: SiteView, path: Path) -> None:
    """Save the scene of the first station with the answer at the first place as PNG.

    Args:
        view: the model.
        path: of the file.
    """
    name = view.viewed.stations[0]
    one, viewed = view.station(name), view.viewed
    answer = ask(viewed.asked(name), view.starts(name))  # type: ignore[arg-type]
    figure, axes = panels(WIDTH, HEIGHT, 1, 2, width_ratios=[1.75, 1.0])
    spec = axes[0, 0].get_subplotspec()
    axes[0, 0].remove()
    axis: Any = figure.add_subplot(spec, projection="3d")
    if view.grid is not None:
        _plane(axis, view, name, one.power)
    for part in (*one.scene.parts, *(rays_of(answer, view.extent(name)) or ())):
        if part.name not in one.scene.hidden and isinstance(part, Points | Lines | Faces | Mark):
            _draw(axis, part)
    for end in viewed.moving:
        x, y, z = answer.ends[end]
        axis.plot([x], [y], [z], "o", color="#D62728", ms=7, mec="white", label=ENDS[end], zorder=10)
    _look(axis, view, name)
    legends = [one.scene.legends[key] for key in (VALUES, GAUSSIANS) if key in one.scene.legends]
    for legend in legends[:2]:
        scale = ScalarMappable(Normalize(legend.low, legend.high), legend.colours)
        figure.colorbar(
            scale, ax=axis, label=legend.label, shrink=0.55, pad=0.02, location="bottom", aspect=35
        )
    draw_answer(axes[0, 1], answer, viewed.site, view.unit)
    axes[0, 1].set_title(f"{axes[0, 1].get_title()}\n{headline(answer, view.unit)}", fontsize="small")
    figure.suptitle(one.scene.title)
    save(figure, path, DPI)


def _draw(axis: Any, part: Points | Lines | Faces | Mark) -> None:
    if isinstance(part, Points):
        few = np.linspace(0, len(part.places) - 1, min(len(part.places), MOST_DOTS)).astype(int)
        alpha = 0.35 if part.name == GAUSSIANS else 0.9
        axis.scatter(
            *part.places[few].T, c=part.colours[few] / 255, s=7, alpha=alpha, linewidths=0, depthshade=False
        )
    elif isinstance(part, Lines):
        for segment, colour in zip(part.segments, part.colours / 255, strict=True):
            axis.plot(*segment.T, color=colour, lw=0.8)
    elif isinstance(part, Faces):
        colour = (*(np.array(part.colour) / 255), part.opacity)
        axis.plot_trisurf(*part.vertices.T, triangles=part.triangles, color=colour, linewidth=0, shade=False)
    else:
        x, y, z = part.place
        axis.plot([x], [y], [z], "k^", ms=7, mec="white", zorder=9)
        axis.text(x, y, z, f"  {part.text}", fontsize="x-small", zorder=9)


def _plane(axis: Any, view: SiteView, name: str | None, legend: Legend | None) -> None:
    grid = view.grid
    assert grid is not None
    other = None if view.viewed.site.static_end is not None else view.starts(name)["tx"].tolist()
    *_, plane = refining(view.viewed.asked(name), grid, other)
    assert plane is not None
    every = max(1, max(grid.shape) // CELLS)
    level = plane.level_db[::every, ::every]
    legend = legend or Legend.over("", level)
    colours = np.concatenate(
        [legend.of(level) / 255, np.where(np.isfinite(level), 0.75, 0.0)[..., None]], axis=-1
    )
    x, y = np.meshgrid(grid.x[::every], grid.y[::every])
    axis.plot_surface(
        x, y, np.full_like(x, grid.height), facecolors=colours, shade=False, rstride=1, cstride=1, linewidth=0
    )


def _look(axis: Any, view: SiteView, name: str | None) -> None:
    low, high = (
        f(view.station(name).scene.frame.middle[:3], view.extent(name) / 2) for f in (np.subtract, np.add)
    )
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    box = np.concatenate(
        [view.viewed.box(), *([m.place[None] for m in view.station(name).scene.parts if isinstance(m, Mark)])]
    )
    bottom, top = box[:, 2].min(), box[:, 2].max()
    tall = max(top - bottom, FLATTEST * view.extent(name) / 4)
    axis.set_zlim(bottom - 0.1 * tall, bottom + 1.1 * tall)
    axis.set_box_aspect((1, 1, max(tall / view.extent(name), FLATTEST)))
    axis.view_init(elev=28, azim=-70)
