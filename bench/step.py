"""Cost of a training step beside the rasterizer: Lightning's loop, its logging, Adam, SSIM.

    python bench/step.py dataset=rfid dataset.root=FOLDER [overrides of train.py]

Steps of the configured model in turns: bare (a loop of a few lines around the same module), under Lightning
with figures logged every tenth step, and every step; the bare loop with Adam's three forms, and without SSIM.
Medians of the steps of each turn, then of the turns, in milliseconds of process time, which excludes
other processes.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from functools import partial
from itertools import pairwise
from pathlib import Path

import lightning.pytorch as L
import torch
from hydra import compose, initialize_config_module

from gsparc.data.load import load, split_for
from gsparc.data.splits import Fold
from gsparc.methods.method import FitContext
from gsparc.methods.registry import build
from gsparc.training import fit
from gsparc.training.lightning_module import GaussianModule

STEPS, TURNS = 40, 4


class StepTimer(L.Callback):
    """Records when each step ends, and the module."""

    def __init__(self) -> None:
        self.ends: list[float] = []
        self.module: GaussianModule | None = None

    def on_train_batch_end(self, trainer, module, *unused):
        """Record the time."""
        self.ends.append(time.process_time())
        self.module = module


def median_step(ends: list[float]) -> float:
    """Milliseconds between neighbouring ends."""
    return 1e3 * statistics.median(after - before for before, after in pairwise(ends))


class Steps:
    """Steps of one configuration, under Lightning or bare."""

    def __init__(self, overrides: list[str]) -> None:
        with initialize_config_module("gsparc.conf", version_base="1.3"):
            config = compose("train", overrides=["model.refit=false", *overrides])
        torch.set_num_threads(config.threads or 1)
        self.config, self.data = config, load(config.dataset)
        fold = split_for(config.split, self.data).folds[0]
        self.fold = Fold(fold.train, fold.val[:0], fold.test)  # a validation is no step
        self.module = self.under_lightning(10)[1]

    def under_lightning(self, log_every: int) -> tuple[float, GaussianModule]:
        """Milliseconds of a step, and the module."""
        method, timer = build(self.config.model), StepTimer()
        fit.LOG_EVERY = log_every
        trainer = partial(fit.DEFAULTS, max_steps=STEPS, val_check_interval=STEPS)
        with tempfile.TemporaryDirectory() as folder:
            context = FitContext(Path(folder), trainer=trainer, callbacks=lambda: [timer])
            method.fit(self.data, self.fold, context)
        assert timer.module is not None
        return median_step(timer.ends), timer.module

    def bare(self, ssim: bool = True, **form: bool) -> float:
        """Milliseconds of a step of a loop that does nothing else, with a form of Adam."""
        module, ends = self.module, []
        batch = self.data.batch(self.fold.train[: self.config.dataset.batch_size])
        module.log = lambda *a, **k: None
        module.loss = type(module.loss)(0.2 if ssim else 0.0)
        groups = [{"params": [p]} for p in module.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(groups, lr=0, **form)
        for _ in range(STEPS):
            optimizer.zero_grad(set_to_none=True)
            module.training_step(batch, 0).backward()
            optimizer.step()
            ends.append(time.process_time())
        return median_step(ends)


def main() -> None:
    """Print the table."""
    steps = Steps(sys.argv[1:])
    contenders = {
        "bare": lambda: steps.bare(fused=True),
        "bare, foreach Adam": lambda: steps.bare(foreach=True),
        "bare, looped Adam": lambda: steps.bare(foreach=False),
        "bare, L1 alone": lambda: steps.bare(ssim=False, fused=True),
        "Lightning, logging every 10th step": lambda: steps.under_lightning(10)[0],
        "Lightning, logging every step": lambda: steps.under_lightning(1)[0],
    }
    times = [[call() for call in contenders.values()] for _ in range(TURNS)]
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    medians = map(statistics.median, zip(*times, strict=True))
    rows = [f"{name:36s} {found:7.2f} ms" for name, found in zip(contenders, medians, strict=True)]
    title = f"{torch.get_num_threads()} threads, load {load:.1f} per core"
    sys.stdout.write("\n".join([title, *rows, ""]))


if __name__ == "__main__":
    main()
