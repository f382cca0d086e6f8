"""Draw a new place and a left-out carrier of a room (with `freq.txt`):
`python docs/images/bands.py ROOM`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.load import load, split_for
from gsparc.models.baselines.idw import InverseDistance
from gsparc.models.carriers.method import CarrierField
from gsparc.models.carriers.plain import DirectBeam, OtherCarriers
from gsparc.models.method import Method
from gsparc.models.per_station import PerStation
from gsparc.training.context import FitContext

OUT = Path(__file__).parent / "bands.png"
METHODS = {
    "gsparc": CarrierField,
    "other carriers": OtherCarriers,
    "direct beam": DirectBeam,
    "idw": lambda: PerStation(InverseDistance()),
}
CARRIERS = (1, 5, 8)  # of a new place


def fit(data: Measurements, fold: Fold) -> dict[str, Method]:
    """Fit every method that can answer all rows of the test."""
    fits = {}
    for name, make in METHODS.items():
        method = make()
        try:
            method.fit(data, fold, FitContext(Path()))
        except ValueError:  # a carrier without rows
            continue
        fits[name] = method
    return fits


def draw_images(
    axes: np.ndarray, data: Measurements, row: int, fits: dict[str, Method], title: str
) -> None:
    """Draw what was measured in a row, and what methods predict, with their errors."""
    batch = data.batch(np.array([row]))
    images = {"measured": batch.target[0]}
    images |= {name: method.predict(batch).mean[0] for name, method in fits.items()}
    for axis, name in zip(axes, ("measured", *METHODS), strict=True):
        axis.set_xticks([]), axis.set_yticks([])
        if name not in images:
            axis.text(
                0.5,
                0.5,
                "knows no such carrier",
                ha="center",
                va="center",
                transform=axis.transAxes,
            )
            continue
        error = float((images[name] - batch.target[0]).square().mean())
        axis.imshow(images[name], vmin=0, vmax=1, cmap="viridis", aspect="auto", origin="lower")
        axis.set_title(title if name == "measured" else f"{name}, MSE {error:.3f}", fontsize=8)


def draw_plan(axis: plt.Axes, data: Measurements, fold: Fold, field: CarrierField) -> None:
    """Draw places, the receiver and the mirrors that were found, from above."""
    receiver, rotation = field.pose()
    for normal, offset in ((plane[:3].numpy(), float(plane[3])) for plane in field.paths.planes):
        if abs(normal[0]) > 0.5:
            axis.axvline(offset, color="C3", lw=1)
        elif abs(normal[1]) > 0.5:
            axis.axhline(offset, color="C3", lw=1)
    axis.plot(
        *np.unique(data.tx[fold.train], axis=0)[:, :2].T, ".", color="C0", label="measured places"
    )
    new = np.unique(data.tx[fold.test], axis=0)
    axis.plot(*new[:, :2].T, "x", color="C1", label="new places")
    axis.plot(*receiver[:2], "^", color="k", label="receiver")
    place = torch.from_numpy(new[:1])
    directions = (field.paths.ways(place)[0][0] @ rotation.T).numpy()
    power = field.paths.powers(place)[0].numpy()
    for direction, share in zip(directions, power, strict=True):
        axis.plot(
            *zip(receiver[:2].numpy(), receiver[:2].numpy() + 3 * direction[:2], strict=True),
            "k",
            lw=6 * share,
        )
    axis.set_aspect("equal")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.02, 0.5))
    axis.set_title("mirrors found (red), arrivals from one new place (black)", fontsize=8)


def main(room: str) -> None:
    """Write `bands.png`."""
    data = load({"name": "rfid", "root": room})
    fold = split_for({"name": "random", "seed": 0}, data).folds[0]
    fits, shown = fit(data, fold), data.site.stations.shown
    figure = plt.figure(figsize=(14, 8.5), layout="constrained")
    grid = figure.add_gridspec(5, 5, height_ratios=[1, 1, 1, 1, 2.2])
    axes = np.array([[figure.add_subplot(grid[i, j]) for j in range(5)] for i in range(4)])
    here = fold.test[(data.tx[fold.test] == data.tx[fold.test[0]]).all(1)]
    for line, station in zip(axes, CARRIERS, strict=False):
        row = here[data.station[here] == station][0]
        draw_images(line, data, row, fits, f"new place, {shown[station]}: measured")
    cut = split_for({"name": "carriers", "seed": 0, "leave_out": 2}, data).folds[0]
    draw_images(
        axes[3],
        data,
        cut.test[0],
        fit(data, cut),
        f"left-out {shown[data.station[cut.test[0]]]}: measured",
    )
    draw_plan(figure.add_subplot(grid[4, 1:4]), data, fold, fits["gsparc"])
    figure.savefig(OUT, dpi=90)


if __name__ == "__main__":
    main(sys.argv[1])
