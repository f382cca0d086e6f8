"""Pictures of docs/scale.md from the tables that bench/scale.py wrote."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
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
Line = dict[str, str]


def slope(lines: Sequence[Line], figure: str) -> float:
    """Of a figure against rows, both as logarithms, least squares from `MANY` rows on; NaN of one point."""
    points = [(float(one["rows"]), float(one[figure])) for one in lines if float(one["rows"]) >= MANY]
    if len(points) < 2:
        return float("nan")
    rows, values = np.log10(np.array(points)).T
    return float(np.polyfit(rows, values, 1)[0])


def draw(tables: Path, pictures: Path) -> None:
    """A picture for each source that was measured."""
    for kind, shown in PANELS.items():
        lines = _read(tables / f"{kind}.csv")
        for source in dict.fromkeys(one["source"] for one in lines):
            own = [one for one in lines if one["source"] == source]
            figure, places = panels(9.0, 6.4, 2, 2)
            for place, (quantity, title) in zip(places.flat, shown, strict=True):
                _curves(place, own, quantity)
                place.set_title(title)
                place.set_xlabel("rows")
                place.set_yscale("linear" if quantity.endswith("gb") else "log")
                logarithmic(place, fine=False)
            figure.legend(*places[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
            save(figure, pictures / f"scale-{source}.png")


def _read(path: Path) -> list[Line]:
    if not path.exists():
        return []
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _curves(place: Axes, lines: Sequence[Line], quantity: str) -> None:
    """A figure of every method against rows; slopes of seconds stand in the legend."""
    for name in dict.fromkeys(one["method"] for one in lines):
        own = sorted((one for one in lines if one["method"] == name), key=lambda one: int(one["rows"]))
        counts, values = (np.array([float(one[key]) for one in own]) for key in ("rows", quantity))
        errors = [2 * float(one["rmse_error"]) for one in own] if quantity == "rmse" else None
        found = slope(own, quantity) if quantity == "fit_cpu_s" else float("nan")
        label = name if np.isnan(found) else f"{name}, slope {found:.2f}"
        place.errorbar(counts, values, errors, label=label, capsize=2, **look(name).marked)
