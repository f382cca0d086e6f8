"""What an audit leaves behind: one page, a GeoTIFF, the way to drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gsparc.apps.maps.against_rows import drive_of
from gsparc.apps.maps.audit import DriveRows, count_draws_by_tour_end
from gsparc.apps.maps.claim import Claim
from gsparc.apps.maps.geotiff import raster_profile
from gsparc.base.files import whole_file, write_whole
from gsparc.data.schema import Measurements
from gsparc.evaluation.by_part import describe_parts
from gsparc.evaluation.table import Column, Table
from gsparc.pictures.drawing import panels
from gsparc.pictures.parts import draw_bias_by_part
from gsparc.pictures.report.page import Section, render_html, thumbnail_base64
from gsparc.processes.betting import ENOUGH

WIDE = "Intervals are wide enough for all parts at once."


def describe_verdict(verdict: str, count: int, table: pd.DataFrame, outside: bool) -> list[str]:
    """Return what a reader must know of `judge`; `outside`: the reachable area alone is judged."""
    missed, values = int((~table.reached).sum()), (table.low, table.high)
    where = " of the reachable area" if outside and missed else ""
    low, high = (float((table.weight * end).sum() / table.weight.sum()) for end in values)
    lines = [
        f"verdict{where}: {verdict} after {count} drawn places (wrong in 5 % of audits at most, "
        f"each way); mean value of {len(table)}, weighed, {low:.3f} to {high:.3f}"
    ]
    if missed:
        end = "are left out" if outside else "count against both verdicts"
        lines.append(f"{missed} drawn places have no row within reach, and {end}")
    return lines


def find_errors(
    data: Measurements, rows: DriveRows, claimed: np.ndarray, folder: Path
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return records of where claimed (n,) less measured levels [dB] are off, see `Drive.judge`,
    and lines; both are drawn.
    """
    error = np.where(rows.side == 0, claimed - rows.level, np.nan)
    drive = drive_of(data, np.arange(len(data)), error, np.full(len(error), np.nan), 0.9)
    parts = drive.judge()
    if not parts:
        return [], []
    words = "claim and drive", folder / "drive.png", "claimed less measured"
    draw_bias_by_part(drive, parts, *words)
    lines = [line.replace("predicted", "claimed") for line in describe_parts(parts, 0.9)]
    varied = claimed - claimed.mean()
    slope = float(varied @ rows.level) / max(float(varied @ varied), 1e-9)
    return parts, [*lines, f"measured over claimed levels: slope {slope:.2f}"]


def draw_capital(table: pd.DataFrame) -> Figure:
    """Return the capitals of `judge` over drawn places, with the ends of tours."""
    figure, axes = panels(7.0, 3.6)
    axis, ends = axes[0, 0], count_draws_by_tour_end(table)
    for name, capital in (("for", table.stands), ("against", table.falls)):
        axis.plot(np.r_[1.0, capital], "-o", markevery=list(ends), label=f"{name} the claim")
    axis.axhline(ENOUGH, color="black", linestyle="--", linewidth=0.8, label="enough")
    axis.set(yscale="log", xlabel="drawn places", ylabel="capital, read at the ends of tours")
    axis.legend()
    figure.set_label("Capital")
    return figure


def write_layers(path: Path, claim: Claim, layers: Mapping[str, np.ndarray]) -> None:
    """Write layers (M,) of a claim as float32 bands of a GeoTIFF, NaN elsewhere."""
    import rasterio

    profile = raster_profile(claim.grid, count=len(layers), dtype="float32", nodata=float("nan"))
    with whole_file(path) as partial, rasterio.open(partial, "w", **profile) as file:
        for number, (name, layer) in enumerate(layers.items(), 1):
            image = np.full(claim.grid.inside.shape, np.nan, np.float32)
            image[claim.grid.inside] = layer
            file.write(np.flipud(image), number)
            file.set_band_description(number, name)


def write_page(
    folder: Path,
    title: str,
    note: str,
    lines: Sequence[str],
    parts: Sequence[Mapping[str, Any]],
    figures: Sequence[Figure],
) -> None:
    """Write `audit.html`: what was said, where the claim is wrong, pictures."""
    heads = [Column(name, ".3g", of=name) for name in next(iter(parts), ())]
    tables = [Table.from_rows("Where it is wrong", heads, parts, note=WIDE)]
    file = folder / "drive.png"
    pictures = [("claimed less measured", thumbnail_base64(file))] if file.is_file() else []
    section = Section(title, pd.DataFrame(), list(lines), tables, list(figures), pictures)
    write_whole(folder / "audit.html", render_html("Audit of a map", note, [section]))
