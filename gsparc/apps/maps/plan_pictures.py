"""Where to measure, and where to put a station, from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsparc.apps.maps.floor_plan import FloorPlan
from gsparc.apps.maps.pictures import draw_cells
from gsparc.apps.maps.placing import Placement
from gsparc.apps.maps.planning import MeasurementPlan
from gsparc.apps.maps.promise import Promise
from gsparc.pictures import from_above
from gsparc.pictures.drawing import colour_bar, panels, save
from gsparc.prediction.predictor import Predictor

CURVE = 3.6  # inches of the panel beside maps
MOST_NUMBERS = 60  # of places that are numbered


def draw_measurement_plan(
    batch: MeasurementPlan,
    path: Path,
    promise: Promise | None,
    predictor: Predictor | None,
    plan: FloorPlan | None,
    outlines: Sequence[np.ndarray] = (),
) -> None:
    """Draw the expected error before and after, the chosen places, and how it falls."""
    cells = batch.grid.places()[:, :2]
    frames = from_above.split_frame(cells, margin=batch.grid.step / 2)
    figure, axes, room = from_above.map_panels(frames, 2, CURVE, 2 * CURVE)
    errors = np.concatenate([batch.error_before, batch.error_after])
    # 99.5 %: a single corner far from all rows would flatten the rest.
    most = float(np.percentile(errors, 99.5)) + 1e-9
    done = f"after these {len(batch.places)}"
    parts = (batch.error_before, "now"), (batch.error_after, done)
    for row, (values, title) in zip(axes, parts, strict=True):
        image = np.full(batch.grid.inside.shape, np.nan)
        image[batch.grid.inside] = values
        for axis, (low, high) in zip(row, frames, strict=True):
            mesh = draw_cells(
                axis,
                batch.grid,
                image,
                plan,
                cmap="cividis",
                vmin=float(errors.min()),
                vmax=most,
            )
            for line in outlines:
                axis.plot(*line.T, color="0.6", linewidth=0.6, zorder=2.6)
            from_above.set_bounds(axis, low, high, batch.grid.origin, title=title)
            from_above.scale_bar(axis)
    if promise is not None and predictor is not None:
        places = np.unique(promise.known[:, -3:-1], axis=0) + predictor.site.origin[:2]
        for axis in axes[0]:
            from_above.draw_measured(axis, places)
    for axis in axes[1]:
        axis.plot(*batch.path.T, color="red", linewidth=1, zorder=3)
        axis.plot(
            *batch.places[:, :2].T,
            "o",
            zorder=3,
            color="red",
            markeredgecolor="white",
            markersize=6,
        )
        for number, place in enumerate(batch.places[:MOST_NUMBERS], 1):
            from_above.annotate(axis, str(number), place[:2])
    colour_bar(mesh, axes, "expected error [dB]")
    curve = figure.add_subplot(room)
    expected = np.append(batch.before_db, batch.expected_db[np.argsort(batch.chosen)])
    curve.plot(expected, ".-")
    for number in (0, len(expected) - 1):
        from_above.annotate(
            curve, f"{expected[number]:.2f} dB", np.array([number, expected[number]])
        )
    # From 0: a fall of a tenth of a decibel is not to look like one to nothing.
    curve.set(ylim=(0, 1.15 * expected.max()), xlabel="places, the most telling first")
    curve.set_ylabel("expected error over the area [dB]")
    curve.grid(alpha=0.3)
    save(figure, path, 100)


def draw_placement(placing: Placement, path: Path, threshold_db: float, unit: str = "dB") -> None:
    """Save the goal at every candidate, the stations that stand, and the best place, as PNG."""
    west, east, south, north = placing.grid.extent
    figure, ((axis,),) = panels(
        8.5, 6.5 * max((north - south) / (east - west), 0.5) + 1.0, grid=False
    )
    dots = axis.scatter(
        *placing.places[:, :2].T, c=placing.coverage, s=60, marker="s", cmap="viridis"
    )
    label = f"share of the predicted area with {threshold_db:g} {unit} or more, with a station here"
    colour_bar(dots, axis, label)
    from_above.draw_stations(axis, placing.stations)
    from_above.draw_stations(
        axis, placing.places[0, :2], "best", marker="*", color="r", markersize=18
    )
    from_above.set_bounds(axis, (west, south), (east, north), placing.grid.origin)
    from_above.scale_bar(axis)
    from_above.legend_below(figure)
    save(figure, path, 100)
