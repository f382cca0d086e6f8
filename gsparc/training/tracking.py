"""Dashboards: Weights & Biases, which stays offline unless its user has logged in, and TensorBoard."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from hydra.utils import instantiate

if TYPE_CHECKING:
    import lightning.pytorch as L
    from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger


@contextmanager
def opened(nodes: Mapping[str, Any] | None) -> Iterator[list[Logger]]:
    """Loggers of a config of the group `logger`, closed whatever happens."""
    made: list[Logger] = []
    status = "failed"
    try:
        made.extend(instantiate(node) for node in (nodes or {}).values())
        yield made
        status = "success"
    finally:
        for logger in made:
            logger.finalize(status)
            if hasattr(logger, "experiment") and hasattr(logger.experiment, "finish"):
                logger.experiment.finish(exit_code=0 if status == "success" else 1)


def wandb_logger(offline: bool | None = None, **settings: Any) -> WandbLogger:
    """A logger for `logger=wandb`.

    Args:
        offline: None keeps the run on disk (`wandb sync` sends it later) unless `wandb login` was done.
        **settings: of Lightning's `WandbLogger`.
    """
    import wandb  # slow to import, and few runs need it
    from lightning.pytorch.loggers import WandbLogger

    stays = not wandb.login(prompt=False) if offline is None else offline
    # Lightning sets a variable that wandb, once asked for a login, does not read again.
    mode: dict[str, Any] = {"mode": "offline"} if stays else {}
    return WandbLogger(offline=stays, **mode, **settings)


def tensorboard_logger(save_dir: str, name: str = "tensorboard") -> TensorBoardLogger:
    """A logger for `logger=tensorboard`; event files go to `save_dir/name`.

    Raises:
        ValueError: TensorBoard is not installed.
    """
    from lightning.pytorch.loggers import TensorBoardLogger

    try:
        return TensorBoardLogger(save_dir, name=name, version="")
    except ModuleNotFoundError:
        raise ValueError(
            'logger=tensorboard: TensorBoard is not installed; say pip install "gsparc[tensorboard]"'
        ) from None


def picture(loggers: Iterable[Any], name: str, path: Path, step: int) -> None:
    """Give a PNG file to the dashboards that show pictures."""
    for logger in loggers:
        if hasattr(logger, "log_image"):  # Weights & Biases
            logger.log_image(name, [str(path)], step=step)
        elif hasattr(getattr(logger, "experiment", None), "add_image"):  # TensorBoard
            from PIL import Image

            with Image.open(path) as image:
                logger.experiment.add_image(name, np.asarray(image.convert("RGB")), step, dataformats="HWC")


def table(loggers: Iterable[Any], name: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Give a table to the dashboards that show tables."""
    for logger in loggers:
        if hasattr(logger, "log_table"):
            logger.log_table(name, list(heads), [list(row) for row in rows])
        elif hasattr(getattr(logger, "experiment", None), "add_text"):
            lines = [heads, ["---"] * len(heads), *rows]
            logger.experiment.add_text(name, "\n".join(f"| {' | '.join(line)} |" for line in lines))


def log_event(trainer: L.Trainer, module: L.LightningModule, figures: Mapping[str, float]) -> None:
    """Give the loggers the figures of an event, at the number of steps taken, not the schedule's."""
    for logger in trainer.loggers:
        logger.log_metrics(dict(figures), step=module.global_step)
