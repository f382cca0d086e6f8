"""Methods under drawn splits: error bars side by side, with what each costs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsparc.commands.compare.overview import mean_behind
from gsparc.commands.compare.table import Row
from gsparc.evaluation.drawing import look, panels, save

LABEL = {"nmse": "NMSE", "rmse_db": "RMSE [dB]", "psnr_db": "PSNR [dB]"}
LINE = 0.34  # height of a method [inch]


def draw(rows: Sequence[Row], path: Path) -> None:
    """A panel per split of one dataset: mean and standard error over draws, training and query beside it.

    Args:
        rows: of one dataset, all of drawn splits.
        path: PNG file.
    """
    splits = list(dict.fromkeys(row.split for row in rows))
    names = sorted(dict.fromkeys(row.method for row in rows), key=lambda name: mean_behind(rows, name))
    figure, grid = panels(2.2 + 3.1 * len(splits), 1.3 + LINE * len(names), 1, len(splits), sharey=True)
    for axis, split in zip(grid[0], splits, strict=True):
        here = {row.method: row for row in rows if row.split == split}
        most = max(row.value + (row.value_error or 0.0) for row in here.values())
        best = min(here.values(), key=lambda row: -row.score_db)
        for number, name in enumerate(names):
            if name not in here:
                axis.text(0.02 * most, number, "not possible", va="center", fontsize=8, color="0.5")
                continue
            row = here[name]
            axis.barh(
                number,
                row.value,
                xerr=row.value_error or 0.0,
                color=look(name).colour,
                alpha=1.0 if row is best else 0.45,
                capsize=2.5,
            )
            axis.text(
                min(row.value + (row.value_error or 0.0) + 0.02 * most, 1.02 * most), number,
                f"{row.value:.3g}, fit {_seconds(row.train_s)}", va="center", fontsize=7.5,
            )  # fmt: skip
        draws = max(row.seeds for row in here.values())
        axis.set(title=f"{split}, {draws} draw{'s' * (draws > 1)}", xlim=(0, 1.5 * most))
        axis.set_xlabel(LABEL[best.figure])
        axis.set_yticks(np.arange(len(names)), names)
        axis.grid(axis="y", visible=False)
    grid[0, 0].set_ylim(len(names) - 0.4, -0.6)
    figure.suptitle(f"{rows[0].dataset}: mean and standard error over draws of the split; the best is dark")
    save(figure, path)


def _seconds(value: float) -> str:
    if value < 0.1:
        return f"{1e3 * value:.2g} ms"
    return f"{value:.2g} s" if value < 10 else f"{value:.0f} s"
