"""The table people read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from gsparc.benchmark.claims import Claim
from gsparc.benchmark.measure import Row


def rows_table(rows: Sequence[Row], title: str) -> Table:
    """Every row: time, limit, ratio."""
    table = Table(title=title, caption="ms, median; limit: see gsparc/benchmark/measure.py")
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


def _ms(value: float) -> str:
    return f"{value:.3g}"
