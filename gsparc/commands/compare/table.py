"""Cells of one problem and budget side by side: accuracy, latency, training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from gsparc.commands.compare.fitting import Filled
from gsparc.commands.compare.latency import Latency
from gsparc.data.schema import Kind
from gsparc.evaluation.figures import DECIDING, score_of
from gsparc.evaluation.summary import BUSY, shown

SECOND: dict[Kind, str] = {"spectrum": "ssim", "csi": "snr_db", "rssi": "mae_db"}
SCORE = {"psnr_db": "PSNR dB", "nmse": "-10 log10 NMSE, dB", "rmse_db": "-RMSE dB"}
SIMPLE = ("zero", "mean", "nearest", "idw", "gp", "kriging", "complex_gp")
CLOSE_DB = 0.5


@dataclass(frozen=True)
class Row:
    """A method under one budget, over its seeds.

    Attributes:
        dataset, split: names.
        budget_s: [s]; None for a method without one, which stands in the tables of all budgets.
        method: name.
        score_db: larger is better [dB]: PSNR, -10 log10 NMSE, or -RMSE.
        spread_db: standard deviation over seeds [dB]; None for a single one.
        seeds: how many.
        figure, value: the figure behind the score, mean over seeds.
        second, second_value: another figure for the reader.
        train_s, train_cpu_s: seconds of training per model, on the clock and of processor [s].
        query_ms: one query, median [ms]; None when not timed.
        query_p95_ms: 95th percentile [ms].
        to_copy: the median in units of a 16 MiB copy of the same rounds.
        load: 1-minute load per core at the end of the training, mean over seeds.
        earlier: commits of earlier program text that it was measured with; empty for today's.
    """

    dataset: str
    split: str
    budget_s: float | None
    method: str
    score_db: float
    spread_db: float | None
    seeds: int
    figure: str
    value: float
    second: str
    second_value: float | None
    train_s: float
    train_cpu_s: float
    query_ms: float | None
    query_p95_ms: float | None
    to_copy: float | None
    load: float | None
    earlier: str = ""


def score_db(kind: Kind, facts: Mapping[str, Any]) -> float:
    """The figure places are given by, as decibels of which more are better."""
    figure = DECIDING[kind]
    return score_of(figure, float(facts[f"test/{figure}"]))


def rows(filled: Sequence[Filled], timed: Mapping[str, Mapping[str, Latency]]) -> list[Row]:
    """Average the scored cells over seeds.

    `timed` holds latencies by dataset and method, of the dataset's first split and shown there alone: models
    of fewer measurements answer faster.
    """
    groups: dict[tuple[str, str, float, str], list[Filled]] = {}
    for cell, one in ((one.cell, one) for one in filled if one.scored()):
        groups.setdefault((cell.dataset, cell.split, cell.budget_s or 0.0, cell.method), []).append(one)
    problems = list(dict.fromkeys((dataset, split) for dataset, split, *_ in groups))
    first = dict(reversed(problems))
    return [
        _row(groups[key], timed.get(key[0], {}).get(key[3]) if key[1] == first[key[0]] else None)
        for key in sorted(groups, key=lambda key: (problems.index(key[:2]), *key))
    ]


def _row(same: list[Filled], latency: Latency | None) -> Row:
    cell, facts = same[0].cell, [one.facts for one in same]
    kind: Kind = facts[0]["dataset/kind"]
    scores = [score_db(kind, f) for f in facts]

    def mean(name: str) -> float | None:
        values = [f[name] for f in facts if f.get(name) is not None]
        return float(np.mean(values)) if values else None

    return Row(
        cell.dataset, cell.split, cell.budget_s, cell.method,
        score_db=float(np.mean(scores)),
        spread_db=float(np.std(scores, ddof=1)) if len(scores) > 1 else None,
        seeds=len(same),
        figure=DECIDING[kind], value=mean(f"test/{DECIDING[kind]}") or 0.0,
        second=SECOND[kind], second_value=mean(f"test/{SECOND[kind]}"),
        train_s=mean("time/train_s") or 0.0, train_cpu_s=mean("time/train_cpu_s") or 0.0,
        query_ms=latency.p50_ms if latency else None, query_p95_ms=latency.p95_ms if latency else None,
        to_copy=latency.to_copy if latency else None, load=mean("machine/load"),
        earlier=" ".join(sorted({one.earlier for one in same if one.earlier})),
    )  # fmt: skip


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
        return f"{self.dataset}, split {self.split}{budget}"


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
    if first.method in SIMPLE:
        found.append(f"a simple baseline wins: take {first.method} for this data and split")
    own = next((r for r in block.rows if r.method == ours), None)
    if own is not None and own is not first:
        gap = f"{ours} is {first.score_db - own.score_db:.2f} dB behind {first.method}"
        spread = float(np.hypot(own.spread_db or 0.0, first.spread_db or 0.0))  # of both over seeds
        level = own.score_db >= first.score_db - spread
        found.append(gap + (", within the seeds' spread" if level else ""))
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
    some = block.rows[0]
    plain = some.figure == "psnr_db"  # is its own score
    head = ["method", SCORE[some.figure], *([] if plain else [some.figure]), some.second, "seeds",
            "train s", "cpu s", "query ms p50", "p95", "x copy"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    for row in block.rows:
        near = "" if row.spread_db is None else f" ± {row.spread_db:.2f}"
        raw = [] if plain else [f"{row.value:.4g}"]
        cells = [row.method, f"{row.score_db:.2f}{near}", *raw, shown(row.second_value, ".4g"),
                 str(row.seeds), f"{row.train_s:.3g}", f"{row.train_cpu_s:.3g}", shown(row.query_ms, ".3g"),
                 shown(row.query_p95_ms, ".3g"), shown(row.to_copy, ".2g")]  # fmt: skip
        bold = row.method == ours
        lines.append("| " + " | ".join(f"**{c}**" if bold else c for c in cells) + " |")
    return "\n".join([f"### {block.title}", "", *lines, "", *(f"- {r}" for r in remarks(block, ours))])
