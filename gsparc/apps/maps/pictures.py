"""A PNG of every layer of a map: floor plan beneath, measured points, stations, scale bar."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap, Normalize, to_hex
from matplotlib.transforms import Affine2D
from scipy.ndimage import distance_transform_edt
from scipy.ndimage import label as areas_of

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.field_map import OVERLAP_DB, REFUSED, FieldMap, best_server
from gsparc.apps.maps.floor_plan import FloorPlan
from gsparc.apps.maps.placing import Placement
from gsparc.apps.maps.planning import MeasurementPlan
from gsparc.apps.maps.promise import Promise
from gsparc.pictures import from_above
from gsparc.pictures.drawing import panels, save
from gsparc.prediction.predictor import Predictor

MOST_OVERLAP = 5.0  # stations that the colours end with
UNKNOWN = "#AAAAAA"  # of values that are not known
INCHES = 7.0  # longer side of the map
NAMED = 15  # stations; of more only their marks are drawn
MOST_COLOURS, MOST_LISTED = 10, 15  # a line for "5 more" would say no less than their names
SHADES = (0.0, 0.45, -0.35, 0.7, -0.6)  # of the stations of a site: towards white, or black
BESIDE = 2  # cells between areas that must not have one colour
DEEP = 0.025  # of the map's longer side, from the edge of an area that its name is written on
UNSURE = "hatched: more likely another station, or none that is heard"


@dataclass(frozen=True)
class Legend:
    """What colours mean: from `low` to `high` of `label`, in a matplotlib colour map."""

    label: str
    low: float
    high: float
    colours: str = "viridis"

    def to_colours(self, values: np.ndarray) -> np.ndarray:
        """Return colours (..., 3) uint8 of values (...); grey where they are not finite."""
        # Masked: what is infinite is grey, too, instead of the colour of an end.
        share = Normalize(self.low, self.high, clip=True)(np.ma.masked_invalid(values))
        return colormaps[self.colours].with_extremes(bad=UNKNOWN)(share, bytes=True)[..., :3]

    @classmethod
    def over(cls, label: str, values: np.ndarray, colours: str = "viridis") -> Legend:
        """Return colours from the 1 to the 99 % quantile of those values that are finite."""
        finite_values = values[np.isfinite(values)]
        # One and 99 %: a cell at a mast would leave one colour for the rest.
        low, high = np.percentile(finite_values, [1, 99]) if len(finite_values) else (0.0, 1.0)
        return cls(label, float(low), float(high if high > low else low + 1.0), colours)


@dataclass(frozen=True)
class Layer:
    """A layer as it is drawn.

    Attributes:
        name: of its file and its button.
        values: (ny, nx) float, NaN where nothing is said.
        legend: what its colours mean, with the unit.
        words: names of whole numbers, for a layer of classes.
        group: (n,) of each class, those of one have shades of one colour; None: each is one.
        unsure: (ny, nx) bool, cells that are hatched, and why; None: none.
    """

    name: str
    values: np.ndarray
    legend: Legend
    words: tuple[str, ...] = ()
    unsure: tuple[np.ndarray, str] | None = None
    group: np.ndarray | None = None

    def table(self) -> np.ndarray:
        """Return colours (n, 4) from the lower to the upper end of the legend: of each class,
        or 256.
        """
        if not self.words:
            return colormaps[self.legend.colours](np.linspace(0, 1, 256))
        groups = np.arange(len(self.words)) if self.group is None else self.group
        number = np.unique(groups, return_inverse=True)[1]
        where = np.append(number, np.nan)[np.nan_to_num(self.values, nan=len(number)).astype(int)]
        tint = assign_colours(where, int(number.max()) + 1)[number]  # fewer than plain stations
        colours, rank = (
            np.asarray(colormaps["tab10"](tint)),
            np.tril(tint[:, None] == tint, -1).sum(1),
        )
        shade = np.array(SHADES)[rank % len(SHADES)][:, None]
        # A positive share goes to white, a negative one to black.
        colours[:, :3] += np.abs(shade) * ((shade > 0) - colours[:, :3])
        return colours

    def class_table(self) -> dict[str, list[Any]]:
        """Return columns of its classes, largest first: number, name,
        share of the map and colour.
        """
        count = np.bincount(
            self.values[np.isfinite(self.values)].astype(int), minlength=len(self.words)
        )
        order = np.argsort(-count, kind="stable").tolist()
        share, colour = count / max(count.sum(), 1), self.table()
        return {
            "number": order,
            "station": [self.words[k] for k in order],
            "share": [round(float(share[k]), 4) for k in order],
            "colour": [to_hex(colour[k]) for k in order],
        }


def assign_colours(classes: np.ndarray, count: int) -> np.ndarray:
    """Return numbers (count,) below `MOST_COLOURS`, different for classes
    (ny, nx) that lie beside each other.
    """
    if count <= MOST_COLOURS:
        return np.arange(count)
    number = np.where(np.isfinite(classes), classes, count).astype(int)
    beside = np.zeros((count + 1, count + 1), int)
    # Two cells: areas that a thin strip parts look as if they met.
    for step in range(1, BESIDE + 1):
        np.add.at(beside, (number[step:], number[:-step]), 1)
        np.add.at(beside, (number[:, step:], number[:, :-step]), 1)
    beside += beside.T
    result = np.full(count, -1)
    # Large areas first, which have most neighbours, then the rest by what is left.
    for area in np.argsort(
        -np.bincount(number.reshape(-1), minlength=count)[:count], kind="stable"
    ):
        used = result >= 0
        near = np.bincount(result[used], beside[area, :count][used], MOST_COLOURS)
        # Fewest borders of one colour first, of these the colour that is used least.
        result[area] = np.lexsort((np.bincount(result[used], minlength=MOST_COLOURS), near))[0]
    return result


def label_places(classes: np.ndarray, words: tuple[str, ...]) -> Iterator[tuple[int, int, str]]:
    """Return row, column and name for each area of classes (ny, nx)
    that is wide enough to be written on.
    """
    # Deeper than a letter at the picture's size, or the name hides its area.
    least = max(DEEP * max(classes.shape), 1.5)
    for number in np.unique(classes[np.isfinite(classes)]).astype(int):
        parts, count = areas_of(classes == number)
        for part in range(1, count + 1):
            # Padded, since the map's edge ends an area as well.
            deep = distance_transform_edt(np.pad(parts == part, 1))[1:-1, 1:-1]
            if deep.max() >= least:
                yield (
                    *(int(at) for at in np.unravel_index(deep.argmax(), deep.shape)),
                    words[number],
                )


def list_layers(field: FieldMap) -> Iterator[Layer]:
    """List every layer of a map that says something; of several stations,
    also the power of each.
    """
    several, unit = len(field.stations) > 1, field.unit
    of = " of the strongest station" if several else ""
    layer = field.layer("power_db")
    yield Layer("power", layer, Legend.over(f"received power{of} [{unit}]", layer))
    if several:
        doubt = (field.unsure, UNSURE) if field.unsure.any() else None
        yield _servers("best_server", field.layer("best_server"), field.stations, field.site, doubt)
    for band in dict.fromkeys(field.bands):
        its = np.array(field.bands) == band
        powers, names = field.power_db[its], tuple(np.array(field.stations)[its].tolist())
        if not np.isfinite(powers).any():
            continue
        strongest = best_server(powers.reshape(len(powers), -1)).reshape(field.grid.inside.shape)
        level = np.take_along_axis(powers, np.maximum(strongest, 0).astype(np.int64)[None], 0)[0]
        yield Layer(
            f"power {band}", level, Legend.over(f"received power at {band} [{unit}]", level)
        )
        where = np.where(strongest == REFUSED, np.nan, strongest)
        yield _servers(f"best_server {band}", where, names, field.site[its], None)
    if np.isfinite(field.sinr_db).any():
        label = "signal over interference and noise [dB]"
        yield Layer("sinr", field.sinr_db, Legend.over(label, field.sinr_db))
    label = f"probability of less than {field.threshold_db:g} {unit}"
    yield Layer("outage", field.outage, Legend(label, 0.0, 1.0, "magma_r"))
    error, width = (
        field.layer("expected_error_db"),
        field.at_best_server(field.upper_db - field.lower_db),
    )
    yield Layer("expected_error", error, Legend.over("expected error [dB]", error, "cividis"))
    label = f"width of the {field.share:.0%} interval [dB]"
    yield Layer("width", width, Legend.over(label, width, "cividis"))
    if "overlap" in field.extra:
        label = f"stations within {OVERLAP_DB:g} dB of the strongest, on its carrier"
        yield Layer("overlap", field.extra["overlap"], Legend(label, 1.0, MOST_OVERLAP, "YlOrRd"))
    for name, layer in zip(field.stations, field.power_db, strict=True) if several else ():
        if np.isfinite(layer).any():
            yield Layer(
                f"power {name}", layer, Legend.over(f"received power of {name} [{unit}]", layer)
            )


def _servers(
    name: str, number: np.ndarray, stations: tuple[str, ...], site: np.ndarray, doubt: Any
) -> Layer:
    legend = Legend("strongest station", -0.5, len(stations) - 0.5)
    return Layer(name, number, legend, stations, doubt, site if len(site) else None)


def file_name(layer: Layer, suffix: str = ".png") -> str:
    """Return the name of its file, without what a file system may not like."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in layer.name) + suffix


def draw_layer(
    field: FieldMap, layer: Layer, path: Path, title: str, plan: FloorPlan | None = None
) -> None:
    """Save one layer, over a floor plan, in the format of the file's ending."""
    west, east, south, north = field.grid.extent
    width, height = (
        side / max(east - west, north - south) * INCHES for side in (east - west, north - south)
    )
    figure, axes = panels(
        max(width, 0.45 * INCHES) + 2.0, max(height, 0.4 * INCHES) + 1.2, grid=False
    )
    axis = axes[0, 0]
    nothing = np.where(field.refused, 1.0, np.nan)
    grey = ListedColormap(["0.82"])
    axis.imshow(nothing, origin="lower", extent=field.grid.extent, cmap=grey, zorder=1, alpha=0.6)
    legend, values = layer.legend, layer.values[np.isfinite(layer.values)]
    limits = {"vmin": legend.low, "vmax": legend.high}
    image = _cells(
        axis, field.grid, layer.values, plan, cmap=ListedColormap(layer.table()), **limits
    )
    if layer.words:
        _name_areas(axis, field.grid, layer)
    else:
        beyond = bool((values < legend.low).any()), bool((values > legend.high).any())
        ends = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(
            beyond, "neither"
        )
        figure.colorbar(image, ax=axis, shrink=0.85, pad=0.02, extend=ends, label=legend.label)
    if layer.unsure is not None:
        _hatch(axis, field, *layer.unsure)
    from_above.set_bounds(axis, (west, south), (east, north), field.grid.origin, title=title)
    draw_measured_places(axis, field)
    from_above.scale_bar(axis)
    if field.refused.any():
        axis.plot([], [], "s", color="0.82", label="too far from what was measured")
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


def _hatch(axis: Any, field: FieldMap, cells: np.ndarray, why: str) -> None:
    """Hatch cells (ny, nx) of a map; a map of a single row or column has no area to hatch."""
    if min(cells.shape) > 1:
        how: dict[str, Any] = {
            "hatches": ["", "////"],
            "levels": [-0.5, 0.5, 1.5],
            "colors": "none",
        }
        hatches = axis.contourf(field.grid.x, field.grid.y, cells.astype(float), zorder=2.5, **how)
        hatches.set(edgecolor="black", linewidth=0.0)
        axis.fill(
            [], [], facecolor="white", edgecolor="black", linewidth=0.0, hatch="////", label=why
        )


def _cells(
    axis: Any, grid: Grid, values: np.ndarray, plan: FloorPlan | None, **colours: Any
) -> Any:
    """Values (ny, nx) of cells, through which a plan beneath them is seen."""
    if plan is not None:
        draw_floor_plan(axis, plan)
    # Not "nearest", which vector formats draw at the screen's resolution.
    how = {"origin": "lower", "extent": grid.extent, "interpolation": "none", "zorder": 2}
    return axis.imshow(values, alpha=1.0 if plan is None else 0.65, **how, **colours)


def draw_floor_plan(axis: Any, plan: FloorPlan) -> None:
    """Draw the floor plan, where it lies."""
    height, width = plan.image.shape[:2]
    along, at = plan.scale, plan.shift  # rows go down: their step is -j times that of columns
    matrix = along.real, along.imag, along.imag, -along.real, at.real, at.imag
    turn = Affine2D.from_values(*matrix) + axis.transData
    axis.imshow(plan.image, extent=(0, width, height, 0), transform=turn, zorder=0, clip_on=True)


def draw_measured_places(axis: Any, field: FieldMap) -> None:
    """Mark measured points and stations; those outside the map are left out."""
    west, east, south, north = field.grid.extent
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


def draw_measurement_plan(
    batch: MeasurementPlan,
    path: Path,
    promise: Promise | None,
    predictor: Predictor | None,
    plan: FloorPlan | None,
) -> None:
    """Draw the expected error before and after, the chosen places, and how it falls."""
    west, east, south, north = batch.grid.extent
    wide, tall = np.array([east - west, north - south]) / max(east - west, north - south)
    figure, ((before, after, curve),) = panels(
        11 * max(wide, 0.5) + 4.5,
        5.0 * max(tall, 0.5) + 1.0,
        1,
        3,
        grid=False,
        width_ratios=[1, 1, 0.7],
    )
    errors = np.concatenate([batch.error_before, batch.error_after])
    # 99.5 %: a single corner far from all rows would flatten the rest.
    limits = {"vmin": float(errors.min()), "vmax": float(np.percentile(errors, 99.5)) + 1e-9}
    done = f"after these {len(batch.places)}"
    for axis, values, title in (
        (before, batch.error_before, "now"),
        (after, batch.error_after, done),
    ):
        image = np.full(batch.grid.inside.shape, np.nan)
        image[batch.grid.inside] = values
        mesh = _cells(axis, batch.grid, image, plan, cmap="cividis", **limits)
        from_above.set_bounds(axis, (west, south), (east, north), batch.grid.origin, title=title)
        from_above.scale_bar(axis)
    if promise is not None and predictor is not None:
        places = np.unique(promise.known[:, -3:-1], axis=0) + predictor.site.origin[:2]
        from_above.draw_measured(before, places)
    after.plot(*batch.path.T, color="red", linewidth=1, zorder=3)
    after.plot(
        *batch.places[:, :2].T, "o", color="red", markeredgecolor="white", markersize=6, zorder=3
    )
    for number, place in enumerate(batch.places[:60], 1):
        from_above.annotate(after, str(number), place[:2])
    figure.colorbar(mesh, ax=[before, after], label="expected error [dB]", shrink=0.8)
    curve.plot(np.append(batch.before_db, batch.expected_db[np.argsort(batch.chosen)]), ".-")
    curve.set(
        xlabel="places measured, the most telling first", ylabel="expected error over the area [dB]"
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
    figure.colorbar(dots, ax=axis, label=label, shrink=0.85)
    from_above.draw_stations(axis, placing.stations)
    from_above.draw_stations(
        axis, placing.places[0, :2], "best", marker="*", color="r", markersize=18
    )
    from_above.set_bounds(axis, (west, south), (east, north), placing.grid.origin)
    from_above.scale_bar(axis)
    from_above.legend_below(figure)
    save(figure, path, 100)
