"""Cells of one problem and effort side by side: accuracy, latency, training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from gsparc.evaluation.metric_formats import (
    CALIBRATION,
    GIVEN_HEARD,
    OF_KIND,
    WITH_SILENT,
    heading_of,
    is_root,
    lower_is_better,
    score_heading,
)
from gsparc.evaluation.paired import lead_over_runs
from gsparc.evaluation.results import PROBLEM, average, score_db
from gsparc.evaluation.summary import describe_machine_load, describe_wrong_deviations
from gsparc.evaluation.table import (
    CPU,
    P50,
    P95,
    TRAIN,
    Column,
    Interval,
    Row,
    Table,
    figure_column,
    value_with_error,
)
from gsparc.models.registry import plain_methods
from gsparc.runs.experiment.runner import TIMED

BESIDE = {  # figures beside the score, by their columns
    "coverage": "interval/coverage_90",
    "outage": "outage/brier",
    "after_constant": "rmse_db_after_constant",
    "chi2": CALIBRATION,
    **{name: name for figures in OF_KIND.values() for name in figures.compared},
}
# Within .5 dB [dB of the score] speed may matter more: the fastest of these is named.
CLOSE_DB = 0.5
BESIDE_NOTE = "*: a row of beside=, with the seconds of the machine that measured it"
GROUP = [*PROBLEM, "effort", "method"]
CELL = [*GROUP[:2], "method", "effort", "seed", "figure", "value", "train_s", "train_cpu_s", "load"]
ROW = [
    *GROUP,
    "score_db",
    "spread_db",
    "seeds",
    "draws",
    "figure",
    "value",
    "value_error",
    "behind_db",
    "behind_error_db",
    "error",
    "ratio",
    *BESIDE,
    "second_figure",
    "second_value",
    "train_s",
    "train_cpu_s",
    "query_ms",
    "query_p95_ms",
    "to_copy",
    "load",
    "earlier",
    "label",
    "given",
    "gaussians",
    "memory_mb",
    "cpu",
    "commit",
    "date",
    "tested",
]
SPREADS = ["score_error_db", "score_std_db"]  # `spread_db` by what it is
CSV = [name for column in ROW for name in (SPREADS if column == "spread_db" else [column])]


def _scored(own: Row) -> dict[str, Any]:
    """What a comparison reads of a cell, beside the columns of all results."""
    figures = OF_KIND[own["kind"]]
    second = figures.columns[0] if own["figure"] == WITH_SILENT else figures.second
    label = str(own["label"] or "")
    return {
        "result": own,
        "score_db": score_db(own),
        "second_figure": second,
        "second_value": own.get(second),
        **{name: own.get(figure) for name, figure in BESIDE.items()},
        "label": label[label.find(" (") :] if " (" in label else "",
        # "20261129T153822-2c93ceee", "014896424e456e89…": when, and by which program.
        "date": str(own["run_id"] or "")[:8],
        "commit": str(own["git"] or "")[:8],
        # Draws are hashes of numbers of rows: of other data they may be the same.
        "tested": f"{str(own['data'] or '')[:8]}/{own['draw']}",
    }


def average_cells(filled: pd.DataFrame, timed: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return the cells of a method of one effort, averaged over seeds or over draws of the split.

    Args:
        filled: the frame of `run_jobs`.
        timed: of `time_by_dataset`; None: nothing was timed.

    Returns:
        Columns `ROW` (see `columns_of_csv`), and `results`, a row of each seed or draw; NaN where
        something is not known.
        `effort`: NaN for a method that counts nothing, which stands in the tables of all efforts.
        `score_db`: larger is better [dB]: PSNR, -10 log10 NMSE, or -RMSE; `spread_db`: its standard
        deviation over `seeds`, of `draws` of the split the standard error of the mean.
        `figure`, `value`: the figure behind the score; `value_error`: its standard error over
        draws. `behind_db`: how much the best over draws has more, and its standard error, see
        `lead_over_runs`. `error`: root mean squared error, of powers [dB], of channels as a share
        of their root mean square, of spectra of full scale; `ratio`: in units of that of the best
        plain method. `psnr_db_median` and the like: medians over test rows.
        `coverage`: share of measured powers within the predicted 90 % interval; `outage`: Brier
        score of predicted outages; `after_constant`: RMSE of powers after a constant of each
        station [dB]; `chi2`: of `reduced_chi_squared`.
        `train_s`, `train_cpu_s`: seconds of training per model, on the clock and of the processor.
        `query_ms`, `query_p95_ms`: one query; `to_copy`: in units of a 16 MiB copy of the same
        rounds. `load`: 1-minute load per core at the end of the training.
        `earlier`: commits of other programs that it was measured with.
        `label`: what most draws say behind the method's name, ` (Vecchia 30)`.
        `given`: what it reads beside places; `gaussians`: of a model; `memory_mb`: while it was
        fitted [MB]. `cpu`, `commit`, `date`: of the latest fit; `tested`: hashes of data and test
        rows of all draws.
    """
    if filled.empty:
        return pd.DataFrame(columns=ROW).astype({"draws": bool})
    means = [
        "score_db",
        "value",
        *BESIDE,
        "second_value",
        "train_s",
        "train_cpu_s",
        "load",
        "gaussians",
    ]
    means += ["memory_mb"]
    records: list[Row] = filled.to_dict("records")  # type: ignore[assignment]
    cells = pd.DataFrame([{**row, **_scored(row)} for row in records])
    cells = cells.astype({"effort": float})
    # Draws with the same test rows are seeds.
    drawn = cells.groupby(PROBLEM)[["draw", "seed"]].transform("nunique")
    cells["draws"] &= (drawn["draw"] > 1) | (drawn["seed"] == 1)
    groups = cells.groupby(GROUP, dropna=False, sort=False)
    averages = average(cells, GROUP, means)
    rows = averages["mean"].copy()
    rows[["figure", "second_figure"]] = groups[["figure", "second_figure"]].first()
    rows["seeds"], several = groups.size(), groups["draws"].any()
    rows["results"] = groups["result"].agg(list)
    rows["draws"] = several
    # Over draws the mean is what is told, hence its error; over seeds the scatter of one training.
    rows["spread_db"] = averages["error"].score_db.where(several, averages["std"].score_db)
    rows["value_error"] = averages["error"].value
    rows["earlier"] = groups["earlier"].agg(lambda commits: " ".join(sorted(set(commits) - {""})))
    rows[["given", "cpu"]] = groups[["given", "cpu"]].last()
    latest = cells.sort_values("date", kind="stable").groupby(GROUP, dropna=False)
    rows[["commit", "date"]] = latest[["commit", "date"]].last()
    rows["tested"] = groups["tested"].agg(lambda tested: " ".join(sorted(set(tested))))
    rows["label"] = groups["label"].agg(lambda labels: Counter(labels).most_common(1)[0][0])
    rows = _with_ratio(_with_behind(rows.reset_index()))
    timed = pd.DataFrame(columns=TIMED) if timed is None else timed
    rows = rows.merge(timed, "left").astype(dict.fromkeys(TIMED[3:], float))
    rows["order"] = rows.groupby(PROBLEM, sort=False).ngroup()
    rows = rows.sort_values(["order", "effort", "method"], na_position="first")
    return rows[[*ROW, "results"]].reset_index(drop=True)


def _with_behind(rows: pd.DataFrame) -> pd.DataFrame:
    """Add how much the problem's best of the methods with most draws has more [dB],
    and its error.
    """
    rows = rows.assign(behind_db=np.nan, behind_error_db=np.nan)
    for _, draws in rows[rows.draws].groupby(PROBLEM):
        # A method that failed on hard draws has an easier mean: it is no best.
        best = draws[draws.seeds == draws.seeds.max()].score_db.idxmax()
        for row, results in draws.results.items():
            if lead := lead_over_runs(draws.results[best], results):
                rows.loc[row, ["behind_db", "behind_error_db"]] = lead.ahead_db, lead.error_db
    return rows


def _with_ratio(rows: pd.DataFrame) -> pd.DataFrame:
    """Add root mean squared errors, also in units of the problem's best plain method's."""
    # A score is of squared errors [dB] but for powers, whose root mean squared error it is.
    decibels = rows.figure.map(is_root)
    rows = rows.assign(error=(-rows.score_db).where(decibels, 10 ** (-rows.score_db / 20)))
    plain = rows[rows.method.isin(plain_methods())]
    # One that failed on hard draws has an easier mean.
    plain = plain[plain.seeds == plain.groupby(PROBLEM).seeds.transform("max")]
    least = rows[PROBLEM].join(plain.groupby(PROBLEM).error.min(), on=PROBLEM).error
    return rows.assign(ratio=rows.error / least)


def columns_of_csv(rows: pd.DataFrame) -> dict[str, list[Any]]:
    """Return the columns of `compare.csv`, with the signs of the tables and errors
    by what they are.
    """
    several = rows.draws.astype(bool)
    columns = rows.assign(
        score_db=[shown(*score) for score in zip(rows.figure, rows.score_db, strict=True)],
        score_error_db=rows.spread_db.where(several),
        score_std_db=rows.spread_db.where(~several),
        draws=rows.seeds.where(several, 1),
        seeds=rows.seeds.where(~several, 1),
    )
    return columns[CSV].to_dict("list")


def split_by_problem(rows: pd.DataFrame) -> list[pd.DataFrame]:
    """Return a table per dataset, split and effort, best first;
    methods that count nothing stand in each.

    Efforts are those of runs here; where all of these count nothing,
    published rows have the usual one.
    """
    blocks = []
    for _, problem in rows.groupby(PROBLEM, sort=False):
        without = problem.effort.isna()
        for effort in sorted(problem.effort[~_published(problem)].dropna().unique()) or [1.0]:
            members = problem[without | (problem.effort == effort)]
            blocks.append(members.sort_values("score_db", ascending=False, kind="stable"))
    return blocks


def title_of(block: pd.DataFrame) -> str:
    """Return names and effort of a block, and how often its split was drawn."""
    effort = block.effort.max()
    counted = "" if np.isnan(effort) else f", effort {effort:g}"
    draws = int(block.seeds.max()) if block.draws.any() else 0
    count = f", {draws} draws (± standard error of the mean)" if draws > 1 else ", one draw" * draws
    return f"{block.dataset.iloc[0]}, split {block.split.iloc[0]}{counted}{count}"


def remarks(block: pd.DataFrame, ours: str) -> list[str]:
    """Return what the table shows about simple baselines and about our own default,
    favourable or not.
    """
    rows, plain = list(block.itertuples()), plain_methods()
    first = rows[0]
    level = (
        f"{score_heading(first.figure).partition(' (')[0]} "
        f"{shown(first.figure, first.score_db):.2f}"
    )
    lines = [
        f"best: {first.method}, {level} after {first.train_cpu_s:.3g} processor seconds of training"
    ]
    leads = {row.method: lead_over_runs(first.results, row.results) for row in rows[1:]}
    if len(rows) > 1 and (lead := leads[rows[1].method]):
        before = (
            "the same as"
            if lead.same
            else (f"{lead.ahead_db:.2f} ± {lead.error_db:.2f} dB better than")
        )
        lines[0] += f"; {before} {rows[1].method} (standard error over the same {lead.pairs})"
        lines[0] += "" if lead.same else f": {'' if lead.sure else 'not '}significant"
    cell = next((row for row in rows if row.method == ours), None)
    lead = None if cell is None else leads.get(cell.method)
    figure = heading_of(first.figure)
    if cell is not None and cell is not first:
        gap = f"{ours} is {first.score_db - cell.score_db:.2f} dB behind {first.method}"
        lines.append(
            gap if lead is None or lead.sure else lead.no_difference(first.method, ours, figure)
        )
    if first.method in plain and not block.method.isin(plain).all():
        wins = f"a simple baseline wins: take {first.method} for this data and split"
        if cell is None or lead is None or lead.sure:
            lines.append(wins if cell is not None else f"{ours} was not run: no verdict on it")
    for row in rows[1:]:
        if cell is None or row.method not in plain or row.score_db <= cell.score_db:
            continue
        ahead = lead_over_runs(row.results, cell.results)
        if ahead is None or ahead.sure:
            lines.append(
                f"{row.method} (simple) also beats {ours}, by {row.score_db - cell.score_db:.2f} dB"
            )
    close = block[(block.score_db >= first.score_db - CLOSE_DB) & block.query_ms.notna()]
    if len(close):
        quick = close.loc[close.query_ms.idxmin()]
        near = f"fastest within {CLOSE_DB} dB of the best"
        lines.append(f"{near}: {quick.method}, {quick.query_ms:.3g} ms a query")
    if inputs := "; ".join(f"{row.method}: {row.given}" for row in rows if row.given):
        lines.append(f"given more than places: {inputs}")
    lines += describe_wrong_deviations({row.method: row.chi2 for row in rows}, first.figure)
    if old := ", ".join(f"{row.method} ({row.earlier})" for row in rows if row.earlier):
        lines.append(f"measured with another commit of this program: {old}")
    lines += [GIVEN_HEARD] * bool(block.outage.notna().any())
    return lines + describe_machine_load(block.load[block.effort.notna()].dropna().tolist())


def table_of(block: pd.DataFrame, ours: str) -> Table:
    """Return a block as a table without columns that no row fills; bold: a significantly best.

    `ours` is marked.
    """
    figure, draws, value = (
        block.figure.iloc[0],
        block.draws.any(),
        value_with_error("value", "value_error"),
    )
    columns = [
        (True, Column("method", "", of="named")),
        (True, Column(score_heading(figure), ".2f", of=_score)),
        (
            draws,
            Column(
                "behind the best, dB", ".2f", of=value_with_error("behind_db", "behind_error_db")
            ),
        ),
        (figure.startswith("nmse"), Column(figure, ".3g" if draws else ".4g", of=value)),
        (True, Column(block.second_figure.iloc[0], of="second_value")),
        *((block[n].notna().any(), figure_column(beside, of=n)) for n, beside in BESIDE.items()),
        (not draws and (block.seeds > 1).any(), Column("seeds, same split", "d", of="seeds")),
        *(
            (True, column)
            for column in (TRAIN, CPU, P50, P95, Column("x copy", ".2g", of="to_copy"))
        ),
    ]
    published = _published(block)
    mark = np.where(published, "*", np.where(block.method == ours, " (ours)", ""))
    rows = block.assign(named=block.method + block.label + mark).to_dict("records")
    columns_here = [column for there, column in columns if there]
    lead = lead_over_runs(*block.results[:2]) if len(block) > 1 else None
    bold = rows[0]["named"] if lead and lead.sure else None
    note = BESIDE_NOTE * bool(published.any())
    return Table.from_rows(title_of(block), columns_here, rows, bold=bold, note=note)  # type: ignore[arg-type]


def _published(block: pd.DataFrame) -> pd.Series:
    """Whether rows (n,) bool stand beside those that were measured here."""
    return block.results.map(len) == 0


def shown(figure: str, score_db: float) -> float:
    """Return a score as a reader knows it: of figures of which less is better,
    without its turned sign.
    """
    return -score_db if lower_is_better(figure) else score_db


def _score(row: Mapping[str, Any]) -> Interval:
    return Interval(shown(row["figure"], row["score_db"]), error=row["spread_db"])


def markdown(blocks: Sequence[pd.DataFrame], ours: str) -> str:
    """Return all blocks as one page, each with what it shows."""
    return "\n".join(
        "\n".join([table_of(block, ours).markdown(), *(f"- {r}" for r in remarks(block, ours)), ""])
        for block in blocks
    )


def methods_by_mean_behind(rows: pd.DataFrame) -> Iterable[str]:
    """Return methods, the least behind first: mean over the splits that each is possible on."""
    behind = (
        rows.assign(behind_db=rows.behind_db.fillna(0.0))
        .groupby("method", sort=False)
        .behind_db.mean()
    )
    return list(behind.sort_values(kind="stable").index)
