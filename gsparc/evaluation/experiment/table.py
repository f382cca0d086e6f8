"""Cells of one problem and budget side by side: accuracy, latency, training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from gsparc.data.schema import Kind
from gsparc.evaluation.experiment.cells import Cell
from gsparc.evaluation.experiment.fitting import Filled, score_db
from gsparc.evaluation.experiment.latency import Latency
from gsparc.evaluation.metric_formats import DECIDING, heading_of
from gsparc.evaluation.summary import BUSY, shown

SECOND: dict[Kind, str] = {"spectrum": "ssim", "csi": "snr_db", "rssi": "mae_db"}
SCORE = {"psnr_db": "PSNR dB", "nmse": "-10 log10 NMSE, dB", "rmse_db": "-RMSE dB"}
SIMPLE = ("zero", "mean", "distance_law", "nearest", "idw", "gp", "kriging", "complex_gp")
CLOSE_DB = 0.5


@dataclass(frozen=True)
class Row:
    """A method under one budget, over its seeds.

    Attributes:
        dataset, split: names.
        budget_s: [s]; None for a method without one, which stands in the tables of all budgets.
        method: name.
        score_db: larger is better [dB]: PSNR, -10 log10 NMSE, or -RMSE.
        spread_db: standard deviation over seeds [dB]; of draws of the split, standard error of the mean; None
            for a single one.
        seeds: how many.
        draws: whether these are draws of the split.
        figure, value: the figure behind the score, mean over seeds.
        value_error: standard error of `value` over draws.
        behind_db: how much the problem's best has more, mean of the same draws [dB]; None unless drawn.
        behind_error_db: standard error of that [dB].
        coverage: share of measured powers within the predicted 90 % interval; None without variances.
        outage: Brier score of predicted outages, 0 when perfect; None where every place heard something.
        after_constant: RMSE of powers after a constant of each station [dB]; where stations are held out.
        second, second_value: another figure for the reader.
        train_s, train_cpu_s: seconds of training per model, on the clock and of processor [s].
        query_ms: one query, median [ms]; None when not timed.
        query_p95_ms: 95th percentile [ms].
        to_copy: the median in units of a 16 MiB copy of the same rounds.
        load: 1-minute load per core at the end of the training, mean over seeds.
        earlier: commits of earlier program text that it was measured with; empty for today's.
        label: what most draws say behind the method's name, ` (Vecchia 30)`; else empty.
    """

    dataset: str
    split: str
    budget_s: float | None
    method: str
    score_db: float
    spread_db: float | None
    seeds: int
    draws: bool
    figure: str
    value: float
    value_error: float | None
    behind_db: float | None
    behind_error_db: float | None
    coverage: float | None
    outage: float | None
    after_constant: float | None
    second: str
    second_value: float | None
    train_s: float
    train_cpu_s: float
    query_ms: float | None
    query_p95_ms: float | None
    to_copy: float | None
    load: float | None
    earlier: str = ""
    label: str = ""


def rows(filled: Sequence[Filled], timed: Mapping[str, Mapping[str, Latency]]) -> list[Row]:
    """Average the scored cells over seeds, or over the draws of a split.

    `timed` holds latencies by dataset and method, of the dataset's first split and shown there alone: models
    of fewer measurements answer faster.
    """
    groups: dict[tuple[str, str, float, str], list[Filled]] = {}
    for cell, one in ((one.cell, one) for one in filled if one.scored()):
        groups.setdefault((cell.dataset, cell.split, cell.budget_s or 0.0, cell.method), []).append(one)
    problems = list(dict.fromkeys((dataset, split) for dataset, split, *_ in groups))
    first = dict(reversed(problems))
    best = {problem: _best([g for key, g in groups.items() if key[:2] == problem]) for problem in problems}
    return [
        _row(
            groups[key], timed.get(key[0], {}).get(key[3]) if key[1] == first[key[0]] else None, best[key[:2]]
        )
        for key in sorted(groups, key=lambda key: (problems.index(key[:2]), *key))
    ]


def scores_by_seed(same: Sequence[Filled]) -> dict[int | None, float]:
    """The score [dB] of each seed or draw."""
    return {one.cell.seed: score_db(one.facts["dataset/kind"], one.facts) for one in same}


def _best(groups: Sequence[list[Filled]]) -> dict[int | None, float]:
    """The scores of the best of a problem's methods that have as many draws as any."""
    found = [scores_by_seed(same) for same in groups]
    most = max(map(len, found))
    return max((s for s in found if len(s) == most), key=lambda s: float(np.mean(list(s.values()))))


def _mean_and_error(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean, and its standard error where there are two at least."""
    error = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return float(np.mean(values)), error


def _row(same: list[Filled], latency: Latency | None, best: Mapping[int | None, float]) -> Row:
    cell, facts = same[0].cell, [one.facts for one in same]
    kind: Kind = facts[0]["dataset/kind"]
    by_seed = scores_by_seed(same)
    scores = list(by_seed.values())
    drawn = any(one.drawn for one in same)
    behind, behind_error = None, None
    paired = [best[seed] - score for seed, score in by_seed.items() if seed in best]
    if drawn and paired:
        behind, behind_error = _mean_and_error(paired)
    value, value_error = _mean_and_error([float(f[f"test/{DECIDING[kind]}"]) for f in facts])
    spread = None
    if len(scores) > 1:
        spread = _mean_and_error(scores)[1] if drawn else float(np.std(scores, ddof=1))

    def mean(name: str) -> float | None:
        values = [f[name] for f in facts if f.get(name) is not None]
        return float(np.mean(values)) if values else None

    return Row(
        cell.dataset, cell.split, cell.budget_s, cell.method,
        score_db=float(np.mean(scores)),
        spread_db=spread,
        seeds=len(same), draws=drawn,
        figure=DECIDING[kind], value=value, value_error=value_error if drawn else None,
        behind_db=behind, behind_error_db=behind_error,
        coverage=mean("test/interval/coverage_90"), outage=mean("test/outage/brier"),
        after_constant=mean("test/rmse_db_after_constant"),
        second=SECOND[kind], second_value=mean(f"test/{SECOND[kind]}"),
        train_s=mean("time/train_s") or 0.0, train_cpu_s=mean("time/train_cpu_s") or 0.0,
        query_ms=latency.p50_ms if latency else None, query_p95_ms=latency.p95_ms if latency else None,
        to_copy=latency.to_copy if latency else None, load=mean("machine/load"),
        earlier=" ".join(sorted({one.earlier for one in same if one.earlier})),
        label=_label(facts),
    )  # fmt: skip


def _label(facts: Sequence[Mapping[str, Any]]) -> str:
    """What stands behind the name of the method in the label that most of its draws have."""
    label, _ = Counter(str(f.get("model/label") or "") for f in facts).most_common(1)[0]
    return label[label.find(" (") :] if " (" in label else ""


@dataclass(frozen=True)
class Result(Cell):
    """One scored cell, so that anyone can pair what they like.

    Attributes:
        figure, value: the deciding figure.
        train_s, train_cpu_s: of one model [s].
        load: 1-minute load per core at the end of the training.
    """

    figure: str
    value: float
    train_s: float
    train_cpu_s: float
    load: float | None


def results(filled: Sequence[Filled]) -> list[Result]:
    """Of every scored cell."""
    return [
        Result(
            **asdict(one.cell), figure=figure, value=one.facts[f"test/{figure}"],
            train_s=one.facts["time/train_s"], train_cpu_s=one.facts["time/train_cpu_s"],
            load=one.facts.get("machine/load"),
        )
        for one in filled if one.scored() for figure in [DECIDING[one.facts["dataset/kind"]]]
    ]  # fmt: skip


@dataclass(frozen=True)
class Block:
    """The table of one problem and budget, best first."""

    dataset: str
    split: str
    budget_s: float | None
    rows: tuple[Row, ...]

    @property
    def title(self) -> str:
        """Names and budget."""
        budget = "" if self.budget_s is None else f", {self.budget_s:g} s of training per model"
        draws = max(row.seeds for row in self.rows) if any(row.draws for row in self.rows) else 0
        drawn = f", {draws} draws (± standard error of the mean)" if draws > 1 else ", one draw" * draws
        return f"{self.dataset}, split {self.split}{budget}{drawn}"


def blocks(found: Sequence[Row]) -> list[Block]:
    """One per dataset, split and budget; methods without a budget stand in each."""
    result = []
    for (dataset, split), group in groupby(found, lambda r: (r.dataset, r.split)):
        here = sorted(group, key=lambda r: r.budget_s is not None)
        budgets: list[float | None] = [*sorted({r.budget_s for r in here if r.budget_s is not None})]
        for budget in budgets or [None]:
            members = [r for r in here if r.budget_s in (None, budget)]
            result.append(Block(dataset, split, budget, tuple(sorted(members, key=lambda r: -r.score_db))))
    return result


def remarks(block: Block, ours: str) -> list[str]:
    """What the table shows about simple baselines and about our own default, favourable or not."""
    first = block.rows[0]
    found = [f"first: {first.method}, {first.score_db:.2f} dB after {first.train_s:.3g} s of training"]
    if first.method in SIMPLE and any(row.method not in SIMPLE for row in block.rows):
        found.append(f"a simple baseline wins: take {first.method} for this data and split")
    own = next((r for r in block.rows if r.method == ours), None)
    if own is not None and own is not first:
        gap = f"{ours} is {first.score_db - own.score_db:.2f} dB behind {first.method}"
        spread = float(np.hypot(own.spread_db or 0.0, first.spread_db or 0.0))  # of both over seeds
        level = own.score_db >= first.score_db - spread
        found.append(gap + (", within the seeds' spread" if level else ""))
    if own is not None and own.outage is not None and (first.outage or 0.0) > own.outage:
        both = f"Brier score {first.outage:.4f}, of {ours} {own.outage:.4f}"
        found.append(f"errors are of places that were heard; {first.method} predicts outages worse: {both}")
    for row in block.rows:
        if own is not None and row.method in SIMPLE and row.score_db > own.score_db and row is not first:
            found.append(f"{row.method} (simple) also beats {ours}, by {row.score_db - own.score_db:.2f} dB")
    close = [r for r in block.rows if r.score_db >= first.score_db - CLOSE_DB and r.query_ms is not None]
    if close:
        quick = min(close, key=lambda r: r.query_ms or np.inf)
        near = f"fastest within {CLOSE_DB} dB of the first"
        found.append(f"{near}: {quick.method}, {quick.query_ms:.3g} ms a query")
    old = ", ".join(f"{r.method} ({r.earlier})" for r in block.rows if r.earlier)
    if old:
        found.append(f"measured before the program or its settings were last changed (at commit): {old}")
    loads = [r.load for r in block.rows if r.load is not None and r.budget_s is not None]
    if loads and max(loads) > BUSY:
        found.append(
            f"the machine was busy (load up to {max(loads):.1f} per core): train s is inflated, "
            "cpu s is what was spent"
        )
    return found


def markdown(
    found: Sequence[Block], ours: str, timed: Mapping[str, Mapping[str, Latency]] | None = None
) -> str:
    """All blocks as one page, and what was timed but is too slow to be scored."""
    pages = [_page(block, ours) for block in found]
    scored = {row.method for block in found for row in block.rows}
    pages += [
        f"{name} on {dataset}: {latency.p50_ms / 1e3:.3g} s a query, timed only ({latency.rounds} rounds)"
        for dataset, here in (timed or {}).items()
        for name, latency in here.items()
        if name not in scored
    ]
    return "\n\n".join(pages) + "\n"


def _page(block: Block, ours: str) -> str:
    columns = _columns(block)
    lines = ["| " + " | ".join(columns) + " |", "|---" + "|---:" * (len(columns) - 1) + "|"]
    for row in block.rows:
        cells = [write(row) for write in columns.values()]
        bold = row.method == ours
        lines.append("| " + " | ".join(f"**{c}**" if bold else c for c in cells) + " |")
    return "\n".join([f"### {block.title}", "", *lines, "", *(f"- {r}" for r in remarks(block, ours))])


def _columns(block: Block) -> dict[str, Callable[[Row], str]]:
    """Head of each column, and how a row fills it; columns that no row fills are left out."""
    some, drawn = block.rows[0], any(row.draws for row in block.rows)
    plain = some.figure == "psnr_db"  # is its own score

    def near(value: float | None, error: float | None, form: str) -> str:
        return shown(value, form) + ("" if error is None else f" ± {error:{form}}")

    found: dict[str, Callable[[Row], str]] = {
        "method": lambda r: r.method + r.label,
        SCORE[some.figure]: lambda r: near(r.score_db, r.spread_db, ".2f"),
    }
    if drawn:
        found["behind the best, dB"] = lambda r: near(r.behind_db, r.behind_error_db, ".2f")
    if not plain and not (drawn and some.figure == "rmse_db"):  # that is the score but for its sign
        found[some.figure] = lambda r: near(r.value, r.value_error, ".3g" if drawn else ".4g")
    found[some.second] = lambda r: shown(r.second_value, ".4g")
    if any(row.after_constant is not None for row in block.rows):
        found["after a constant, dB"] = lambda r: shown(r.after_constant, ".2f")
    if any(row.coverage is not None for row in block.rows):
        found["in 90 % interval"] = lambda r: shown(r.coverage, ".2f")
    if any(row.outage is not None for row in block.rows):
        found["outage, Brier score"] = lambda r: shown(r.outage, ".4f")
    if not drawn:
        found["seeds"] = lambda r: str(r.seeds)
    return found | {
        "train s": lambda r: f"{r.train_s:.3g}",
        "cpu s": lambda r: f"{r.train_cpu_s:.3g}",
        "query ms p50": lambda r: shown(r.query_ms, ".3g"),
        "p95": lambda r: shown(r.query_p95_ms, ".3g"),
        "x copy": lambda r: shown(r.to_copy, ".2g"),
    }


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
    figure = heading_of(rows[0].figure).replace(" dB", ", dB")
    title = f"### {rows[0].dataset}: {figure}, {draws} draws of each split"
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
