"""Timings and promised ratios as tables and as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from gsparc.commands.bench.claims import Claim
from gsparc.commands.bench.measure import Row
from gsparc.evaluation.summary import table

ROWS = ("N", "batch", "threads", "kernel", "end to end", "PyTorch", "limit", "kernel / limit")


def rows_table(rows: Sequence[Row], title: str) -> Table:
    """Every row: time, limit, ratio."""
    found = table(title, ["operation", "projection"], ROWS, map(_row, rows))
    found.caption = "ms, median; limit: see gsparc/commands/bench/measure.py"
    return found


def claims_table(claims: Sequence[tuple[str, Claim]], title: str) -> Table:
    """Every promise and whether it holds here."""
    found = table(title, ["promise", "where"], ["ratio", "promised", "met"], [])
    for where, claim in claims:
        found.add_row(*_claim(where, claim), style=None if claim.met else "yellow")
    return found


def markdown(facts: Mapping[str, object], rows: Sequence[Row], claims: Sequence[tuple[str, Claim]]) -> str:
    """Promises and rows as a page, under the machine, its load and the commit they were measured at."""
    load = f"load per core {facts['machine/load_before']:.2f} before and {facts['machine/load']:.2f} after"
    head = f"{facts['machine/cpu']}, {facts['machine/instruction_set']}, {facts['machine/cores']} cores"
    head += f", {load}, commit {facts['git']}"
    lines = [f"# {head}", "", "Ratios of interleaved rounds (fastest fifth), times in ms (median).", ""]
    lines += ["| promise | where | ratio | promised | met |", "|---|---|---:|---:|---|"]
    lines += [f"| {' | '.join(_claim(*claim))} |" for claim in claims]
    lines += ["", f"| operation | projection | {' | '.join(ROWS)} |", "|---|---|" + "---:|" * len(ROWS)]
    lines += [f"| {' | '.join(_row(row))} |" for row in rows]
    return "\n".join(lines) + "\n"


def _row(row: Row) -> list[str]:
    case = row.case
    return [
        *(case.name, case.projection, str(case.count), str(case.batch), str(row.threads)),
        _ms(float(np.median(row.kernel))),
        "-" if row.whole is None else _ms(float(np.median(row.whole))),
        (case.unaffordable or "-") if row.reference is None else _ms(row.reference),
        f"{_ms(row.limit)} ({row.bound})",
        f"{row.over:.1f}",
    ]


def _claim(where: str, claim: Claim) -> list[str]:
    bound = f"{'at least' if claim.at_least else 'at most'} {claim.bound:g}"
    return [claim.name, where, f"{claim.ratio:.2f}", bound, "yes" if claim.met else "no"]


def _ms(value: float) -> str:
    return f"{value:.3g}"
