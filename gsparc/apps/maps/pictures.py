"""Every layer of a map, plans of measurements and of a station: floor plan beneath, measured
points, stations, scale bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.transforms import Affine2D

from gsparc.apps.maps.area import FloorPlan, Grid
from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.layers import MOST_COLOURS, Layer, file_name, label_places
from gsparc.apps.maps.placing import Placement
from gsparc.apps.maps.planning import MeasurementPlan
from gsparc.apps.maps.promise import Promise
from gsparc.pictures import from_above
from gsparc.pictures.drawing import colour_bar, panels, save
from gsparc.prediction.predictor import Predictor

NAMED = 15  # stations; of more only their marks are drawn
MOST_LISTED = 15  # a line for "5 more" would say no less than their names


def draw_layer(
    field: FieldMap,
    layer: Layer,
    path: Path,
    title: str,
    plan: FloorPlan | None = None,
    outlines: Sequence[np.ndarray] = (),
) -> None:
    """Save one layer, over a floor plan and beneath outlines (n, 2) [m], in the format of the
    file's ending; patches far apart have panels of their own.
    """
    told = np.isfinite(layer.values) if field.refused.any() else field.grid.inside
    cells = field.grid.places(np.flatnonzero(told if told.any() else field.grid.inside))
    frames = from_above.split_frame(cells[:, :2], margin=field.grid.step / 2)
    figure, (axes,), _ = from_above.map_panels(frames)
    for axis, (low, high) in zip(axes, frames, strict=True):
        nothing = np.where(field.refused, 1.0, np.nan)
        draw_cells(axis, field.grid, nothing, None, cmap=ListedColormap(["0.89"]), zorder=1)
        legend = layer.legend
        colours = ListedColormap(layer.table())
        image = draw_cells(
            axis, field.grid, layer.values, plan, cmap=colours, vmin=legend.low, vmax=legend.high
        )
        for line in outlines:
            axis.plot(*line.T, color="0.3", linewidth=0.6, zorder=2.6)
        for cells_of, hatch, why in layer.doubts:
            _hatch(axis, field, cells_of, hatch, why)
        from_above.set_bounds(axis, low, high, field.grid.origin)
        if layer.words:
            _name_areas(axis, field.grid, layer)
        draw_measured_places(axis, field)
        from_above.scale_bar(axis)
    if not layer.words:
        values = layer.values[np.isfinite(layer.values)]
        beyond = bool((values < legend.low).any()), bool((values > legend.high).any())
        ends = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(
            beyond, "neither"
        )
        colour_bar(image, axes, legend.label, extend=ends)
    if field.refused.any():
        axes[0].plot([], [], "s", color="0.89", label="too far from what was measured")
    if (field.grid.inside & ~field.refused & np.isnan(layer.values)).any() and layer.blank:
        axes[0].plot([], [], "s", color="w", mec="0.5", label=layer.blank)
    figure.suptitle(title)
    from_above.legend_below(figure)
    save(figure, path, 110)


def _name_areas(axis: Any, grid: Grid, layer: Layer) -> None:
    """Names on their areas; those of the largest also in the legend."""
    (ny, nx), free = layer.values.shape, layer.values.copy()
    free[: ny // 10, : nx // 6] = np.nan  # the scale bar is there
    for row, column, word in label_places(free, layer.words):
        axis.text(
            grid.x[column],
            grid.y[row],
            word,
            ha="center",
            va="center",
            fontsize="small",
            zorder=5,
            clip_on=True,
            path_effects=from_above.OUTLINE,
        )
    listed = layer.class_table()
    areas = [
        row
        for row in zip(listed["colour"], listed["station"], listed["share"], strict=True)
        if row[2]
    ]
    more = len(areas) - MOST_COLOURS if len(areas) > MOST_LISTED else 0
    for colour, word, _ in areas[: len(areas) - more]:
        axis.plot([], [], "s", color=colour, label=word)
    if more:
        fewer = f"{more} more, that serve less: {file_name(layer, '.csv')}"
        axis.plot([], [], " ", label=fewer)


def _hatch(axis: Any, field: FieldMap, cells: np.ndarray, hatch: str, why: str) -> None:
    """Hatch cells (ny, nx) of a map; a map of a single row or column has no area to hatch."""
    if min(cells.shape) > 1 and cells.any():
        hatches = axis.contourf(
            field.grid.x,
            field.grid.y,
            cells.astype(float),
            zorder=2.5,
            hatches=["", hatch],
            levels=[-0.5, 0.5, 1.5],
            colors="none",
        )
        hatches.set(edgecolor="black", linewidth=0.0)
        axis.fill(
            [], [], facecolor="white", edgecolor="black", linewidth=0.0, hatch=hatch, label=why
        )


def draw_cells(
    axis: Any, grid: Grid, values: np.ndarray, plan: FloorPlan | None, **colours: Any
) -> Any:
    """Values (ny, nx) of cells, through which a plan beneath them is seen."""
    if plan is not None:
        draw_floor_plan(axis, plan)
    # Not "nearest", which vector formats draw at the screen's resolution.
    how = {"origin": "lower", "extent": grid.extent, "interpolation": "none", "zorder": 2}
    return axis.imshow(values, alpha=1.0 if plan is None else 0.65, **how | colours)


def draw_floor_plan(axis: Any, plan: FloorPlan) -> None:
    """Draw the floor plan, where it lies."""
    height, width = plan.image.shape[:2]
    along, at = plan.scale, plan.shift  # rows go down: their step is -j times that of columns
    turn = (
        Affine2D.from_values(along.real, along.imag, along.imag, -along.real, at.real, at.imag)
        + axis.transData
    )
    axis.imshow(plan.image, extent=(0, width, height, 0), transform=turn, zorder=0, clip_on=True)


def draw_measured_places(axis: Any, field: FieldMap) -> None:
    """Mark measured points and stations; those outside the map are left out."""
    (west, east), (south, north) = axis.get_xlim(), axis.get_ylim()
    from_above.draw_measured(axis, field.places)
    positions = field.station_place
    inside = (positions >= [west, south]).all(1) & (positions <= [east, north]).all(1)
    faces = np.isfinite(field.azimuth) if len(field.azimuth) else np.zeros(len(positions), bool)
    if (inside & ~faces).any():
        from_above.draw_stations(axis, positions[inside & ~faces])
    if (inside & faces).any():
        from_above.draw_sectors(axis, positions[inside & faces], field.azimuth[inside & faces])
    if 1 < len(positions) <= NAMED and not faces.any():
        for where, name in zip(positions[inside], np.array(field.stations)[inside], strict=True):
            from_above.annotate(axis, name, where)


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
    curve.set(
        xlabel="places, the most telling first",
        ylabel="expected error over the area [dB]",
        ylim=(0, 1.15 * expected.max()),
    )
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
