"""What an audit leaves behind: one page, a GeoTIFF, the way to drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gsparc.apps.maps.audit import DriveRows, Outcome
from gsparc.apps.maps.claim import Claim
from gsparc.apps.maps.geojson import write_shapes
from gsparc.apps.maps.geotiff import raster_profile
from gsparc.apps.maps.pictures import draw_cells
from gsparc.base.files import whole_file, write_whole
from gsparc.evaluation.table import Column, Table
from gsparc.models.powers.groups import number_squares
from gsparc.pictures import from_above
from gsparc.pictures.drawing import colour_bar, panels, save
from gsparc.pictures.report.page import Section, encode_picture, render_html
from gsparc.processes.betting import ENOUGH
from gsparc.processes.uncertainty import half_width

SQUARES = 40  # of rows that err together, along the longer side


def fit_line(
    place: np.ndarray, claimed: np.ndarray, level: np.ndarray
) -> tuple[float, float] | None:
    """Return the slope of measured over claimed levels (n,), and half its 90 % interval; None of
    too few rows, or of one claimed level.

    Rows of a square of floor err together.
    """
    known = np.isfinite(claimed) & np.isfinite(level)
    square = number_squares(np.pad(place[known], ((0, 0), (0, 1))), SQUARES)
    centred, value = claimed[known] - claimed[known].mean(), level[known] - level[known].mean()
    count, wide = len(np.unique(square)), float(centred @ centred)
    if count < 3 or wide <= 0:
        return None
    slope = float(centred @ value) / wide
    sums = np.bincount(square, centred * (value - slope * centred))
    error = float(np.sqrt(count / (count - 1) * (sums**2).sum())) / wide
    return slope, half_width(0.9, count - 2) * error


def draw_capital(outcome: Outcome) -> Figure:
    """Return the capital of both bets over drawn places, with the ends of tours."""
    figure, axes = panels(7.0, 3.6)
    axis = axes[0, 0]
    count = np.arange(len(outcome.stands) + 1)
    for name, path in (("for", outcome.stands), ("against", outcome.falls)):
        (line,) = axis.plot(count, np.r_[1.0, path], label=f"{name} the claim")
        axis.plot(outcome.ends, path[outcome.ends - 1], "o", color=line.get_color())
    axis.axhline(ENOUGH, color="black", linestyle="--", linewidth=0.8, label="enough")
    axis.set(yscale="log", xlabel="drawn places", ylabel="capital, read at the ends of tours")
    axis.legend()
    figure.set_label("Capital")
    return figure


def draw_audit(
    claim: Claim,
    chance: np.ndarray | None,
    draws: pd.DataFrame | None,
    rows: DriveRows | None,
    path: Path,
) -> None:
    """Save a map of what is in doubt, else of what is claimed, with drawn places and rows."""
    values = np.full(claim.grid.inside.shape, np.nan)
    shown = claim.grid.inside.sum() == len(claim) and chance is not None
    values[claim.grid.inside] = chance if shown else 0.0
    frames = from_above.split_frame(claim.grid.places()[:, :2], claim.step / 2)
    figure, (axes,), _ = from_above.map_panels(frames)
    for axis, (low, high) in zip(axes, frames, strict=True):
        image = draw_cells(axis, claim.grid, values, None, cmap="cividis", vmin=0.0, vmax=1.0)
        if rows is not None:
            axis.plot(*rows.place.T, ".", color="0.5", markersize=2, label="rows", zorder=3)
        if draws is not None:
            at = claim.place[draws.place]
            axis.scatter(*at.T, c=draws.tour, cmap="autumn", s=14, label="drawn", zorder=4)
        from_above.set_bounds(axis, low, high, claim.origin)
        from_above.scale_bar(axis)
    if shown:
        colour_bar(image, axes, "chance of failing, by the model")
    from_above.legend_below(figure)
    save(figure, path, 100)


def write_audit_tiff(path: Path, claim: Claim, layers: Mapping[str, np.ndarray]) -> None:
    """Write layers (M,) of the squares of a claim as float32 bands, NaN elsewhere."""
    import rasterio

    profile = raster_profile(claim.grid, count=len(layers), dtype="float32", nodata=float("nan"))
    with whole_file(path) as partial, rasterio.open(partial, "w", **profile) as file:
        for number, (name, layer) in enumerate(layers.items(), 1):
            values = np.full(claim.grid.inside.shape, np.nan)
            values[claim.grid.inside] = layer
            file.write(np.flipud(values).astype(np.float32), number)
            file.set_band_description(number, name)


def write_ways(path: Path, claim: Claim, draws: pd.DataFrame, ways: Sequence[np.ndarray]) -> None:
    """Write new tours for a phone or a GIS: ways as lines, stops as points."""

    def corners(places: np.ndarray) -> list[list[float]]:
        columns = claim.coordinates(places)
        names = ("longitude", "latitude") if "longitude" in columns else ("x", "y")
        return np.column_stack([columns[name] for name in names]).tolist()

    shapes: list[tuple[dict[str, Any], Any]] = [
        ({"type": "LineString", "coordinates": corners(way)}, {"tour": int(tour)})
        for tour, way in zip(draws.tour.unique(), ways, strict=True)
        if len(way) > 1
    ]
    for at, tour, stop in zip(
        corners(claim.place[draws.place]), draws.tour.tolist(), draws.stop.tolist(), strict=True
    ):
        shapes.append(({"type": "Point", "coordinates": at}, {"tour": tour, "stop": stop}))
    write_shapes(path, shapes)


def write_page(
    folder: Path,
    title: str,
    note: str,
    lines: Sequence[str],
    facts: Mapping[str, Any],
    parts: Sequence[Mapping[str, Any]],
    figures: Sequence[Figure],
) -> None:
    """Write `audit.html`: verdict, figures that repeat it, where the claim is wrong, pictures."""
    told = [Column("what", ""), Column("value", "")]
    tables = [Table("Facts", told, [[name, value] for name, value in facts.items()])]
    if parts:
        columns = [Column(name, ".3g", of=name) for name in parts[0]]
        wide = "intervals are wide enough for all parts at once"
        tables.append(Table.from_rows("Where it is wrong", columns, parts, note=wide))
    pictures = [
        (name, encode_picture(folder / name))
        for name in ("audit.png", "drive.png")
        if (folder / name).is_file()
    ]
    section = Section(title, pd.DataFrame(), list(lines), tables, list(figures), pictures)
    write_whole(folder / "audit.html", render_html("Audit of a map", note, [section]))
