"""`gsparc bench`: timings of kernels and queries as ratios to the machine's limit."""

from __future__ import annotations

import gc
import logging
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.table import Table

from gsparc.commands.shared.output import run_directory
from gsparc.evaluation.console import open_console
from gsparc.evaluation.summary import markdown_table, provenance, shown, table, write_summary
from gsparc.ops.native import instruction_set
from gsparc.prediction.bench.claims import Claim, cases, claims
from gsparc.prediction.bench.measure import Machine, Row, facts, measure
from gsparc.prediction.timing import ClockSettings, machine_facts, peak_memory

log = logging.getLogger(__name__)

# For tests and a first look: every case runs, and no time of it means anything.
QUICK = {"counts": [200, 400], "batches": [1, 2], "threads": [1], "rounds": 2, "budget_s": 0.01}
ROWS = ("N", "batch", "threads", "kernel", "end to end", "PyTorch", "limit", "kernel / limit")


def task(config: DictConfig) -> dict[str, Any]:
    """Time all cases and promises; return the facts written to `summary.json` in the run directory."""
    if config.quick:
        config = config.copy()
        config.update(QUICK)
    clock = ClockSettings(rounds=config.rounds, least=2, warmup=1, budget_s=config.budget_s)
    # The load before anything ran: afterwards it is this program's own.
    machine, before, rows = Machine(), machine_facts()["machine/load"], list[Row]()
    gc.collect()
    gc.freeze()  # what the imports left behind is not searched again in the middle of a call
    for case in cases(config.counts, config.projections, config.batches):
        for turn, threads in enumerate(config.threads):
            # References in plain PyTorch are slow, and are timed with one number of threads alone.
            references = turn == 0 and not config.quick
            rows.append(measure(case, machine, threads, clock, references=references))
        log.info("%s: %.3g ms, %.1f x the limit", case.key, float(rows[-1].kernel.mean()), rows[-1].over)
    promises = [
        (f"{projection}, {threads} threads", claim)
        for projection, threads in product(config.projections, config.threads)
        for claim in claims(projection, list(config.counts), threads, machine, clock)
    ]
    summary: dict[str, Any] = {**machine_facts(), **peak_memory(), **provenance()}
    summary |= {"machine/instruction_set": instruction_set(), "machine/load_before": before}
    for row in rows:
        summary |= facts(row)
    for where, claim in promises:
        stem = f"claim/{claim.name}/{where}".replace(",", "").replace(" ", "_")
        summary |= {f"{stem}/ratio": claim.ratio, f"{stem}/promised": claim.bound, f"{stem}/met": claim.met}
    run_dir, console = run_directory(), open_console()
    write_summary(run_dir / "summary.json", summary)
    tables = rows_table(rows), claims_table(promises)
    # Promises first: whether they hold is what the page is opened for.
    (run_dir / "bench.md").write_text(page(summary, tables[::-1]), encoding="utf-8")
    tables[0].title = f"{summary['machine/cpu']}, {summary['machine/instruction_set']}"
    console.print(*tables, sep="\n")
    return summary


def rows_table(rows: Sequence[Row]) -> Table:
    """Return a table of every row: time, limit, ratio."""
    sheet = table("", ["operation", "projection"], ROWS, [])
    sheet.caption = "ms, median; limit: see gsparc/prediction/bench/measure.py"
    for row in rows:
        case, whole = row.case, None if row.whole is None else float(np.median(row.whole))
        numbers = case.count, case.batch, row.threads, f"{np.median(row.kernel):.3g}", shown(whole, ".3g")
        reference = (case.unaffordable or "-") if row.reference is None else f"{row.reference:.3g}"
        ratio = reference, f"{row.limit:.3g} ({row.bound})", f"{row.over:.1f}"
        sheet.add_row(case.name, case.projection, *map(str, numbers), *ratio)
    return sheet


def claims_table(claims: Sequence[tuple[str, Claim]]) -> Table:
    """Return a table of every promise and whether it holds here."""
    sheet = table("Promises", ["promise", "where"], ["ratio", "promised", "met"], [])
    for where, claim in claims:
        bound = f"{'at least' if claim.at_least else 'at most'} {claim.bound:g}"
        cells = claim.name, where, f"{claim.ratio:.2f}", bound, "yes" if claim.met else "no"
        sheet.add_row(*cells, style=None if claim.met else "yellow")
    return sheet


def page(facts: Mapping[str, object], tables: Sequence[Table]) -> str:
    """Return tables as Markdown, under the machine, its load and the commit they were measured at."""
    load = f"load per core {facts['machine/load_before']:.2f} before and {facts['machine/load']:.2f} after"
    head = f"{facts['machine/cpu']}, {facts['machine/instruction_set']}, {facts['machine/cores']} cores"
    lines = [f"# {head}, {load}, commit {facts['git']}"]
    lines += ["", "Ratios of interleaved rounds (fastest fifth), times in ms (median)."]
    for columns in (each.columns for each in tables):
        cells = zip(*(map(str, column.cells) for column in columns), strict=True)
        lines += ["", *markdown_table([str(column.header) for column in columns], cells, numbers=True)]
    return "\n".join(lines) + "\n"
