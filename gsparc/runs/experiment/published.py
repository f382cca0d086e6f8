"""Rows of a comparison that was published, beside those that are measured here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.runs.experiment.table import GROUP, PROBLEM, ROW, shown

WORDS = ["earlier", "label", "given", "cpu", "commit", "date", "tested"]


def read_published(file: str | Path) -> pd.DataFrame:
    """Return the rows of a `compare.csv` as `average_cells` returns them,
    without the runs they are of.

    Raises:
        ValueError: a file that is no such table; it is named.
    """
    try:
        rows = pd.read_csv(file, dtype=dict.fromkeys(WORDS, str))
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: cannot be read as a comparison's compare.csv: {error}") from None
    if lacking := {"score_error_db", "score_std_db", "tested", *GROUP} - {*rows}:
        raise ValueError(f"{file}: no compare.csv: it has no column {', '.join(sorted(lacking))}")
    # An older table lacks columns that were added since.
    rows = rows.reindex(columns=[*dict.fromkeys([*rows, *ROW])])
    rows[WORDS] = rows[WORDS].astype(object).fillna("").astype(str)
    rows["spread_db"] = rows.score_error_db.fillna(rows.score_std_db)
    rows["score_db"] = [shown(*score) for score in zip(rows.figure, rows.score_db, strict=True)]
    several = rows.draws > 1
    rows = rows.assign(seeds=rows.draws.where(several, rows.seeds), draws=several)
    rows["results"] = [[] for _ in range(len(rows))]
    return rows[[*ROW, "results"]]


def beside_published(rows: pd.DataFrame, published: pd.DataFrame) -> pd.DataFrame:
    """Return rows, and behind them the published ones of the same test rows
    that none of them is of.

    Both are as of `average_cells`; how far methods are behind the best is
    of the runs measured here.
    """
    key = [*GROUP, "tested"]
    row_keys = {tuple(row) for row in rows[key].fillna(-1.0).to_numpy()}
    tested_problems = {tuple(row) for row in rows[[*PROBLEM, "tested"]].to_numpy()}
    wanted = [
        tuple(row) not in row_keys and (row[0], row[1], row[-1]) in tested_problems
        for row in published[key].fillna(-1.0).to_numpy()
    ]
    extra_rows = published[np.array(wanted, bool)]
    return pd.concat([rows, extra_rows], ignore_index=True) if len(extra_rows) else rows
