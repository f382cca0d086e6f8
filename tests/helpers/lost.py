"""Ends of a training at a step: a job killed once among many, an interrupt;
named in a configuration.
"""

import os
import signal
from pathlib import Path
from typing import Any

import lightning.pytorch as L


class KillOnce(L.Callback):
    """Writes down every step that begins; the first process to begin a certain one is killed there.

    Args:
        step: that one.
        folder: where all jobs write.
    """

    def __init__(self, step: int, folder: str) -> None:
        self.step, self.folder = step, Path(folder)

    def on_train_batch_start(self, trainer: L.Trainer, *unused: Any) -> None:
        with (self.folder / "steps").open("a") as file:
            file.write(f"{trainer.global_step} {trainer.default_root_dir}\n")
        if trainer.global_step == self.step:
            try:
                os.close(os.open(self.folder / "killed", os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return
            os.kill(os.getpid(), signal.SIGKILL)


class Interrupt(L.Callback):
    """Ctrl-C at a step."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_start(self, trainer: L.Trainer, *unused: Any) -> None:
        if trainer.global_step == self.step:
            signal.raise_signal(signal.SIGINT)
