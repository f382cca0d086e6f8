"""From a configuration to what a fit is given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf

from gsparc.data.datamodule import DataModule
from gsparc.methods.method import FitContext


def context_of(
    config: DictConfig,
    run_dir: Path,
    datamodule: DataModule | None = None,
    loggers: Sequence[Logger] = (),
    resume: Path | None = None,
) -> FitContext:
    """The context of one fold, from `trainer`, `callbacks`, `seed`, `budget_s`, `dataset.batch_size`."""
    nodes = [node for node in (config.get("callbacks") or {}).values() if node is not None]
    init_from = config.get("init_from")
    return FitContext(
        run_dir=run_dir,
        seed=int(config.seed),
        budget_s=config.budget_s,
        resume=resume,
        init_from=None if init_from is None else Path(init_from),
        batch_size=config.dataset.get("batch_size", 16),
        datamodule=datamodule,
        trainer=instantiate(config.trainer, _partial_=True),
        callbacks=lambda: [instantiate(node) for node in nodes],
        loggers=loggers,
        config_yaml=OmegaConf.to_yaml(config, resolve=True),
    )
