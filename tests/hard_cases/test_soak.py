"""Soak: threads that load, ask and reject for minutes; answers stay the same and memory stays flat.

Remedy: a predictor is not changed by a question, plans own their buffers, and what is cached is bounded.
`make soak` takes 30 minutes, the slow tests 40 seconds.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from outdated import GONE

import gsparc
from gsparc.methods.checkpoint import CheckpointError

STORED = Path(__file__).parents[1] / "methods" / "old_checkpoints"
THREADS = 4
HEADROOM_MB = 24  # an allocator keeps what it once held: 4 threads, up to 6 MB each


def resident_mb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def questions() -> dict[str, dict[str, np.ndarray]]:
    """Where each checkpoint is asked, in world coordinates."""
    with np.load(STORED / "expected.npz") as stored:
        asked = {key.partition("/")[0]: key for key in stored.files if key.endswith("/asked_at")}
        return {name: {"asked_at": stored[key]} for name, key in asked.items() if name not in GONE}


def ask(predictor: gsparc.Predictor, places: np.ndarray) -> np.ndarray:
    return getattr(predictor, predictor.site.kind)(**{predictor.site.moving_end: places})


class Worker(threading.Thread):
    """Draws what to do until told to stop; keeps the first exception."""

    def __init__(self, number: int, shared: dict, expected: dict, damaged: Path, stop: threading.Event):
        super().__init__(daemon=True)
        self.draw, self.shared, self.expected = random.Random(number), shared, expected
        self.damaged, self.stop, self.done, self.error = damaged, stop, 0, None

    def run(self) -> None:
        try:
            while not self.stop.is_set():
                self.draw.choice((self.query, self.query, self.query, self.load, self.reject))()
                self.done += 1
        except BaseException as error:
            self.error = error
            self.stop.set()

    def check(self, name: str, predictor: gsparc.Predictor) -> None:
        places, answer = self.expected[name]
        rows = self.draw.sample(range(len(places)), self.draw.randint(1, len(places)))
        found = ask(predictor, places[rows])
        # Sums over another number of rows are taken in another order.
        np.testing.assert_allclose(found, answer[rows], rtol=1e-3, atol=1e-4 * np.abs(answer).max())

    def query(self) -> None:
        name = self.draw.choice(sorted(self.shared))
        self.check(name, self.shared[name])

    def load(self) -> None:
        name = self.draw.choice(sorted(self.shared))
        self.check(name, gsparc.load(STORED / f"{name}.ckpt"))

    def reject(self) -> None:
        with pytest.raises(CheckpointError):
            gsparc.load(self.damaged)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_loads_and_queries_from_threads_leave_answers_and_memory_alone(tmp_path, request):
    minutes = request.config.getoption("--soak-minutes", None) or 40 / 60
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    asked = questions()
    shared = {name: gsparc.load(STORED / f"{name}.ckpt") for name in asked}
    expected = {name: (k["asked_at"], ask(shared[name], k["asked_at"])) for name, k in asked.items()}
    sound = (STORED / "gp.ckpt").read_bytes()
    damaged = tmp_path / "damaged.ckpt"
    damaged.write_bytes(sound[: len(sound) // 2])
    stop, end = threading.Event(), time.monotonic() + 60 * minutes
    workers = [Worker(number, shared, expected, damaged, stop) for number in range(THREADS)]
    sizes = []
    try:
        for worker in workers:
            worker.start()
        while time.monotonic() < end and not stop.wait(min(1.0, minutes)):
            sizes.append(resident_mb())
    finally:
        stop.set()
        for worker in workers:
            worker.join(30)
        torch.set_num_threads(before)
    assert [worker.error for worker in workers] == [None] * THREADS
    assert min(worker.done for worker in workers) > 20
    # The first fifth fills caches and the allocator's pools.
    steady = np.array(sizes[len(sizes) // 5 :])
    early, late = np.median(steady[: len(steady) // 4]), np.median(steady[-(len(steady) // 4) :])
    done = sum(worker.done for worker in workers)
    sys.stdout.write(f"{done} operations in {minutes:.1f} min; {early:.0f} MB, then {late:.0f} MB\n")
    assert late - early < HEADROOM_MB
