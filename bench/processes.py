"""Seconds of a training step shared by processes: `python bench/processes.py ddp [ROUNDS] [STEPS] [BATCH]`.

Spectra of 90 x 360, 1,000 Gaussians, in turns: one process of one thread, one of two, two of one thread each.
Processor seconds are of the first process's own thread: a step on idle cores but for waiting, which other
work on the machine cannot inflate.
"""

from __future__ import annotations

import json
import logging
import os
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from gsparc.data.datamodule import Loaded
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import GaussianModel, ModelSettings
from gsparc.methods.method import FitContext
from gsparc.methods.time_budget import TimeBudget
from gsparc.ops import Pose, SphereGrid
from gsparc.training.fit import DEFAULTS, run_stage
from gsparc.training.lightning_module import GaussianModule, LossSettings
from gsparc.training.optimizer import OptimizerSettings

log = logging.getLogger(__name__)

ROWS, GAUSSIANS, WARM = 128, 1000, 2
STILL = [4.0, 0.0, 0.0]


@dataclass(frozen=True)
class Work:
    """What is trained: `steps` of `batch` rows of `data`, by a field of `gaussians`."""

    data: Measurements
    steps: int
    batch: int
    gaussians: int = GAUSSIANS


@dataclass(frozen=True)
class Shared:
    """By how many processes, and threads of all of them."""

    processes: int
    threads: int

    def __str__(self) -> str:
        return f"processes {self.processes}, threads of each {self.threads // self.processes}"


TURNS = (Shared(1, 1), Shared(1, 2), Shared(2, 2))


class Stopwatch(L.Callback):
    """Writes seconds per step of the first process, after `WARM` steps."""

    def __init__(self, file: Path) -> None:
        self.file, self.began = file, (0.0, 0.0)

    def on_train_batch_end(self, trainer: L.Trainer, *unused: Any) -> None:
        """Start after the first steps, stop at the last."""
        now = (time.perf_counter(), time.thread_time())
        if trainer.global_step == WARM:
            self.began = now
        if trainer.global_step == trainer.max_steps and trainer.is_global_zero:
            taken = [(b - a) / (trainer.max_steps - WARM) for a, b in zip(self.began, now, strict=True)]
            self.file.write_text(json.dumps(taken))


def invented() -> Measurements:
    """Smooth spectra over a cube of 1 m."""
    rng = np.random.default_rng(0)
    moving, still = rng.uniform(-0.5, 0.5, (ROWS, 3)), np.tile(STILL, (ROWS, 1))
    phase = moving @ rng.normal(size=(3, 90 * 360)) * 2
    target = np.round((0.5 + 0.5 * np.sin(phase)) * 255).astype(np.uint8).reshape(ROWS, 90, 360)
    site = Site(
        name="bench", kind="spectrum", static_end="rx", grid=SphereGrid.hemisphere(90, 360), array=None,
        carrier_hz=1e9, subcarriers_hz=None, origin=np.zeros(3), box=np.array([[-0.5] * 3, [0.5] * 3]),
        sha256="bench", static_position=still[0], rx_rotation=np.eye(3),
    )  # fmt: skip
    turned = np.broadcast_to(np.eye(3), (ROWS, 3, 3))
    return Measurements(site, moving, still, turned, target)


def seconds(work: Work, shared: Shared, folder: Path) -> tuple[float, float]:
    """Wall and processor seconds of a step; the latter of the first process's first thread."""
    data, steps, batch = work.data, work.steps, work.batch
    torch.manual_seed(0)
    torch.set_num_threads(shared.threads)  # divided among processes
    emission = EmissionSettings(EncodingSettings("raw"), hidden=8, activation="linear", init_bias=0.0)
    settings = ModelSettings(
        field=FieldSettings(count=work.gaussians, placement="uniform"), emission=emission
    )
    model = GaussianModel(settings, data.site, Pose.identity(torch.tensor(STILL)))
    module = GaussianModule(model, LossSettings(), OptimizerSettings(), steps, folder)
    strategy = "ddp_fork" if shared.processes > 1 else "auto"
    trainer = partial(DEFAULTS, max_steps=steps, devices=shared.processes, strategy=strategy)
    file, shown = folder / "seconds.json", Loaded(data, batch)
    context = FitContext(
        folder, batch_size=batch, datamodule=shown, trainer=trainer, callbacks=lambda: [Stopwatch(file)]
    )
    budget = TimeBudget()
    budget.pause()
    fold = Fold(np.arange(ROWS), np.arange(0), np.arange(ROWS))
    run_stage(module, data, fold, context, TorchCheckpointIO(), budget)
    wall, processor = json.loads(file.read_text())
    return wall, processor


def main(kind: str = "ddp", *given: str) -> None:
    """Rounds in turns; medians and speed-ups over one process of one thread in the log.

    Raises:
        ValueError: another kind.
    """
    if kind != "ddp":
        raise ValueError(f"{kind}: expected ddp")
    rounds, steps, batch = [*map(int, given), *(5, 42, 64)[len(given) :]]
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    work = Work(invented(), steps, batch)
    found: dict[Shared, list[tuple[float, float]]] = {shared: [] for shared in TURNS}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds):
            for shared in TURNS:
                found[shared].append(seconds(work, shared, Path(folder)))
    for place, clock in enumerate(("wall", "processor, first thread of the first process")):
        ms = {s: 1e3 * statistics.median(pair[place] for pair in pairs) for s, pairs in found.items()}
        for shared in TURNS:
            ratio = ms[TURNS[0]] / ms[shared]
            log.info("%s: %s: %.1f ms a step, speed-up %.2f", clock, shared, ms[shared], ratio)
    load = os.getloadavg()[0]
    log.info("batches of %d, load %.1f on %d cores, %d rounds", batch, load, os.cpu_count(), rounds)


if __name__ == "__main__":
    main(*sys.argv[1:])
