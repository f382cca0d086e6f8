"""`gsparc bench`: seconds of every kernel, and the ratio to the same in plain PyTorch."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from omegaconf import DictConfig

from gsparc.base.limits import check_arguments, choice
from gsparc.evaluation.table import Column, Table
from gsparc.ops.backends import backend_named
from gsparc.prediction.bench import Call, kernel_cases, loss_case, training_step_case
from gsparc.prediction.timing import ClockSettings, time_interleaved
from gsparc.runs.output import Result, run_directory

COLUMNS = (
    Column("kernel", ""),
    Column("size", ""),
    Column("seconds", ".3g"),
    Column("in torch", ".3g"),
    Column("times faster", ".3g"),
)
# A dense reference may take seconds: after half a second no new round begins.
REFERENCE = ClockSettings(rounds=3, least=1, warmup=0, rounds_s=0.5)


def task(config: DictConfig) -> dict[str, Any]:
    """Time all kernels, BLAS with its own threads; the table is also `bench.csv`."""
    clock = ClockSettings(rounds=config.rounds, least=2, warmup=1, rounds_s=config.rounds_s)
    check_arguments(config, device=choice("cpu", "cuda"))
    device = config.device
    backend_named(device)  # where there is no such device, its reason comes first
    cases = [
        case
        for of in product(config.counts, config.projections)
        for case in kernel_cases(*of, device)
    ]
    # Emission and channels are the same under every projection: a dictionary keeps one of each.
    cases += [
        loss_case(device),
        *(training_step_case(of, device=device) for of in config.projections),
    ]
    chosen = {(case.name, case.size): case for case in cases}
    rows, facts = [], {}
    for (name, size), case in chosen.items():
        seconds = median_s(case.kernel, clock)
        reference = None if case.reference is None else median_s(case.reference, REFERENCE)
        ratio = None if reference is None else reference / seconds
        rows.append([name, size, seconds, reference, ratio])
        facts[f"bench/{name}/{size}/seconds"] = seconds
    note = "medians of warm calls; -: the dense tensors of plain PyTorch would be too large"
    sheet = Table("", COLUMNS, rows, note)
    (run_directory() / "bench.csv").write_text(sheet.csv(), encoding="utf-8")
    return Result(facts, [sheet]).show(run_directory())


def median_s(call: Call, clock: ClockSettings) -> float:
    """Return the median seconds of a call."""
    return float(np.median(time_interleaved({0: lambda turn: call()}, clock)[0])) / 1e3
