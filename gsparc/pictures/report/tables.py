"""Tables of runs, figures with their uncertainty; no accuracy without its time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import pandas as pd

from gsparc.evaluation.metric_formats import (
    CALIBRATION,
    OF_KIND,
    heading_of,
    number_format,
    sample_column,
)
from gsparc.evaluation.paired import Lead, lead_over_runs
from gsparc.evaluation.results import average, distinct_baselines, own_rows
from gsparc.evaluation.table import P50, P95, TRAIN, Column, Interval, Row, Table, figure_column
from gsparc.processes.uncertainty import central_interval

# Quantiles at 2.5 % of 1000 draws rest on 25 of them: two digits of an interval.
DRAWS = 1000
LEVEL = 0.95
WORST = 3
# Two latencies of one model: caches hold what was asked before it, of baselines or of other models.
TIMED = (
    "Queries: baselines are timed in turns within a run, the models of a sweep again after it, "
    "in turns with "
    "one another: a run's own table has other milliseconds."
)
SETTING = Column("method and setting", "", of="setting")
SEED = Column("seed", "d", of="seed")
# By its seed, as the command line has it; by its hash where the settings are gone.
DRAW = Column(
    "draw", "", "split.seed", lambda row: str(row["run"].config.get("split.seed", row["draw"]))
)
SIZE = Column("Gaussians", "d", of="gaussians")


def bootstrap_interval(
    values: np.ndarray, weights: np.ndarray | None = None, seed: int = 0
) -> tuple[float, float]:
    """Return ends of the 95 % interval of a mean (n,), or of sum(values) / sum(weights),
    resampling samples.

    Samples are taken as independent; neighbours under `split=grouped` are not,
    so it is a lower bound.
    """
    # A fixed seed: the same run has the same interval in every report.
    draw = np.random.default_rng(seed).integers(0, len(values), (DRAWS, len(values)))
    below = np.ones_like(values) if weights is None else weights
    # 1e-300: a draw of silent rows alone has no power to divide by.
    means = values[draw].sum(1) / np.maximum(below[draw].sum(1), 1e-300)
    return central_interval(means, LEVEL)


def interval_of_figure(row: Row, figure: str) -> Interval | None:
    """Return a test figure of a row with its bootstrap interval over test samples, or None."""
    # Baselines have no samples of their own here, only figures.
    value, parts = row.get(figure), None if row["baseline"] else _parts(row["run"].samples, figure)
    if value is None:
        return None
    return Interval(value) if parts is None else Interval(value, *bootstrap_interval(*parts))


def _parts(
    own: Mapping[str, np.ndarray], figure: str
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Per-sample numbers whose (weighted) mean is the figure."""
    # The ratio of sums, not a mean of ratios, which one silent row would decide.
    if sample_column(figure) == "error_power" and "error_power" in own and "target_power" in own:
        finite = np.isfinite(own["error_power"])
        return own["error_power"][finite], own["target_power"][finite]
    values = own.get(figure)
    if values is None or values.dtype.kind != "f":
        return None
    values = values[np.isfinite(values)]
    return (values, None) if len(values) > 1 else None


def _interval(average: pd.Series) -> Interval | None:
    """Mean and standard error over draws; of one draw mean, least and largest over seeds."""
    if np.isnan(average["mean"]):
        return None
    if not np.isnan(average["error"]):
        return Interval(average["mean"], error=average["error"])
    # A single seed has no spread: no brackets.
    return Interval(
        average["mean"], *([] if np.isnan(average["std"]) else average[["least", "largest"]])
    )


def has_draws(rows: pd.DataFrame) -> bool:
    """Return whether a setting was run on several draws of the split."""
    return bool((own_rows(rows).groupby("setting").draw.nunique() > 1).any())


def leads_of_baselines(rows: pd.DataFrame, setting: str, figure: str) -> dict[str, Lead | None]:
    """Return what each baseline beside a setting has more of a figure, see `lead_over_runs`."""
    own = own_rows(rows)[lambda own: own.setting == setting]
    beside = rows[rows.baseline & rows.run.isin(own.run)]
    others = {str(name): theirs for name, theirs in beside.groupby("method", sort=False)}
    return {
        name: lead_over_runs(_judged(theirs, figure), _judged(own, figure))
        for name, theirs in others.items()
    }


def _judged(rows: pd.DataFrame, figure: str) -> list[Row]:
    """The rows as they are judged by this figure."""
    return rows.assign(figure=figure, value=rows.get(figure)).to_dict("records")  # type: ignore[return-value]


def _figures(rows: pd.DataFrame) -> list[str]:
    """Figures of these data, first the one that decides:
    with silent rows it is none of the usual ones.

    Medians that no run has, as of older ones, are left out.
    """
    kind = OF_KIND[rows.kind.iloc[0]]
    medians = [name for name in kind.medians if name in rows and rows[name].notna().any()]
    return list(dict.fromkeys([rows.figure.iloc[0], *kind.columns, *medians]))


def groups_of(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return rows that differ by their seed only, by setting, in order of appearance."""
    return {str(setting): group for setting, group in rows.groupby("setting", sort=False)}


def _run_columns(rows: pd.DataFrame) -> list[Column]:
    return [SETTING, *([DRAW] * has_draws(rows)), SEED]


def table_of_results(rows: pd.DataFrame) -> Table:
    """Return every run and every baseline of one study: accuracy, what it cost, memory, size,
    effects, origin.
    """
    note = "95 % interval: bootstrap over test samples"
    columns = [
        *_run_columns(rows),
        *(figure_column(f, note, partial(interval_of_figure, figure=f)) for f in _figures(rows)),
        figure_column(CALIBRATION, "1: deviations are right"),
        TRAIN,
        P50,
        P95,
        Column("batch of 64, ms each", ".3g", of="batch_ms"),
        Column("points measured", "d", of="measured"),
        Column("s simulated", ".3g", "of the ray tracer that made the data", "simulate_s"),
        Column("memory MB", ".0f", of="memory_mb"),
        SIZE,
        Column("effects", "", of="effects"),
        Column("load", ".2f", "1-minute load per core while measured", "load"),
        Column("data", "", of=lambda row: str(row["data"])[:8]),
        Column("commit", "", of=lambda row: str(row["git"])[:8]),
    ]
    note = f"Brackets: 95 % intervals over test samples (independent samples assumed). {TIMED}"
    records = pd.concat([own_rows(rows), distinct_baselines(rows)]).to_dict("records")
    return Table.from_rows("Results", columns, records, note=note)  # type: ignore[arg-type]


def table_of_seeds(rows: pd.DataFrame) -> Table:
    """Return settings and baselines side by side, their spread over seeds or draws of the split,
    and their cost.
    """
    differs, several, spread = differing_settings(rows), has_draws(rows), _spread_columns(rows)
    also = [Column("differs, too", "")] if any(differs.values()) else []
    lines, all_rows = [], pd.concat([own_rows(rows), distinct_baselines(rows)])
    averages = average(all_rows, ["setting"], names := [str(column.of) for column in spread])
    for setting, group in groups_of(all_rows).items():
        seeds = group.seed.nunique(dropna=False)
        counts = [group.draw.nunique(), seeds] if several else [len(group)]
        values = [_interval(averages.loc[setting].xs(name, level=1)) for name in names]
        lines.append([setting, *([differs.get(setting)] if also else []), *counts, *values])
    counted = [Column("draws", "d")] * several + [Column("seeds", "d")]
    note = "Brackets: least and largest over seeds, on the same test rows: split.seed draws others "
    note += "(split.redraw=true where the data name their test rows). "
    if several:
        note = "± standard error of the mean over draws of the split (split.seed). "
    columns, title = (
        [SETTING, *also, *counted, *spread],
        (f"Settings over {'draws' if several else 'seeds'}"),
    )
    return Table(title, columns, lines, note + TIMED, ends={"low": "least", "high": "largest"})


def table_of_leads(rows: pd.DataFrame) -> Table:
    """Return what each setting has more than the first one and than each baseline, pair by pair."""
    settings = {name: group.to_dict("records") for name, group in groups_of(own_rows(rows)).items()}
    first, *others = settings
    lines, fits = [], own_rows(rows)
    for setting, group in settings.items():
        leads = {first: lead_over_runs(settings[first], group)} if setting in others else {}  # type: ignore[arg-type]
        leads |= leads_of_baselines(rows, setting, group[0]["figure"])
        for against, lead in leads.items():
            if lead is not None:
                verdict = "same" if lead.same else "yes" if lead.sure else "no"
                gain = Interval(-lead.ahead_db, error=lead.error_db)
                lines.append([setting, against, gain, lead.pairs, verdict])
    ahead = Column("ahead of it, dB", ".2f")
    columns = [
        SETTING,
        Column("against", ""),
        ahead,
        Column("pairs", ""),
        Column("significant", ""),
    ]
    figure = heading_of(fits.figure.iloc[0])
    note = (
        f"Of {figure}, on the same draws, seeds or rows; ± standard error; significant: 95 %, "
        "Student's t."
    )
    if fits.seed.nunique(dropna=False) == 1 and any("test rows" in str(line[3]) for line in lines):
        note += " Of one seed: what seeds change is not in the error (seed=0,1,2)."
    return Table("Paired differences", columns, lines, note)


def _spread_columns(rows: pd.DataFrame) -> list[Column]:
    figures = [figure_column(figure) for figure in _figures(rows)]
    if rows.alone.notna().any():
        deciding = rows.figure.iloc[0]
        name = f"{heading_of(deciding)} of Gaussians alone"
        figures.append(Column(name, number_format(deciding), of="alone"))
    return [*figures, TRAIN, P50, P95, Column(SIZE.name, ".0f", of=SIZE.of)]


def differing_settings(rows: pd.DataFrame) -> dict[str, str]:
    """Return, by setting, resolved values in which runs differ besides what was swept:
    `init=sphere, ...`.
    """
    firsts = own_rows(rows).groupby("setting", sort=False).run.first()
    resolved = {setting: run.resolved for setting, run in firsts.items()}
    # Names of all runs: a setting may be in one alone.
    names = dict.fromkeys(name for settings in resolved.values() for name in settings)
    # As text: lists of settings cannot be put into a set.
    vary = [n for n in names if len({str(settings.get(n)) for settings in resolved.values()}) > 1]
    # Each model, and each variant of one, has settings of its own, which its name stands for.
    if "model._target_" in vary or any(run.swept("variant") for run in firsts):
        vary = [n for n in vary if not n.startswith("model.")]
    return {
        str(setting): ", ".join(
            f"{n}={settings.get(n)}" for n in vary if not firsts[setting].swept(n)
        )
        for setting, settings in resolved.items()
    }


def table_of_worst(rows: pd.DataFrame) -> Table:
    """Return the three test positions with the largest error of each run."""
    fits = own_rows(rows)
    name = OF_KIND[fits.kind.iloc[0]].of_sample
    rival = f"baseline/gp/{name}"
    beside = ("gp there",) if any(rival in run.samples for run in fits.run) else ()
    numbers = [Column(head, ".2f") for head in (heading_of(name), *beside, "confidence")]
    lines, who = [], _run_columns(rows)
    columns = [*who, Column("sample", ""), Column("where [m]", ""), *numbers]
    for fit in fits.to_dict("records"):
        if name not in fit["run"].samples:
            continue
        samples = pd.DataFrame(fit["run"].samples)
        # Decibels of quality are negated, so that the worst samples have the largest error.
        error = samples[name].abs() if name == "error_db" else -samples[name]
        for row in samples.loc[error.nlargest(WORST).index].to_dict("records"):
            place = ", ".join(f"{row[axis]:.2f}" for axis in ("x_m", "y_m", "z_m"))
            figures = row[name], *([row.get(rival)] if beside else []), row["confidence"]
            lines.append(
                [*(column.value(fit) for column in who), str(row["name"]), place, *figures]
            )  # type: ignore[arg-type]
    hard = "; the Gaussian process there shows whether it is hard for all" if beside else ""
    note = f"The moving end's position{hard}."
    return Table("The three worst places", columns, lines, note)
