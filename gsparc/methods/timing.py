"""Time, machine and memory: no accuracy is shown without them."""

from __future__ import annotations

import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

COPY = "copy"
COPY_BYTES = 16 * 2**20  # beyond most second-level caches, below a second everywhere


@dataclass(frozen=True)
class ClockSettings:
    """How long to measure.

    Attributes:
        rounds: largest number of rounds.
        least: rounds that are run even when they exceed the budget.
        warmup: calls of each contender before the clock starts.
        budget_s: no new round starts after this many seconds [s].
    """

    rounds: int = 60
    least: int = 5
    warmup: int = 3
    budget_s: float = 5.0


def interleaved(
    contenders: Mapping[str, Callable[[int], object]], settings: ClockSettings | None = None
) -> dict[str, np.ndarray]:
    """Wall times (rounds,) [ms] of each contender, one call of each per round.

    Rounds alternate so that a competing process hits all of them alike; each call is given the round's number
    (to take another query each time) and the device is synchronised before the clock is read.
    """
    settings = settings or ClockSettings()
    for call in contenders.values():
        for warm in range(settings.warmup):
            call(warm)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    begin = time.perf_counter()
    for turn in range(settings.rounds):
        if turn >= settings.least and time.perf_counter() - begin > settings.budget_s:
            break
        for name, call in contenders.items():
            synchronise()
            start = time.perf_counter()
            call(turn)
            synchronise()
            times[name].append((time.perf_counter() - start) * 1e3)
    return {name: np.array(values) for name, values in times.items()}


def reference_copy() -> Callable[[int], object]:
    """A fixed piece of work, a 16 MiB copy, against which times of different machines can be read."""
    source = torch.ones(COPY_BYTES // 4)
    target = torch.empty_like(source)
    return lambda turn: target.copy_(source)


def machine_facts() -> dict[str, float | int | str | None]:
    """`machine/*`: threads, cores, 1-minute load per core, processor and accelerator."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0] / cores if hasattr(os, "getloadavg") else None
    return {
        "machine/threads": torch.get_num_threads(),
        "machine/cores": cores,
        "machine/load": load,
        "machine/cpu": _processor(),
        "machine/gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def peak_memory() -> dict[str, float]:
    """`memory/peak_mb`: largest resident set of the process so far [MB]; `memory/gpu_peak_mb` with CUDA."""
    unit = 1 if sys.platform == "darwin" else 1024
    facts = {"memory/peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6}
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        facts["memory/gpu_peak_mb"] = torch.cuda.max_memory_allocated() / 1e6
    return facts


def synchronise() -> None:
    """Wait for the accelerator, if one is used."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
