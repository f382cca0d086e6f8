"""Channels at 1,000 places a second out of an exported field: misses and a histogram of latencies.

python examples/realtime/loop.py FOLDER/field.gsparc FOLDER/build/libgsparc_field.so X Y Z [SECONDS]
"""

from __future__ import annotations

import importlib.util
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# 1 kHz, a channel a millisecond: two slots of 5G NR at 30 kHz.
PERIOD_S = 1e-3
SPIN_S = 2e-4  # before a tick the loop does not sleep: a sleep ends late by as much
SPEED = 1.5  # [m/s]
RADIUS = 0.5  # [m] of the circle that is walked


def example(name: str):
    """The reader of fields by `ctypes`, which stands beside this example."""
    spec = importlib.util.spec_from_file_location(
        name, Path(__file__).parents[1] / "c-library" / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Run:
    """Latencies from when a place was due to its channel [s], and ticks that passed meanwhile."""

    latency_s: np.ndarray
    missed: int

    def histogram(self) -> str:
        """Counts in bins of powers of two [us]."""
        bin_of = np.ceil(np.log2(np.maximum(self.latency_s * 1e6, 1))).astype(int)
        counts = np.bincount(bin_of)
        rows = [
            f"{2**i:>8} us {count:>8}  {'#' * round(60 * count / counts.max())}"
            for i, count in enumerate(counts)
            if count
        ]
        middle, late, worst = np.percentile(self.latency_s * 1e6, [50, 99, 100])
        said = f"median {middle:.0f} us, p99 {late:.0f} us, worst {worst:.0f} us"
        return "\n".join([*rows, f"{len(self.latency_s)} answered, {self.missed} missed; {said}"])


def play(answer, centre: np.ndarray, seconds: float, period_s: float = PERIOD_S) -> Run:
    """Ask for a place each period; a tick that passes while an answer is computed is missed,
    not made up.
    """
    ticks, latency, missed, tick = int(seconds / period_s), [], 0, 0
    # 10 ms ahead, so that the first tick is not late by what comes before the loop.
    start = time.perf_counter() + 0.01
    while tick < ticks:
        due = start + tick * period_s
        rest = due - time.perf_counter()
        if rest > SPIN_S:
            time.sleep(rest - SPIN_S)
        while time.perf_counter() < due:
            pass
        turn = SPEED / RADIUS * tick * period_s
        answer(centre + RADIUS * np.array([np.cos(turn), np.sin(turn), 0]))
        now = time.perf_counter()
        latency.append(now - due)
        behind = int((now - start) / period_s) - tick  # ticks that came meanwhile
        missed += min(behind, ticks - 1 - tick)
        tick += 1 + behind
    return Run(np.array(latency), missed)


def main(arguments: list[str]) -> int:
    if len(arguments) not in (5, 6):
        sys.stderr.write(f"{__doc__}\n")
        return 2
    field = example("field").Field(*arguments[:2])
    centre = np.array([float(word) for word in arguments[2:5]])
    # Once before the clock runs: a first query finds cold caches.
    field(centre)
    run = play(field, centre, float(arguments[5]) if len(arguments) == 6 else 20.0)
    field.close()
    shape = " x ".join(map(str, field.facts.shape[:]))
    sys.stdout.write(f"{shape} values at {1 / PERIOD_S:g} Hz\n{run.histogram()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
