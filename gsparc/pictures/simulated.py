"""A simulation for a reader: its floor plan, and the scenes there are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsparc.evaluation.table import Column, Table
from gsparc.physics.decibels import to_decibels
from gsparc.pictures.drawing import panels, save
from gsparc.pictures.from_above import (
    draw_stations,
    draw_values,
    draw_walls,
    legend_below,
    set_bounds,
)
from gsparc.simulate.campaign import Outcome
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.scenes.shipped import list_shipped_scenes

# Materials of ITU-R P.2040 depend on frequency; which one does not matter for their names.
CARRIER_HZ = 3.5e9  # for looking at scenes: materials need one


def draw_power_and_delay_spread(outcome: Outcome, path: Path) -> None:
    """Draw from above: received power, delay spread and, after `auto`,
    where a dropped effect mattered.

    Of several transmitters, the strongest at each place.
    """
    decision, survey = outcome.decision, outcome.survey
    changed = None if decision is None else decision.changed
    count = 2 if changed is None else 3
    power, spreads = (outcome.rows.arrays[name] for name in ("received_power", "delay_spread"))
    places, by_station = survey.places, power.reshape(len(survey.engines), -1)
    # Rows are stations x places: the row of the strongest station at each place.
    best = by_station.argmax(0) * len(places) + np.arange(len(places))
    heard, spread = power[best], spreads[best]
    extent = np.ptp(places[:, :2], axis=0)
    high = float(np.clip(4.6 * extent[1] / extent[0], 2.5, 6.0)) + 1.3
    figure, (axes,) = panels(5.4 * count, high, 1, count, grid=False)
    reached, triangles = heard > 0, survey.engine.triangles()
    # A mark's area [points^2] shrinks with the number of places,
    # within what is seen and not hidden.
    size = float(np.clip(6000 / len(places), 2, 40))
    bar: dict[str, Any] = {"location": "bottom", "shrink": 0.8}
    at, level = places[reached, :2], to_decibels(heard[reached])
    draw_values(axes[0], at, level, size, 0.01, label="received power [dB]", **bar)
    draw_values(axes[1], at, spread[reached] * 1e9, size, 0.01, label="delay spread [ns]", **bar)
    if changed is not None:
        is_heard = power[changed.rows] > 0
        errors, rows = changed.errors[is_heard], changed.rows[is_heard] % len(places)
        label = "error without what is not needed" if np.ptp(errors) > 0 else "all is needed"
        # Errors of spectra have no decibels.
        if decision is not None and not decision.choice.deliverable.startswith("spectrum"):
            label += " [dB]"
        label += ": held-back receivers"
        draw_values(axes[2], places[rows, :2], errors, 40.0, 0.0, label=label, **bar)
    for axis in axes:
        first = axis is axes[0]  # whose labels stand for all
        if (~reached).any():
            dark = places[~reached, :2].T
            axis.scatter(*dark, s=size, c="lightgrey", label="nothing arrives" if first else None)
        draw_stations(axis, survey.transmitters[:, :2], "transmitter" if first else None, color="r")
        west, east, south, north = axis.axis()
        if len(triangles):
            draw_walls(axis, triangles)
        set_bounds(axis, (west, south), (east, north), **({} if first else {"ylabel": ""}))
    legend_below(figure)  # beside the title it would cover the last effects
    figure.suptitle(f"{outcome.data.site.name}: {len(places)} receivers\n{outcome.effects}")
    save(figure, path)


def table_of_scenes() -> Table:
    """Return size, triangles and materials of every scene that comes with Sionna."""
    rows = []
    for name in list_shipped_scenes():
        tracer = RayTracer(name, np.zeros(3), CARRIER_HZ)
        size = " x ".join(f"{side:.0f}" for side in np.ptp(tracer.bounding_box(), axis=0))
        used = ", ".join(sorted({str(m["itu"] or n) for n, m in tracer.materials().items()}))
        rows.append([name, size, f"{len(tracer.triangles()):,}", used])
    columns = [Column(head, "") for head in ("scene", "size [m]", "triangles", "materials")]
    return Table("scene=NAME: scenes that come with Sionna", columns, rows)
