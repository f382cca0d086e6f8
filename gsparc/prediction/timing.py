"""Time, machine and memory: no accuracy is shown without them."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from gsparc.base.limits import Checked, setting, whole
from gsparc.data.schema import Measurements
from gsparc.models.method import Method
from gsparc.models.predicting import predict_with_threads

Key = TypeVar("Key")
Call = Callable[[int], object]

QUERIES = 64  # different ones, by turns
COPY = "copy"
# to_copy: in units of a copy of the same rounds
SPEED = ("query_ms", "query_p95_ms", "to_copy", "rounds")
# Their names in summaries and in `tradeoff.csv`.
FACTS = {"query_ms": "render_ms_p50", "query_p95_ms": "render_ms_p95", "to_copy": "ratio_to_copy"}
COPY_BYTES = 16 * 2**20  # beyond most second-level caches, below a second everywhere


@dataclass(frozen=True)
class ClockSettings(Checked):
    """How long to measure.

    Attributes:
        rounds: largest number of rounds, each visiting every contender once.
        least: rounds that are run even when they exceed `rounds_s`.
        warmup: calls of each contender before the clock starts.
        rounds_s: no new round starts after this many seconds [s].
        calls: timed calls of a visit.
        untimed: calls at the start of each visit, which bring the contender's data back into the
            caches.
    """

    rounds: int = setting(60, whole(1))
    least: int = 5
    warmup: int = 3
    rounds_s: float = 5.0
    calls: int = 1
    untimed: int = 0


# Where contenders differ in threads: a new team of threads slows the first call of every visit.
BLOCKS = ClockSettings(rounds=40, warmup=0, rounds_s=60.0, calls=4, untimed=1)


def time_interleaved(
    contenders: Mapping[Key, Call],
    settings: ClockSettings | None = None,
    threads: Mapping[Key, int] | None = None,
) -> dict[Key, np.ndarray]:
    """Measure wall times (rounds * calls,) [ms] of each contender.

    Rounds alternate so that a competing process hits all of them alike; each timed call is given
    another number (to take another query each time)
    and the device is synchronised before the clock is read.

    Args:
        contenders: what to call.
        settings: how long to measure.
        threads: CPU threads of each, in whose order a round visits them; None leaves them as they
            are.
    """
    settings = settings or ClockSettings()
    before = torch.get_num_threads()
    threads = threads or dict.fromkeys(contenders, before)
    # Within a round the number of threads then changes as seldom as can be.
    order = sorted(contenders, key=threads.__getitem__)
    for call in contenders.values():
        for warm in range(settings.warmup):
            call(warm)
    times: dict[Key, list[float]] = {name: [] for name in contenders}
    begin = time.perf_counter()
    try:
        for turn in range(settings.rounds):
            if turn >= settings.least and time.perf_counter() - begin > settings.rounds_s:
                break
            for name in order:
                if torch.get_num_threads() != threads[name]:
                    torch.set_num_threads(threads[name])
                times[name] += _time_round(contenders[name], turn, settings)
    finally:
        torch.set_num_threads(before)
    return {name: np.array(values) for name, values in times.items()}


def _time_round(call: Call, turn: int, settings: ClockSettings) -> list[float]:
    """Wall times [ms] of a contender's calls in one round."""
    for _ in range(settings.untimed):
        call(turn)
    times = []
    for number in range(turn * settings.calls, (turn + 1) * settings.calls):
        synchronise()
        # A GPU works behind the call: the clock is read when it has nothing left to do.
        start = time.perf_counter()
        call(number)
        synchronise()
        times.append((time.perf_counter() - start) * 1e3)
    return times


def query_calls(
    methods: Mapping[Key, Method], data: Measurements, rows: np.ndarray, size: int = 1
) -> dict[Key, Call]:
    """Return calls that ask a method each about `size` of the rows (n,), another set every time.

    There are at most `QUERIES` sets, without targets.
    """
    # Positions need no images
    where = replace(data, target=np.zeros((len(data), 1), np.uint8), mask=None)
    picks = [
        np.take(rows, np.arange(i, i + size), mode="wrap") for i in range(min(len(rows), QUERIES))
    ]
    queries = [where.batch(pick) for pick in picks]

    def call(method: Method) -> Call:
        return lambda turn: predict_with_threads(method, queries[turn % len(queries)])

    return {name: call(method) for name, method in methods.items()}


def p50_p95(times: np.ndarray) -> tuple[float, float]:
    """Return median and 95th percentile of times (n,).

    >>> p50_p95(np.arange(101.0))
    (50.0, 95.0)
    """
    return float(np.median(times)), float(np.quantile(times, 0.95))


def time_beside_copy(
    calls: Mapping[Key, Call],
    clock: ClockSettings | None = None,
    threads: Mapping[Key, int] | None = None,
) -> dict[Key, dict[str, float]]:
    """Return `SPEED` of calls by name, timed in turns with one another and a copy;
    see `time_interleaved`.
    """
    timed: dict[Any, Call] = {COPY: reference_copy(), **calls}
    # A copy of memory is made by one thread.
    times = time_interleaved(timed, clock, None if threads is None else {COPY: 1} | dict(threads))
    copy_ms = float(np.median(times.pop(COPY)))
    rows = ((name, *p50_p95(ms), len(ms)) for name, ms in times.items())
    return {
        name: dict(zip(SPEED, (p50, p95, p50 / copy_ms, n), strict=True))
        for name, p50, p95, n in rows
    }


def reference_copy() -> Call:
    """Return a fixed piece of work, a 16 MiB copy,
    against which times of different machines can be read.
    """
    source = torch.ones(COPY_BYTES // 4)
    target = torch.empty_like(source)
    return lambda turn: target.copy_(source)


def machine_facts() -> dict[str, float | int | str | None]:
    """Return `machine/*`: threads, cores, 1-minute load per core, processor and accelerator."""
    cores = len(os.sched_getaffinity(0))
    return {
        "machine/threads": torch.get_num_threads(),
        "machine/cores": cores,
        "machine/load": os.getloadavg()[0] / cores,
        "machine/cpu": _processor_name(),
        "machine/gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def peak_memory() -> dict[str, float]:
    """Return `memory/peak_mb`, the largest resident set so far [MB];
    `memory/gpu_peak_mb` with CUDA.
    """
    # Linux says it in KiB.
    facts = {"memory/peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6}
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        facts["memory/gpu_peak_mb"] = torch.cuda.max_memory_allocated() / 1e6
    return facts


def synchronise() -> None:
    """Wait for the accelerator, if one is used."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()


def _processor_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()
