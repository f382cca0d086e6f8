"""The learning curve of a fit: held-out error against the seconds that it cost,
a row of CSV a point.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsparc.base.files import whole_file

FILE = "learning_curve.csv"
FIGURES = ("num_gaussians", "train/task_loss", "val/ssim_gauss", "val/psnr_db", "val/mse")
COLUMNS = ("seconds", "what", "error", "step", *FIGURES)


def curve_row(
    seconds: float, what: str, error: float | None = None, step: int | None = None, **figures: Any
) -> dict[str, Any]:
    """Return a row of the curve; what is not known is empty.

    Args:
        seconds: of training so far, without validation [s].
        what: was looked at: a start, a number of steps, a candidate, `final`.
        error: of held-out rows: squared, per entry of a spectrum or channel, of powers in decibels.
        step: of gradient training.
        **figures: of `FIGURES`.
    """
    # What is not finite is not known.
    has_error = error is not None and math.isfinite(error)
    row = {
        "seconds": round(seconds, 3),
        "what": what,
        "error": error if has_error else "",
        "step": step,
    }
    return {
        name: "" if (row | figures).get(name) is None else (row | figures)[name] for name in COLUMNS
    }


def write_curve(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write all rows of the curve of a run's folder at once; nowhere where there is no folder."""
    if folder == Path():
        return
    # By renaming: a killed run leaves a whole table.
    with (
        whole_file(folder / FILE) as partial,
        partial.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def read_curve(folder: Path) -> list[dict[str, Any]]:
    """Return the rows in a run's folder as text; [] where there are none."""
    path = folder / FILE
    if folder == Path() or not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def log_row(loggers: Iterable[Any], row: Mapping[str, Any]) -> None:
    """Give the point to dashboards, which draw it over the steps."""
    figures = {
        f"curve/{name}": float(row[name]) for name in ("seconds", "error") if row[name] != ""
    }
    for logger in loggers:
        logger.log_metrics(figures, step=int(row["step"] or 0))
