"""Soak: threads that load, ask and reject for minutes; answers stay the same and memory stays flat.

Remedy: a predictor is not changed by a question, plans own their buffers, and what is cached is bounded.
`make soak` takes 30 minutes, the slow tests 25 seconds.
"""

import os
import random
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import RENDERED, channels, compose, powers, spectra
from contexts import loaded, short
from omegaconf import OmegaConf

import gsparc
from gsparc.models import checkpoint
from gsparc.models.checkpoint import CheckpointError
from gsparc.models.registry import build

MODELS = {  # what is loaded and asked: a method and the file it learns from
    "gp": spectra, "idw": spectra, "kriging": powers, "gp_power": powers, "complex_gp": channels,
    "gsparc": spectra,
}  # fmt: skip
THREADS = 4
HEADROOM_MB = 24  # an allocator keeps what it once held: 4 threads, up to 6 MB each


def resident_mb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def trained(folder: Path) -> dict[str, np.ndarray]:
    """Writes a checkpoint of each model; returns where it is asked, in world coordinates."""
    asked = {}
    for name, make in MODELS.items():
        data, fold = loaded(make(folder / f"{name}.npz"))
        more = (*RENDERED, "model.field.count=40") if name == "gsparc" else ()
        config = compose(f"model={name.removesuffix('_power')}", *more)
        method = build(config.model).made_for(data)
        method.fit(data, fold, short(folder / name, 10))
        settings = OmegaConf.to_container(config.model, resolve=True)
        checkpoint.save(folder / f"{name}.ckpt", method, OmegaConf.to_yaml({"model": settings}))
        asked[name] = data.moving[:12] + data.site.origin
    return asked


def ask(predictor: gsparc.Predictor, places: np.ndarray) -> np.ndarray:
    return getattr(predictor, predictor.site.kind)(**{predictor.site.moving_end: places})


class Worker(threading.Thread):
    """Draws what to do until told to stop; keeps the first exception."""

    def __init__(self, number: int, shared: dict, expected: dict, folder: Path, stop: threading.Event):
        super().__init__(daemon=True)
        self.draw, self.shared, self.expected = random.Random(number), shared, expected
        self.folder, self.stop, self.done, self.error = folder, stop, 0, None

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
        self.check(name, gsparc.load(self.folder / f"{name}.ckpt"))

    def reject(self) -> None:
        with pytest.raises(CheckpointError):
            gsparc.load(self.folder / "damaged.ckpt")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_loads_and_queries_from_threads_leave_answers_and_memory_alone(tmp_path, request):
    minutes = request.config.getoption("--soak-minutes", None) or 25 / 60
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    asked = trained(tmp_path)
    shared = {name: gsparc.load(tmp_path / f"{name}.ckpt") for name in asked}
    expected = {name: (places, ask(shared[name], places)) for name, places in asked.items()}
    sound = (tmp_path / "gp.ckpt").read_bytes()
    (tmp_path / "damaged.ckpt").write_bytes(sound[: len(sound) // 2])
    stop, end = threading.Event(), time.monotonic() + 60 * minutes
    workers = [Worker(number, shared, expected, tmp_path, stop) for number in range(THREADS)]
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
