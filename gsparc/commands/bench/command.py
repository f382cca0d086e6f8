"""`gsparc bench`: timings of kernels and queries as ratios to the machine's limit."""

from __future__ import annotations

import gc
import logging
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.table import Table

from gsparc.commands.bench import kernels, layers
from gsparc.commands.bench.claims import Claim, claims
from gsparc.commands.bench.measure import Case, Machine, Row, facts, measure
from gsparc.commands.bench.scene import NETWORK, scene
from gsparc.commands.output import run_directory
from gsparc.evaluation.console import open_console
from gsparc.evaluation.summary import provenance, table, write_summary
from gsparc.ops.native import instruction_set
from gsparc.prediction.timing import ClockSettings, machine_facts, peak_memory

log = logging.getLogger(__name__)

MOVING = (kernels.plan, kernels.moving, kernels.weights)  # a batch is as many plans
RASTERIZER = (*MOVING[:2], kernels.static, kernels.frozen, kernels.backward, kernels.weights)
MOST_PLANNED = 1_000_000  # Gaussians times poses in one call


def cases(config: DictConfig) -> Iterator[Case]:
    """All rows of the configured sizes, one alive at a time."""
    for count in config.counts:
        for projection in config.projections:
            field = scene(count, projection)
            for make in RASTERIZER:
                for batch in config.batches:
                    if make in MOVING and count * batch > MOST_PLANNED:
                        log.info("%s of %d x %d Gaussians left out: too long", make.__name__, batch, count)
                        continue
                    yield make(field, batch)
            yield layers.channel(field, 1, 1, 1)
            yield layers.channel(field, *layers.MANY, 1)
        for batch in config.batches:
            yield layers.emission(count, batch)
            yield layers.emission(count, batch, NETWORK)
            yield layers.emission_backward(count, batch)
    for batch in config.batches:
        yield layers.loss(batch)
    for projection in config.projections:
        yield layers.step(projection)


def task(config: DictConfig) -> dict[str, Any]:
    """What the command does; returns the facts it wrote to `summary.json` in the run directory."""
    if config.quick:
        small = {"counts": [200, 400], "batches": [1, 2], "threads": [1], "rounds": 2, "budget_s": 0.01}
        config = config.copy()
        config.update(small)
    clock = ClockSettings(rounds=config.rounds, least=2, warmup=1, budget_s=config.budget_s)
    machine, console = Machine(), open_console()
    before = machine_facts()["machine/load"]
    rows: list[Row] = []
    gc.collect()
    gc.freeze()  # what the imports left behind is not searched again in the middle of a call
    for case in cases(config):
        for turn, threads in enumerate(config.threads):
            wanted = turn == 0 and not config.quick
            rows.append(measure(case, machine, threads, clock, references=wanted))
        log.info("%s: %.3g ms, %.1f x the limit", case.key, float(rows[-1].kernel.mean()), rows[-1].over)
    promises = [
        (f"{projection}, {threads} threads", claim)
        for projection, threads in product(config.projections, config.threads)
        for claim in claims(projection, list(config.counts), threads, max(config.batches), machine, clock)
    ]
    found: dict[str, Any] = {**machine_facts(), **peak_memory(), **provenance()}
    found["machine/instruction_set"] = instruction_set()
    for row in rows:
        found |= facts(row)
    for where, claim in promises:
        stem = f"claim/{claim.name}/{where}".replace(",", "").replace(" ", "_")
        found |= {f"{stem}/ratio": claim.ratio, f"{stem}/promised": claim.bound, f"{stem}/met": claim.met}
    found["machine/load_before"] = before
    run_dir = run_directory()
    write_summary(run_dir / "summary.json", found)
    (run_dir / "bench.md").write_text(markdown(found, rows, promises), encoding="utf-8")
    console.print(rows_table(rows, f"{found['machine/cpu']}, {found['machine/instruction_set']}"))
    console.print(claims_table(promises, "Promises"))
    return found


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
