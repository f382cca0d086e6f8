"""A simulation for a reader: its floor plan, what `auto` measured, the scenes there are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from gsparc.evaluation.drawing import panels, save
from gsparc.evaluation.from_above import bounded, draw_stations, draw_walls, legend_below
from gsparc.evaluation.summary import table
from gsparc.simulate.auto import Choice
from gsparc.simulate.campaign import Outcome
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.scenes.shipped import shipped

# Materials of ITU-R P.2040 depend on frequency; which one does not matter for drawing.
CARRIER_HZ = 3.5e9  # for looking at scenes: materials need one


def floor_plan(outcome: Outcome, path: Path) -> None:
    """Draw from above: received power, delay spread and, after `auto`, where a dropped effect mattered.

    Of several transmitters, the strongest at each place.
    """
    changed, survey = outcome.changed, outcome.survey
    count = 2 if changed is None else 3
    places, by_station = survey.places, outcome.dataset.power.reshape(len(survey.engines), -1)
    # Rows are stations x places: the row of the strongest station at each place.
    best = by_station.argmax(0) * len(places) + np.arange(len(places))
    heard, spread = outcome.dataset.power[best], outcome.dataset.delay_spread[best]
    extent = np.ptp(places[:, :2], axis=0)
    high = float(np.clip(4.6 * extent[1] / extent[0], 2.5, 6.0)) + 1.3
    figure, (axes,) = panels(5.4 * count, high, 1, count, grid=False)
    reached, triangles = heard > 0, survey.engine.triangles()
    # A mark's area [points^2] shrinks with the number of places, within what is seen and not hidden.
    size = float(np.clip(6000 / len(places), 2, 40))
    _map(axes[0], places[reached], 10 * np.log10(heard[reached]), "received power [dB]", size)
    _map(axes[1], places[reached], spread[reached] * 1e9, "delay spread [ns]", size)
    if changed is not None:
        known = outcome.dataset.power[changed.rows] > 0
        errors, rows = changed.errors[known], changed.rows[known] % len(places)
        label = "error without what is not needed" if np.ptp(errors) > 0 else "all is needed"
        # Errors of spectra have no decibels.
        if outcome.choice is not None and not outcome.choice.deliverable.startswith("spectrum"):
            label += " [dB]"
        _map(axes[2], places[rows], errors, f"{label}: held-back receivers", 40.0, clipped=0.0)
    for axis in axes:
        first = axis is axes[0]  # whose labels stand for all
        if (~reached).any():
            dark = places[~reached, :2].T
            axis.scatter(*dark, s=size, c="lightgrey", label="nothing arrives" if first else None)
        draw_stations(axis, survey.transmitters[:, :2], "transmitter" if first else None, color="r")
        left, right, south, north = axis.axis()
        if len(triangles):
            draw_walls(axis, triangles)
        bounded(axis, (left, south), (right, north), **({} if first else {"ylabel": ""}))
    legend_below(figure)  # beside the title it would cover the last effects
    figure.suptitle(f"{outcome.dataset.data.site.name}: {len(places)} receivers\n{outcome.effects}")
    save(figure, path)


def plans(scenes: Mapping[str, np.ndarray], path: Path) -> None:
    """Scenes from above, one panel each: titles and triangles (n, 3, 3) [m]."""
    columns = 4
    rows = -(-len(scenes) // columns)
    figure, axes = panels(3.2 * columns, 3.0 * rows, rows, columns, grid=False)
    for axis in axes.flat[len(scenes) :]:
        axis.set_axis_off()
    for axis, (title, triangles) in zip(axes.flat, scenes.items(), strict=False):
        draw_walls(axis, triangles)
        bounded(axis, triangles.min((0, 1)), triangles.max((0, 1)), xlabel="", ylabel="")
        axis.set_title(title, fontsize="small")
        axis.tick_params(labelsize="x-small")
    save(figure, path)


def _map(
    axis: Any, places: np.ndarray, values: np.ndarray, label: str, size: float, clipped: float = 0.01
) -> None:
    low, high = np.quantile(values, [clipped, 1 - clipped])
    dots = axis.scatter(*places[:, :2].T, c=values, s=size, vmin=low, vmax=high, linewidths=0)
    axis.figure.colorbar(dots, ax=axis, location="bottom", label=label, shrink=0.8)


def effect_shares(choice: Choice, path: Path) -> None:
    """Share of power and channel NMSE of each effect, kept or dropped."""
    rows = [row for row in choice.table if row.share > 0 or row.nmse_p95 > 0][::-1]
    names = [row.effect.replace("_", " ") for row in rows]
    figure, ((left, right),) = panels(9, 0.36 * len(rows) + 1.6, 1, 2, grid=False, sharey=True)
    colours = ["tab:blue" if row.kept else "grey" for row in rows]
    for axes, middle, far, label in (
        (left, [r.share * 100 for r in rows], [r.share_p95 * 100 for r in rows], "share of power [%]"),
        (right, [r.nmse for r in rows], [r.nmse_p95 for r in rows], "channel NMSE if left out"),
    ):
        axes.barh(names, far, color=colours, alpha=0.5, height=0.75)
        axes.barh(names, middle, color=colours, height=0.45)
        axes.set_xlabel(f"{label}: typical (dark), 95 % (light)")
        axes.grid(axis="x", alpha=0.3)
    # NMSE of kept and dropped effects are decades apart.
    right.set_xscale("log")
    figure.suptitle(f"blue: needed; grey: not. {choice.deliverable}")
    save(figure, path)


def shipped_scenes() -> tuple[Table, dict[str, np.ndarray]]:
    """Size, triangles and materials of every scene that comes with Sionna, and what `plans` draws of them."""
    rows, meshes = [], {}
    for name in shipped():
        tracer = RayTracer(name, np.zeros(3), CARRIER_HZ)
        size = " x ".join(f"{side:.0f}" for side in np.ptp(tracer.box(), axis=0))
        triangles = meshes[f"{name}, {size} m"] = tracer.triangles()
        used = ", ".join(sorted({str(m["itu"] or n) for n, m in tracer.materials().items()}))
        rows.append([name, size, f"{len(triangles):,}", used])
    heads = ["scene", "size [m]", "triangles", "materials"]
    return table("scene=NAME: scenes that come with Sionna", heads, [], rows), meshes
