"""Where predictions are off, in one picture: cells and rings as bars, areas on a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Rectangle

from gsparc.evaluation.by_part import Drive
from gsparc.pictures.drawing import GREY, PALETTE, colour_bar, save
from gsparc.pictures.from_above import map_panels, scale_bar, set_bounds, split_frame

LEAST_DB = 3.0  # end of the colours
LINE = 0.3  # inches of a bar


def draw_bias_by_part(
    drive: Drive,
    rows: Sequence[dict[str, Any]],
    title: str,
    path: Path,
    what: str = "predicted less measured",
) -> None:
    """Save bias with its interval by cell and ring, and by area, as `Drive.judge` has them;
    axes say `what` it is.
    """
    bars = [row for row in rows if row["part"] != "area"][::-1]
    areas = [row for row in rows if row["part"] == "area"]
    frames, side = split_frame(drive.place, drive.area_m / 4), drive.area_m
    figure, (axes,), room = map_panels(frames, 1, 4.5, LINE * len(bars) + 2.0)
    error = drive.error_db[np.isfinite(drive.error_db)]
    most = max(LEAST_DB, float(np.quantile(np.abs(error), 0.9)))
    for axis, (low, high) in zip(axes, frames, strict=True):
        marks = axis.scatter(
            *drive.place.T,
            s=5,
            linewidths=0,
            c=drive.error_db,
            cmap="RdBu_r",
            vmin=-most,
            vmax=most,
        )
        set_bounds(axis, low, high)
        for row in areas:
            middle = np.array(row["name"].split(), float)
            colour = marks.cmap(marks.norm(row["bias_db"]))
            axis.add_patch(
                Rectangle(
                    tuple(middle - side / 2),
                    side,
                    side,
                    facecolor=colour,
                    alpha=0.5,
                    edgecolor="0.6",
                    zorder=0,
                )
            )
            if (middle > low).all() and (middle < high).all():
                text = f"{row['bias_db']:+.1f}"
                ground = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.6}
                at = {"ha": "center", "va": "center", "fontsize": "x-small", "bbox": ground}
                axis.text(*middle, text, **at)
        scale_bar(axis)
    colour_bar(marks, axes, f"{what} [dB]", extend="both")
    curve, number = figure.add_subplot(room), np.arange(len(bars))
    bias = np.array([row["bias_db"] for row in bars])
    ends = np.array([[row["bias_low_db"], row["bias_high_db"]] for row in bars]).reshape(-1, 2)
    reach = np.nan_to_num(np.abs(ends - bias[:, None]), posinf=0.0).T
    curve.barh(number, bias, xerr=reach, color=PALETTE[0], alpha=0.6, ecolor=GREY, capsize=2)
    wide = 1.2 * max(LEAST_DB, np.abs(bias).max(), np.median(reach))
    curve.set_xlim(-wide, wide)  # intervals of few squares leave the picture
    curve.axvline(0, color="black", linewidth=0.8)
    names = [
        f"{row['part']} {row['name']}".strip()
        + f", {row['rows']} rows\nrmse {row['rmse_db']:.1f} dB"
        + ("" if row["within"] is None else f", {row['within']:.0%} within")
        for row in bars
    ]
    curve.set_yticks(number, names, fontsize="x-small")
    curve.set(xlabel=f"mean of {what} [dB]", title="by cell and by distance")
    curve.grid(axis="x", alpha=0.3)
    figure.suptitle(title)
    save(figure, path, 100)
