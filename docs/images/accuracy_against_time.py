"""Draws `accuracy-against-time.png`: PSNR of every method over its training time and over its query time.

python docs/images/accuracy_against_time.py

Reads the rows of the RFID release, random split, in `docs/results/compare/compare.csv`
(written by `gsparc compare`).
"""

from __future__ import annotations

import csv
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

HERE = Path(__file__).parent
TABLE = HERE.parent / "results" / "compare" / "compare.csv"
DATASET, SPLIT = "rfid", "random"
SLOWEST_MS = 4.0  # queries beyond this are named at the edge

GROUPS = {  # label, colour, marker, size
    "ours": ("gsparc, the default of this repository", "#c1121f", "*", 19),
    "field": (
        "Gaussian fields trained by gradient: splat (settings of this repository), paper (published)",
        "#e07b00",
        "D",
        7,
    ),
    "published": ("other published methods, as implemented here", "#1d6fb8", "o", 7),
    "plain": ("interpolation and the mean spectrum", "#666666", "s", 7),
}
# Per method: group, label, and the label's offset from the point [points] in the left and in the right panel.
METHODS: dict[str, tuple[str, str, tuple[int, int], tuple[int, int]]] = {
    "gsparc": ("ours", "gsparc", (-4, 13), (-12, 9)),
    "splat": ("field", "splat", (9, 0), (8, -7)),
    "paper": ("field", "paper", (5, 10), (9, 4)),
    "swiftwrf": ("published", "SwiftWRF", (9, 5), (9, 5)),
    "wrfgs": ("published", "WRF-GS+", (9, -6), (9, -6)),
    "ngrf": ("published", "nGRF", (9, -6), (9, -7)),
    "nerf2": ("published", "NeRF2", (9, 5), (0, 0)),
    "gsrf": ("published", "GSRF", (9, -2), (-9, -2)),
    "gp": ("plain", "Gaussian process", (-9, 2), (10, 2)),
    "idw": ("plain", "inverse distance", (9, 0), (-9, 2)),
    "kriging": ("plain", "kriging", (9, 0), (-9, 0)),
    "nearest": ("plain", "nearest neighbour", (9, -3), (-9, 0)),
    "mean": ("plain", "mean spectrum", (9, 0), (9, 0)),
}


def main() -> None:
    """Read the table, draw both panels, write the picture."""
    with TABLE.open(encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if (r["dataset"], r["split"]) == (DATASET, SPLIT)]
    unknown = {r["method"] for r in rows} - METHODS.keys()
    if unknown:
        raise ValueError(f"{TABLE}: no place for the label of {', '.join(sorted(unknown))} in METHODS")
    figure = Figure(figsize=(11.5, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    training, query = figure.subplots(1, 2, sharey=True)
    for name, (group, text, beside_training, beside_query) in METHODS.items():
        own = sorted((r for r in rows if r["method"] == name), key=lambda r: float(r["budget_s"] or 0))
        label, colour, marker, size = GROUPS[group]
        if name == "gsparc":
            own = own[:1]  # a longer budget changes nothing
        look = {"color": colour, "marker": marker, "markersize": size, "linewidth": 1, "capsize": 2}
        scores = [float(r["score_db"]) for r in own]
        spreads = [float(r["spread_db"] or 0) for r in own]
        seconds = [float(r["train_cpu_s"]) for r in own]
        training.errorbar(seconds, scores, spreads, **look)
        _say(training, text, (seconds[-1], scores[-1]), beside_training, colour, bold=group == "ours")
        milliseconds = float(own[-1]["query_ms"])
        if milliseconds > SLOWEST_MS:
            query.annotate(
                f"{text}: {milliseconds:,.0f} ms",
                (SLOWEST_MS, scores[-1]),
                (-45, 0),
                textcoords="offset points",
                ha="right",
                va="center",
                arrowprops={"arrowstyle": "->", "color": colour},
                **_text(colour),
            )
        else:
            query.errorbar([milliseconds], scores[-1:], spreads[-1:], **look)
            _say(query, text, (milliseconds, scores[-1]), beside_query, colour, bold=group == "ours")
    for label, colour, marker, size in GROUPS.values():
        training.plot([], [], marker, color=colour, markersize=min(size, 13), label=label)
    training.set(xlim=(2e-4, 8e3), ylim=(15, 30.3), ylabel="PSNR of 32 test spectra [dB], higher is better")
    training.set_xlabel("training, processor seconds (lines join 60 s and 300 s)")
    query.set_xlim(0.02, SLOWEST_MS)
    query.set_xlabel("one query, milliseconds (median)")
    for axis in (training, query):
        axis.set_xscale("log")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.25)
    query.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    query.xaxis.set_major_formatter("{x:g}")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9.5, frameon=False)
    figure.savefig(HERE / "accuracy-against-time.png", dpi=110)


def _text(colour: str, *, bold: bool = False) -> dict[str, object]:
    return {"color": colour, "fontsize": 12 if bold else 9, "fontweight": "bold" if bold else "normal"}


def _say(
    axis, text: str, point: tuple[float, float], beside: tuple[int, int], colour: str, *, bold: bool
) -> None:
    side = "left" if beside[0] > 0 else "right"
    axis.annotate(
        text, point, beside, textcoords="offset points", ha=side, va="center", **_text(colour, bold=bold)
    )


if __name__ == "__main__":
    main()
