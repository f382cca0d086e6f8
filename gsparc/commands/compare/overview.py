"""All drawn splits of a dataset in one table: a line per method, a column per split."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsparc.commands.compare.table import Row
from gsparc.evaluation.summary import shown

UNIT = {"nmse": "NMSE", "rmse_db": "RMSE, dB", "psnr_db": "PSNR, dB"}


def overview(rows: Sequence[Row]) -> str:
    """Markdown: the figure ± its standard error of the mean, (how far behind the best of the same draws).

    The best of a split is bold, and so is whatever is within two standard errors of it. Seconds of one fit
    and milliseconds of one query are those of the first split.

    Args:
        rows: of one dataset, all of drawn splits.
    """
    splits = list(dict.fromkeys(row.split for row in rows))
    names = sorted(dict.fromkeys(row.method for row in rows), key=lambda name: mean_behind(rows, name))
    draws = max(row.seeds for row in rows)
    head = ["method", *splits, "fit s", "query ms"]
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    for name in names:
        own = {row.split: row for row in rows if row.method == name}
        first = next(iter(own.values()))
        cells = [_cell(own[split]) if split in own else "-" for split in splits]
        lines.append(
            "| " + " | ".join([name, *cells, f"{first.train_s:.2g}", shown(first.query_ms, ".2g")]) + " |"
        )
    title = f"### {rows[0].dataset}: {UNIT[rows[0].figure]}, {draws} draws of each split"
    return "\n".join([title, "", *lines])


def _cell(row: Row) -> str:
    value = f"{row.value:.3f}" if row.figure == "nmse" else f"{row.value:.2f}"
    if row.value_error is not None:
        value += f" ± {row.value_error:.3f}" if row.figure == "nmse" else f" ± {row.value_error:.2f}"
    behind, error = row.behind_db or 0.0, row.behind_error_db or 0.0
    if behind <= 2 * error:
        value = f"**{value}**"
    return value if behind == 0 else f"{value} ({behind:.2f} ± {error:.2f} dB)"


def mean_behind(rows: Sequence[Row], name: str) -> float:
    """How far a method is behind the best, mean over the splits it is possible on [dB]."""
    return float(np.mean([row.behind_db or 0.0 for row in rows if row.method == name]))
