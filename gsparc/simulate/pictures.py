"""Pictures of a simulation: the floor plan, and what `auto` measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from gsparc.simulate.auto import Choice
from gsparc.simulate.campaign import Outcome
from gsparc.simulate.engine import HasTriangles

MOST_WALLS = 50_000


def floor_plan(outcome: Outcome, path: Path) -> None:
    """From above: received power, delay spread and, after `auto`, where a dropped effect mattered.

    Of several transmitters, the strongest at each place.
    """
    changed, survey = outcome.changed, outcome.survey
    count = 2 if changed is None else 3
    places, by_station = survey.places, outcome.made.power.reshape(len(survey.engines), -1)
    best = by_station.argmax(0) * len(places) + np.arange(len(places))
    heard, spread = outcome.made.power[best], outcome.made.delay_spread[best]
    extent = np.ptp(places[:, :2], axis=0)
    high = float(np.clip(4.6 * extent[1] / extent[0], 2.5, 6.0)) + 1.3
    figure = Figure(figsize=(5.4 * count, high), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, count)
    reached = heard > 0
    size = float(np.clip(6000 / len(places), 2, 40))
    power, delay_ns = 10 * np.log10(heard[reached]), spread[reached] * 1e9
    _map(panels[0], places[reached], power, "received power [dB]", size)
    _map(panels[1], places[reached], delay_ns, "delay spread [ns]", size)
    if changed is not None:
        known = outcome.made.power[changed.rows] > 0
        errors, rows = changed.errors[known], changed.rows[known] % len(places)
        label = "error without what is not needed" if np.ptp(errors) > 0 else "all is needed"
        if outcome.choice is not None and not outcome.choice.deliverable.startswith("spectrum"):
            label += " [dB]"
        _map(panels[2], places[rows], errors, f"{label}: held-back receivers", 40.0, clipped=0.0)
    for panel in panels:
        if (~reached).any():
            x, y = places[~reached, 0], places[~reached, 1]
            panel.scatter(x, y, s=size, c="lightgrey", label="nothing arrives")
        panel.plot(*survey.transmitters[:, :2].T, "r^", markersize=9, label="transmitter")
        if isinstance(survey.engine, HasTriangles):
            limits = panel.axis()
            walls(panel, survey.engine.triangles())
            panel.axis(limits)
        panel.set_aspect("equal")
        panel.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    # Below: beside the title it would cover the last effects.
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2, fontsize="small")
    title = f"{outcome.made.data.site.name}: {len(places)} receivers\n{outcome.effects}"
    figure.suptitle(title, fontsize="medium")
    figure.savefig(path, dpi=110)


def plans(scenes: Mapping[str, np.ndarray], path: Path) -> None:
    """Scenes from above, one panel each: titles and triangles (n, 3, 3) [m]."""
    columns = 4
    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.2 * columns, 3.0 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(scenes) :]:
        panel.set_axis_off()
    for panel, (title, triangles) in zip(panels, scenes.items(), strict=False):
        walls(panel, triangles)
        panel.set_title(title, fontsize="small")
        panel.set_aspect("equal")
        panel.tick_params(labelsize="x-small")
        low, high = triangles.min((0, 1)), triangles.max((0, 1))
        panel.set_xlim(low[0], high[0])
        panel.set_ylim(low[1], high[1])
    figure.savefig(path, dpi=110)


def walls(axes: Axes, triangles: np.ndarray) -> None:
    """Upright triangles (n, 3, 3) [m] seen from above, as lines; at most `MOST_WALLS`, the longest."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    upright = triangles[np.abs(normal[:, 2]) < 0.1 * np.linalg.norm(normal, axis=1).clip(1e-12)][:, :, :2]
    ends = np.stack([upright, np.roll(upright, -1, axis=1)], axis=2)  # three sides of each
    length = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    longest = ends[np.arange(len(ends)), length.argmax(1)]
    kept = np.argsort(-length.max(1, initial=0))[:MOST_WALLS]
    axes.add_collection(LineCollection(longest[kept], colors="0.45", linewidths=0.5, zorder=0))


def _map(
    axes: Axes, places: np.ndarray, values: np.ndarray, label: str, size: float, clipped: float = 0.01
) -> None:
    low, high = np.quantile(values, [clipped, 1 - clipped])
    drawn = axes.scatter(places[:, 0], places[:, 1], c=values, s=size, vmin=low, vmax=high, linewidths=0)
    assert axes.figure is not None
    axes.figure.colorbar(drawn, ax=axes, location="bottom", label=label, shrink=0.8)


def effect_shares(choice: Choice, path: Path) -> None:
    """Share of power and channel NMSE of each effect, kept or dropped."""
    rows = [row for row in choice.table if row.share > 0 or row.nmse_p95 > 0][::-1]
    names = [row.effect.replace("_", " ") for row in rows]
    figure = Figure(figsize=(9, 0.36 * len(rows) + 1.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    colours = ["tab:blue" if row.kept else "grey" for row in rows]
    for axes, middle, far, label in (
        (left, [r.share * 100 for r in rows], [r.share_p95 * 100 for r in rows], "share of power [%]"),
        (right, [r.nmse for r in rows], [r.nmse_p95 for r in rows], "channel NMSE if left out"),
    ):
        axes.barh(names, far, color=colours, alpha=0.5, height=0.75)
        axes.barh(names, middle, color=colours, height=0.45)
        axes.set_xlabel(f"{label}: typical (dark), 95 % (light)")
        axes.grid(axis="x", alpha=0.3)
    right.set_xscale("log")
    figure.suptitle(f"blue: needed; grey: not. {choice.deliverable}", fontsize="medium")
    figure.savefig(path, dpi=110)
