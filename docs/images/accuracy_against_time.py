"""Draws `accuracy-against-time.png`: PSNR of every method over its training time and query time.

python docs/images/accuracy_against_time.py

Reads the RFID release's random split of `docs/results/table.csv` (docs/table.md says which
command); a line joins efforts. Queries of what ran for hours were not timed in turns
with the others, and are not drawn.
"""

from __future__ import annotations

import csv
from pathlib import Path

from gsparc.pictures.drawing import panels, save, set_log_axis, style_of

HERE = Path(__file__).parent
TABLE = HERE.parent / "results" / "table.csv"
# Per method: its name in the literature, and the label's offset from the point [points] in the left
# and the right panel.
METHODS: dict[str, tuple[str, tuple[int, int], tuple[int, int]]] = {
    "gsparc": ("gsparc", (-10, 10), (-10, 10)),
    "gp": ("Gaussian process", (-8, 0), (9, 2)),
    "idw": ("inverse distance", (8, 0), (-8, 0)),
    "kriging": ("kriging", (8, 2), (8, 8)),
    "nearest": ("nearest neighbour", (8, -11), (-8, -3)),
    "mean": ("mean spectrum", (8, 0), (8, 0)),
    "swiftwrf": ("SwiftWRF", (8, 6), (8, 6)),
    "wrfgs": ("WRF-GS+", (8, -6), (8, -8)),
    "ngrf": ("nGRF", (8, 0), (-8, 0)),
    "full_size_ngrf": ("nGRF (full size)", (8, 0), (-8, 0)),
    "gsrf": ("GSRF", (8, 0), (-8, 0)),
    "full_size_gsrf": ("GSRF (full size)", (8, 0), (-8, 0)),
    "nerf2": ("NeRF2", (8, 0), (-8, 0)),
    "paper": ("GSpaRC, as published", (8, 0), (-8, 0)),
}


def main() -> None:
    """Read the table, draw both panels, write the picture."""
    with TABLE.open(encoding="utf-8") as file:
        every = csv.DictReader(file)
        rows = [row for row in every if (row["dataset"], row["split"]) == ("rfid", "random")]
    unknown = {r["method"] for r in rows} - METHODS.keys()
    if unknown:
        raise ValueError(
            f"{TABLE}: no place for the label of {', '.join(sorted(unknown))} in METHODS"
        )
    figure, (axes,) = panels(9.0, 4.2, 1, 2, sharey=True)
    for name in dict.fromkeys(row["method"] for row in rows):
        text, *beside = METHODS[name]
        own = sorted(
            (r for r in rows if r["method"] == name), key=lambda row: float(row["effort"] or 0)
        )
        style, ours = style_of(name), name == "gsparc"
        for axis, cost, (right, up) in zip(axes, ("train_cpu_s", "query_ms"), beside, strict=True):
            # In the order of efforts: a busy core makes a larger one seem quicker.
            places = [
                (max(float(row[cost]), 1e-3), float(row["score_db"]))
                for row in own
                if row.get(cost)
            ]
            if not places:
                continue
            axis.plot(*zip(*places, strict=True), **style.marked, markersize=15 if ours else 7)
            axis.annotate(
                text,
                places[-1],
                (right, up),
                textcoords="offset points",
                ha="left" if right > 0 else "right",
                va="center",
                color=style.colour,
                fontsize=12 if ours else 9.5,
                fontweight="bold" if ours else None,
            )
    labels = ("training, seconds of one processor", "one query [ms], one thread")
    for axis, label, limits in zip(axes, labels, ((3e-4, 1e6), (0.01, 5000)), strict=True):
        axis.set(xlabel=label, xlim=limits, ylim=(13, 30.5))
        set_log_axis(axis, 0)
    axes[0].set_ylabel("PSNR of 32 test spectra [dB]")
    save(figure, HERE / "accuracy-against-time.png")


if __name__ == "__main__":
    main()
