"""A PNG of every layer of a map: floor plan beneath, measured points, stations, scale bar."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap
from matplotlib.transforms import Affine2D

from gsparc.evaluation.drawing import panels, save
from gsparc.evaluation.from_above import (
    OUTLINE,
    annotate,
    bounded,
    draw_measured,
    draw_stations,
    legend_below,
    scale_bar,
)
from gsparc.maps.area import Grid
from gsparc.maps.field_map import FieldMap
from gsparc.maps.floor_plan import FloorPlan
from gsparc.maps.placing import Placing
from gsparc.maps.planning import Plan
from gsparc.maps.promise import Promise
from gsparc.prediction.predictor import Predictor

GREY = (170, 170, 170)  # of values that are not known
INCHES = 7.0  # longer side of the map
NAMED = 15  # stations; of more only their marks are drawn
UNSURE = "hatched: less likely than not the strongest and above its floor"


@dataclass(frozen=True)
class Legend:
    """What colours mean: from `low` to `high` of `label`, in a matplotlib colour map."""

    label: str
    low: float
    high: float
    colours: str = "viridis"

    def of(self, values: np.ndarray) -> np.ndarray:
        """Colours (..., 3) uint8 of values (...); grey where they are not finite."""
        with np.errstate(invalid="ignore"):
            share = np.clip((values - self.low) / max(self.high - self.low, 1e-30), 0, 1)
        known = np.isfinite(values)
        found = np.round(255 * colormaps[self.colours](np.where(known, share, 0.0))[..., :3]).astype(np.uint8)
        found[~known] = GREY
        return found

    @classmethod
    def over(cls, label: str, values: np.ndarray, colours: str = "viridis") -> Legend:
        """From the 1 to the 99 % quantile of those values that are finite."""
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 1.0)
        return cls(label, float(low), float(high if high > low else low + 1.0), colours)

    def strip(self) -> np.ndarray:
        """Colours (16, 3) uint8 from low to high."""
        return self.of(np.linspace(self.low, self.high, 16))


@dataclass(frozen=True)
class Layer:
    """A layer as it is drawn.

    Attributes:
        name: of its file and its button.
        values: (ny, nx) float, NaN where nothing is said.
        legend: what its colours mean, with the unit.
        words: names of whole numbers, for a layer of classes.
        unsure: (ny, nx) bool, cells that are hatched, and why; None: none.
    """

    name: str
    values: np.ndarray
    legend: Legend
    words: tuple[str, ...] = ()
    unsure: tuple[np.ndarray, str] | None = None

    def table(self) -> np.ndarray:
        """Colours (n, 4) from the lower to the upper end of the legend: of each class, or 256."""
        if not self.words:
            return colormaps[self.legend.colours](np.linspace(0, 1, 256))
        count = len(self.words)
        return np.asarray(colormaps["tab10" if count <= 10 else "tab20"](np.arange(count) % 20))


def layers(found: FieldMap, unit: str = "dB") -> Iterator[Layer]:
    """Every layer of a map that says something; of several stations, also the power of each, in `unit`."""
    several = len(found.stations) > 1
    of = " of the strongest station" if several else ""
    layer = found.layer("power_db")
    yield Layer("power", layer, Legend.over(f"received power{of} [{unit}]", layer))
    if several:
        doubt = (found.unsure, UNSURE) if found.unsure.any() else None
        legend = Legend("strongest station", -0.5, len(found.stations) - 0.5)
        yield Layer("best_server", found.layer("best_server"), legend, found.stations, doubt)
    if np.isfinite(found.sinr_db).any():
        label = "signal over interference and noise [dB]"
        yield Layer("sinr", found.sinr_db, Legend.over(label, found.sinr_db))
    label = f"probability of less than {found.threshold_db:g} {unit}"
    yield Layer("outage", found.outage, Legend(label, 0.0, 1.0, "magma_r"))
    error, width = found.layer("expected_error_db"), found.strongest(found.upper_db - found.lower_db)
    yield Layer("expected_error", error, Legend.over("expected error [dB]", error, "cividis"))
    label = f"width of the {found.share:.0%} interval [dB]"
    yield Layer("width", width, Legend.over(label, width, "cividis"))
    if "delay_spread_ns" in found.extra:
        layer = found.extra["delay_spread_ns"]
        yield Layer("delay_spread_ns", layer, Legend.over("delay spread [ns]", layer, "plasma"))
    if "direction_deg" in found.extra:
        legend = Legend("azimuth of the strongest path [degrees]", -180.0, 180.0, "twilight")
        yield Layer("direction_deg", found.extra["direction_deg"], legend)
    for name, layer in zip(found.stations, found.power_db, strict=True) if several else ():
        if np.isfinite(layer).any():
            yield Layer(f"power {name}", layer, Legend.over(f"received power of {name} [{unit}]", layer))


def file_name(layer: Layer) -> str:
    """Of its PNG, without what a file system may not like."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in layer.name) + ".png"


def draw_layer(found: FieldMap, layer: Layer, path: Path, title: str, plan: FloorPlan | None = None) -> None:
    """Save one layer as PNG, over a floor plan."""
    left, right, low, high = found.grid.extent
    width, height = (side / max(right - left, high - low) * INCHES for side in (right - left, high - low))
    figure, axes = panels(max(width, 0.45 * INCHES) + 2.0, max(height, 0.4 * INCHES) + 1.2, grid=False)
    axis = axes[0, 0]
    nothing = np.where(found.refused, 1.0, np.nan)
    grey = ListedColormap(["0.82"])
    axis.imshow(nothing, origin="lower", extent=found.grid.extent, cmap=grey, zorder=1, alpha=0.6)
    legend, known = layer.legend, layer.values[np.isfinite(layer.values)]
    limits = {"vmin": legend.low, "vmax": legend.high}
    drawn = _cells(axis, found.grid, layer.values, plan, cmap=ListedColormap(layer.table()), **limits)
    ends = "both" if ((known < legend.low) | (known > legend.high)).any() else "neither"
    bar = figure.colorbar(drawn, ax=axis, shrink=0.85, pad=0.02, extend=ends, label=legend.label)
    if layer.words:
        bar.set_ticks(list(range(len(layer.words))), labels=layer.words)
    if layer.unsure is not None:
        _hatch(axis, found, *layer.unsure)
    bounded(axis, (left, low), (right, high), title=title)
    draw_places(axis, found)
    scale_bar(axis)
    if found.refused.any():
        axis.plot([], [], "s", color="0.82", label="too far from what was measured")
    legend_below(figure)
    save(figure, path, 110)


def _hatch(axis: Any, found: FieldMap, cells: np.ndarray, why: str) -> None:
    """Hatch cells (ny, nx) of a map; a map of a single row or column has no area to hatch."""
    if min(cells.shape) > 1:
        how: dict[str, Any] = {"hatches": ["", "////"], "levels": [-0.5, 0.5, 1.5], "colors": "none"}
        drawn = axis.contourf(found.grid.x, found.grid.y, cells.astype(float), zorder=2.5, **how)
        drawn.set(edgecolor="black", linewidth=0.0)
        axis.fill([], [], facecolor="white", edgecolor="black", linewidth=0.0, hatch="////", label=why)


def _cells(axis: Any, grid: Grid, values: np.ndarray, plan: FloorPlan | None, **colours: Any) -> Any:
    """Values (ny, nx) of cells, through which a plan beneath them is seen."""
    if plan is not None:
        draw_plan(axis, plan)
    how = {"origin": "lower", "extent": grid.extent, "interpolation": "nearest", "zorder": 2}
    return axis.imshow(values, alpha=1.0 if plan is None else 0.65, **how, **colours)


def draw_plan(axis: Any, plan: FloorPlan) -> None:
    """The floor plan, where it lies."""
    height, width = plan.image.shape[:2]
    a, b, c, d, e, f = plan.matrix()
    turn = Affine2D.from_values(a, b, c, d, e, f) + axis.transData
    axis.imshow(plan.image, extent=(0, width, height, 0), transform=turn, zorder=0, clip_on=True)


def draw_places(axis: Any, found: FieldMap) -> None:
    """Measured points and stations; those outside the map are left out."""
    left, right, low, high = found.grid.extent
    draw_measured(axis, found.places)
    known = found.station_place
    inside = (known >= [left, low]).all(1) & (known <= [right, high]).all(1)
    if inside.any():
        draw_stations(axis, known[inside])
    if 1 < len(known) <= NAMED:
        for where, name in zip(known[inside], np.array(found.stations)[inside], strict=True):
            annotate(axis, name, where)


def draw_plan_picture(
    found: Plan, path: Path, promise: Promise | None, predictor: Predictor | None, plan: FloorPlan | None
) -> None:
    """Expected error before and after, the chosen places, and how it falls."""
    left, right, low, high = found.grid.extent
    wide = (right - left) / max(right - left, high - low)
    tall = (high - low) / max(right - left, high - low)
    figure, ((before, after, curve),) = panels(
        11 * max(wide, 0.5) + 4.5, 5.0 * max(tall, 0.5) + 1.0, 1, 3, grid=False, width_ratios=[1, 1, 0.7]
    )
    errors = np.concatenate([found.error_before, found.error_after])
    limits = {"vmin": float(errors.min()), "vmax": float(np.percentile(errors, 99.5)) + 1e-9}
    for axis, values, title in ((before, found.error_before, "before"), (after, found.error_after, "after")):
        image = np.full(found.grid.shape, np.nan)
        image[found.grid.inside] = values
        drawn = _cells(axis, found.grid, image, plan, cmap="cividis", **limits)
        bounded(axis, (left, low), (right, high), ylabel="", title=title)
        scale_bar(axis)
    if promise is not None and predictor is not None:
        places = np.unique(promise.known[:, -3:-1], axis=0) + predictor.site.origin[:2]
        draw_measured(before, places)
    how: dict[str, Any] = {"marker": "o", "color": "red", "markeredgecolor": "white", "markersize": 6}
    after.plot(*found.places[:, :2].T, linestyle="-" if found.walk else "", linewidth=1, zorder=3, **how)
    for number, place in enumerate(found.places[:60], 1):
        after.annotate(str(number), place[:2], xytext=(4, 3), textcoords="offset points", fontsize="x-small",
                       path_effects=OUTLINE, zorder=4)  # fmt: skip
    figure.colorbar(drawn, ax=[before, after], label="expected error [dB]", shrink=0.8)
    curve.plot(np.append(found.before_db, found.expected_db[np.argsort(found.chosen)]), ".-")
    curve.set(xlabel="places measured, the most telling first", ylabel="expected error over the area [dB]")
    curve.set_ylim(bottom=0)  # what the walk gains is seen beside what is left
    curve.grid(alpha=0.3)
    save(figure, path, 100)


def draw_placing(found: Placing, path: Path, threshold_db: float, unit: str = "dB") -> None:
    """The goal at every candidate, the stations that stand, and the best place."""
    left, right, low, high = found.grid.extent
    figure, ((axis,),) = panels(8.5, 6.5 * max((high - low) / (right - left), 0.5) + 1.0, grid=False)
    label = f"share of the area with {threshold_db:g} {unit} or more"
    label = label if found.what == "coverage" else f"power that nine tenths of the area exceed [{unit}]"
    drawn = axis.scatter(*found.places[:, :2].T, c=found.goal, s=60, marker="s", cmap="viridis")
    figure.colorbar(drawn, ax=axis, label=f"{label}, with a station here", shrink=0.85)
    draw_stations(axis, found.stations)
    draw_stations(axis, found.places[0, :2], "best", marker="*", color="r", markersize=18)
    bounded(axis, (left, low), (right, high))
    scale_bar(axis)
    legend_below(figure)
    save(figure, path, 100)
