"""Pictures of localisation: where single snapshots may have been heard, and distributions of errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle

from gsparc.evaluation.drawing import logarithmic, look, panels, save
from gsparc.locate.locator import Located

SHOWN = 6  # snapshots, evenly over all


def draw_posteriors(
    located: Sequence[Located], true: np.ndarray | None, trained: np.ndarray, path: Path
) -> None:
    """Masses of the cells of a few snapshots from above, as one PNG.

    `true` (n, 3) [m] in the coordinates of `located`, or None; `trained` (m, 3): places learned from.
    """
    some = np.unique(np.linspace(0, len(located) - 1, SHOWN).round().astype(int))
    columns = min(len(some), 3)
    figure, axes = panels(9, 3.2 * -(-len(some) // columns), -(-len(some) // columns), columns, grid=False)
    for axis in axes.flat[len(some) :]:
        axis.axis("off")
    for axis, number in zip(axes.flat, some, strict=False):
        one = located[number]
        cells, density = one.posterior.cells, one.posterior.log_density
        order = np.argsort(density)  # cells above one another: the likeliest is seen
        corners = cells.centre[order, :2] - cells.edge[order, :2] / 2
        boxes = [
            Rectangle((x, y), w, h) for (x, y), (w, h) in zip(corners, cells.edge[order, :2], strict=True)
        ]
        drawn = PatchCollection(boxes, cmap="Blues", linewidth=0)
        drawn.set_array(np.maximum(density[order], density.max() - 12))
        axis.add_collection(drawn)
        axis.plot(*trained[:, :2].T, ".", color="0.7", markersize=1, label="learned from")
        axis.plot(*one.place[:2], "x", color="#D55E00", label="located")
        if true is not None:
            axis.plot(*true[number, :2], "o", markerfacecolor="none", color="black", label="heard at")
        axis.set_aspect("equal")
        axis.set(xlabel="x [m]", ylabel="y [m]")
        axis.set_title(f"snapshot {number}: {one.modes} mode{'s' if one.modes > 1 else ''}", fontsize=9)
    axes.flat[0].legend(fontsize=7)
    save(figure, path)


def draw_errors(errors: Mapping[str, np.ndarray], path: Path) -> None:
    """Share of snapshots located to within an error [m], a line a method, as one PNG."""
    figure, ((axis,),) = panels(6, 4)
    for name, values in errors.items():
        ordered = np.sort(np.maximum(values, 1e-4))
        share = np.arange(1, len(ordered) + 1) / len(ordered)
        label = f"{name}, median {np.median(values):.3g} m"
        axis.plot(ordered, share, color=look(name).colour, label=label)
    logarithmic(axis)
    axis.set(xlabel="error [m]", ylabel="share of snapshots", ylim=(0, 1))
    axis.legend(fontsize=8)
    save(figure, path)
