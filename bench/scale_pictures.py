"""Pictures of docs/scale.md from the tables that bench/scale.py wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from gsparc.evaluation.drawing import logarithmic, look, panels, save

MANY = 10_000  # rows from which slopes are taken: fewer are of exact methods, or too quick to time
FIT, QUERY = ("fit_cpu_s", "processor seconds of a fit"), ("query_cpu_ms", "processor ms of one query")
PANELS = {
    "powers": (
        FIT, QUERY, ("peak_gb", "peak memory, data included [GB]"),
        ("rmse", "rmse [dB], bars of two standard errors"),
    ),
}  # fmt: skip


def slope(lines: pd.DataFrame, figure: str) -> float:
    """Return the slope of a figure over rows, both as logarithms, from `MANY` rows on; NaN of one point."""
    many = lines[lines["rows"] >= MANY]
    if len(many) < 2:
        return float("nan")
    return float(np.polyfit(np.log10(many["rows"]), np.log10(many[figure]), 1)[0])


def draw(tables: Path, pictures: Path) -> None:
    """Save a picture for each source that was measured."""
    for kind, quantities in PANELS.items():
        path = tables / f"{kind}.csv"
        for source, own in pd.read_csv(path).groupby("source", sort=False) if path.exists() else ():
            figure, places = panels(9.0, 6.4, 2, 2)
            for place, (quantity, title) in zip(places.flat, quantities, strict=True):
                _curves(place, own, quantity)
                place.set_title(title)
                place.set_xlabel("rows")
                place.set_yscale("linear" if quantity.endswith("gb") else "log")
                logarithmic(place, fine=False)
            figure.legend(*places[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
            save(figure, pictures / f"scale-{source}.png")


def _curves(place: Axes, lines: pd.DataFrame, quantity: str) -> None:
    """A figure of every method against rows; slopes of seconds stand in the legend."""
    for name, own in lines.sort_values("rows", kind="stable").groupby("method", sort=False):
        # Two standard errors, about 95 %.
        errors = 2 * own["rmse_error"] if quantity == "rmse" else None
        exponent = slope(own, quantity) if quantity == "fit_cpu_s" else float("nan")
        label = name if np.isnan(exponent) else f"{name}, slope {exponent:.2f}"
        place.errorbar(own["rows"], own[quantity], errors, label=label, capsize=2, **look(name).marked)
