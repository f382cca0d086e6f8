"""The table people read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from gsparc.studies.bench.claims import Claim
from gsparc.studies.bench.measure import Row


def rows_table(rows: Sequence[Row], title: str) -> Table:
    """Every row: time, limit, ratio."""
    table = Table(title=title, caption="ms, median; limit: see gsparc/studies/bench/measure.py")
    for name in ("operation", "projection"):
        table.add_column(name)
    for name in ("N", "batch", "threads", "kernel", "end to end", "PyTorch", "limit", "kernel / limit"):
        table.add_column(name, justify="right")
    for row in rows:
        case = row.case
        table.add_row(
            *(case.name, case.projection, str(case.count), str(case.batch), str(row.threads)),
            _ms(float(np.median(row.kernel))),
            "-" if row.whole is None else _ms(float(np.median(row.whole))),
            (case.unaffordable or "-") if row.reference is None else _ms(row.reference),
            f"{_ms(row.limit)} ({row.bound})",
            f"{row.over:.1f}",
        )
    return table


def claims_table(claims: Sequence[tuple[str, Claim]], title: str) -> Table:
    """Every promise and whether it holds here."""
    table = Table(title=title)
    table.add_column("promise")
    table.add_column("where")
    for name in ("ratio", "promised", "met"):
        table.add_column(name, justify="right")
    for where, claim in claims:
        sign = "at least" if claim.at_least else "at most"
        cells = (claim.name, where, f"{claim.ratio:.2f}", f"{sign} {claim.bound:g}")
        table.add_row(*cells, "yes" if claim.met else "no", style=None if claim.met else "yellow")
    return table


def markdown(facts: Mapping[str, object], rows: Sequence[Row], claims: Sequence[tuple[str, Claim]]) -> str:
    """Promises and rows as a page, under the machine, its load and the commit they were measured at."""
    load = f"load per core {facts['machine/load_before']:.2f} before and {facts['machine/load']:.2f} after"
    head = f"{facts['machine/cpu']}, {facts['machine/instruction_set']}, {facts['machine/cores']} cores"
    head += f", {load}, commit {facts['git']}"
    lines = [f"# {head}", "", "Ratios of interleaved rounds (fastest fifth), times in ms (median).", ""]
    lines += ["| promise | where | ratio | promised | met |", "|---|---|---:|---:|---|"]
    for where, claim in claims:
        sign, met = "at least" if claim.at_least else "at most", "yes" if claim.met else "no"
        lines.append(f"| {claim.name} | {where} | {claim.ratio:.2f} | {sign} {claim.bound:g} | {met} |")
    lines += [
        "",
        "| operation | projection | N | batch | threads | kernel | end to end | PyTorch | limit | ratio |",
    ]
    lines.append("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        case = row.case
        whole = "-" if row.whole is None else _ms(float(np.median(row.whole)))
        reference = "-" if row.reference is None else _ms(row.reference)
        lines.append(
            f"| {case.name} | {case.projection} | {case.count} | {case.batch} | {row.threads} "
            f"| {_ms(float(np.median(row.kernel)))} | {whole} | {reference} "
            f"| {_ms(row.limit)} ({row.bound}) | {row.over:.1f} |"
        )
    return "\n".join(lines) + "\n"


def _ms(value: float) -> str:
    return f"{value:.3g}"
