"""Pictures of docs/scale.md from the tables that bench/scale.py wrote."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsparc.evaluation.drawing import logarithmic, look, panels, save

MANY = 10_000  # rows from which slopes are taken: fewer are of exact methods, or too quick to time
PANELS = (
    ("fit_cpu_s", "processor seconds of a fit"), ("query_cpu_ms", "processor ms of one query"),
    ("peak_gb", "peak memory, data included [GB]"), ("rmse", "rmse [dB], bars of two standard errors"),
)  # fmt: skip
Line = dict[str, str]


def slope(lines: Sequence[Line], figure: str) -> float:
    """Of a figure against rows, both as logarithms, least squares from `MANY` rows on; NaN of one point."""
    points = [(float(one["rows"]), float(one[figure])) for one in lines if float(one["rows"]) >= MANY]
    if len(points) < 2:
        return float("nan")
    rows, values = np.log10(np.array(points)).T
    return float(np.polyfit(rows, values, 1)[0])


def draw(tables: Path, pictures: Path) -> None:
    """A picture of powers for each source that was measured."""
    with (tables / "powers.csv").open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    for source in dict.fromkeys(one["source"] for one in lines):
        figure, axes = panels(9.0, 6.4, 2, 2)
        for name in dict.fromkeys(one["method"] for one in lines if one["source"] == source):
            own = sorted(
                (one for one in lines if (one["source"], one["method"]) == (source, name)),
                key=lambda one: int(one["rows"]),
            )
            colour, mark = look(name)
            for place, (quantity, title) in zip(axes.flat, PANELS, strict=True):
                rows, values = (np.array([float(one[key]) for one in own]) for key in ("rows", quantity))
                errors = None
                label = name
                if quantity == "rmse":
                    errors = [2 * float(one["rmse_error"]) for one in own]
                elif quantity == "fit_cpu_s":
                    found = slope(own, quantity)
                    label = name if np.isnan(found) else f"{name}, slope {found:.2f}"
                place.errorbar(rows, values, errors, color=colour, marker=mark, label=label, capsize=2)
                place.set_title(title)
                place.set_xlabel("rows")
                place.set_yscale("log" if quantity != "peak_gb" else "linear")
                logarithmic(place, fine=False)
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        save(figure, pictures / f"scale-{source}.png")
