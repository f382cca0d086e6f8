"""Draws `effort.png`: error over seconds of training by `effort`,
of `docs/results/fronts/effort.csv`.

python docs/images/effort.py

The rows are of `gsparc train -m effort=.1,.3,1,3,10` with one thread, one data set each.
"""

from __future__ import annotations

import csv
from pathlib import Path

from gsparc.pictures.drawing import panels, save, style_of

HERE = Path(__file__).parent
TABLE = HERE.parent / "results" / "fronts" / "effort.csv"


def main() -> None:
    """Read the table, draw a panel for each data set, write the picture."""
    with TABLE.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = list(dict.fromkeys(row["data"] for row in rows))
    figure, (axes,) = panels(10.5, 3.0, 1, len(names))
    for axis, name in zip(axes, names, strict=True):
        own = [row for row in rows if row["data"] == name]
        seconds, error = ([float(row[key]) for row in own] for key in ("processor_s", "error"))
        axis.plot(seconds, error, **style_of("gsparc").marked, markersize=6)
        for row, x, y in zip(own, seconds, error, strict=True):
            axis.annotate(row["effort"], (x, y), (4, 5), textcoords="offset points", fontsize=8)
        middle, least = sum(error) / len(error), float(own[0]["noise"])
        # A range that is not less than the noise: a flat front is to look flat.
        half = max(max(error) - min(error), 2 * least) * 0.7
        axis.set(
            title=name,
            xlabel="training, seconds of one processor",
            ylabel=own[0]["unit"],
            ylim=(middle - half, middle + half),
            xlim=(0, 1.15 * max(seconds)),
        )
    save(figure, HERE / "effort.png")


if __name__ == "__main__":
    main()
