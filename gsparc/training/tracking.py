"""Dashboards: Weights & Biases, which stays offline unless its user has logged in,
and TensorBoard.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning.pytorch.loggers import CSVLogger, Logger
from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:
    import lightning.pytorch as L
    from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger

TAGS = ("dataset", "split", "model", "paper", "experiment")  # groups whose choices are tags
NAME = 120  # characters


class PartLogger(Logger):
    """The dashboard of a run for a part of it, a refit or a fold: figures under its name,
    a series each.
    """

    def __init__(self, whole: Logger, part: str) -> None:
        super().__init__()
        self.whole, self.part = whole, part

    name = property(lambda self: self.whole.name)
    version = property(lambda self: self.whole.version)

    def log_hyperparams(self, *params: Any, **kwargs: Any) -> None:
        """Log nothing: the run's are said once."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log figures under the part's name."""
        self.whole.log_metrics(
            {f"{self.part}/{name}": value for name, value in metrics.items()}, step
        )

    def log_image(self, name: str, files: Sequence[str], step: int | None = None) -> None:
        """Show a picture under the part's name, where the dashboard shows any."""
        log_picture([self.whole], f"{self.part}/{name}", Path(files[0]), step)

    def save(self) -> None:
        """Write what was logged."""
        self.whole.save()


def refuse_missing_loggers(config: DictConfig) -> None:
    """Refuse a dashboard whose package is missing, before hours of reading and training.

    Raises:
        ValueError: TensorBoard is not installed.
    """
    if "tensorboard" in (config.get("logger") or {}) and not find_spec("tensorboard"):
        raise ValueError(
            "logger=tensorboard: TensorBoard is not installed; say pip install "
            '"gsparc[tensorboard]"'
        )


@contextmanager
def open_loggers(config: DictConfig) -> Iterator[list[Logger]]:
    """Yield loggers of `config.logger`, told the whole resolved `config`,
    closed whatever happens.
    """
    loggers: list[Logger] = []
    settings: Any = OmegaConf.to_container(config, resolve=True)
    status = "failed"
    try:
        loggers.extend(instantiate(node) for node in (config.logger or {}).values())
        for logger in loggers:
            if not isinstance(logger, CSVLogger):
                logger.log_hyperparams(settings)
        yield loggers
        status = "success"
    finally:
        for logger in loggers:
            # Now: its folder is opened by the process that trains
            if isinstance(logger, CSVLogger):
                logger.log_hyperparams(settings)
            logger.finalize(status)
            if hasattr(logger, "experiment") and hasattr(logger.experiment, "finish"):
                logger.experiment.finish(exit_code=0 if status == "success" else 1)


def wandb_logger(offline: bool | None = None, **settings: Any) -> WandbLogger:
    """Return a logger for `logger=wandb`.

    Args:
        offline: None keeps the run on disk (`wandb sync` sends it later) unless `wandb login` was
            done; WANDB_MODE of the environment wins.
        **settings: of Lightning's `WandbLogger`; name, group and tags that are null follow from the
            job.
    """
    import wandb  # slow to import, and few runs need it
    from lightning.pytorch.loggers import WandbLogger

    mode = os.environ.get("WANDB_MODE")
    if mode is None:
        stays = not wandb.login(prompt=False) if offline is None else offline
        mode = "offline" if stays else None
    arguments = {name: value for name, value in settings.items() if value}
    # `mode` as an argument: Lightning's `offline` sets a variable that wandb, asked for a login,
    # warns of and does not read; of `anonymous` it warns whatever the value.
    logger = WandbLogger(offline=mode == "offline", **{**_job_tags(), **arguments, "mode": mode})
    logger._offline = False
    logger._wandb_init.pop("anonymous", None)
    return logger


def _job_tags() -> dict[str, Any]:
    """What runs are sorted by: choices of groups,
    and of a job its multirun and what it differs in.
    """
    if not HydraConfig.initialized():
        return {}
    hydra = HydraConfig.get()
    tags = [str(choice) for group in TAGS if (choice := hydra.runtime.choices.get(group))]
    if hydra.mode != RunMode.MULTIRUN:
        return {"name": "-".join(tags), "tags": tags}
    overrides, file = [], Path(hydra.sweep.dir) / "multirun.yaml"
    if file.exists():  # of Hydra's own sweeper
        overrides = yaml.safe_load(file.read_text(encoding="utf-8"))["hydra"]["overrides"]["task"]
    parsed = OverridesParser.create().parse_overrides(overrides)
    varies = {override.key_or_group: override.is_sweep_override() for override in parsed}
    changes = " ".join(
        o for o in hydra.overrides.task if varies.get(o.lstrip("+~").partition("=")[0], True)
    )
    return {
        "name": f"{hydra.job.num} {changes}"[:NAME],
        "group": Path(hydra.sweep.dir).name,
        "tags": tags,
    }


def tensorboard_logger(save_dir: str, name: str = "tensorboard") -> TensorBoardLogger:
    """Return a logger for `logger=tensorboard`; event files go to `save_dir/name`."""
    from lightning.pytorch.loggers import TensorBoardLogger

    return TensorBoardLogger(save_dir, name=name, version="", default_hp_metric=False)


def log_final(loggers: Iterable[Any], figures: Mapping[str, float]) -> None:
    """Give the dashboards the figures of the whole run."""
    for logger in loggers:
        # TensorBoard sorts runs by settings and figures that come together
        if hasattr(logger, "hparams"):
            logger.log_hyperparams(logger.hparams, dict(figures))
        else:
            logger.log_metrics(dict(figures))


def log_picture(loggers: Iterable[Any], name: str, path: Path, step: int | None = None) -> None:
    """Give a PNG file to the dashboards that show pictures."""
    for logger in loggers:
        if hasattr(logger, "log_image"):  # Weights & Biases
            logger.log_image(name, [str(path)], step=step)
        elif hasattr(getattr(logger, "experiment", None), "add_image"):  # TensorBoard
            from PIL import Image

            with Image.open(path) as image:
                logger.experiment.add_image(
                    name, np.asarray(image.convert("RGB")), step, dataformats="HWC"
                )


def log_table(
    loggers: Iterable[Any], name: str, heads: Sequence[str], rows: Sequence[Sequence[str]]
) -> None:
    """Give a table to the dashboards that show tables."""
    for logger in loggers:
        if hasattr(logger, "log_table"):
            logger.log_table(name, list(heads), [list(row) for row in rows])
        elif hasattr(getattr(logger, "experiment", None), "add_text"):
            lines = [heads, ["---"] * len(heads), *rows]
            logger.experiment.add_text(name, "\n".join(f"| {' | '.join(line)} |" for line in lines))


def log_event(trainer: L.Trainer, module: L.LightningModule, figures: Mapping[str, float]) -> None:
    """Give the loggers the figures of an event, at the number of steps taken,
    not the schedule's.
    """
    for logger in trainer.loggers:
        logger.log_metrics(dict(figures), step=module.global_step)
