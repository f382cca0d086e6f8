"""From a configuration to what a fit is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from lightning import Callback, Trainer
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.settings import plain
from gsparc.data.load import split_settings
from gsparc.training.context import FitContext


def context_of(
    config: DictConfig,
    trainer: partial[Trainer] | None = None,
    callbacks: Callable[[], Sequence[Callback]] | None = None,
    **others: Any,
) -> FitContext:
    """The context of a fit: seed, budget, split, `init_from`, `dataset.batch_size`, and what is given.

    Args:
        config: a composed configuration.
        trainer: makes a Trainer from further options, once per fold; None: as `config` says.
        callbacks: makes them anew, once per Trainer; None: as `config` says.
        **others: of `FitContext`: `run_dir`, `datamodule`, `loggers`, `resume`.
    """
    init_from, split = config.get("init_from"), config.get("split")
    return FitContext(
        seed=int(config.seed),
        budget_s=config.budget_s,
        budget_clock=config.get("budget_clock", "wall"),
        stations=config.get("stations", "auto"),
        split=None if split is None else split_settings(plain(split)),
        init_from=None if init_from is None else Path(init_from),
        batch_size=config.dataset.get("batch_size", 16),
        trainer=trainer or instantiate(config.trainer, _partial_=True),
        callbacks=callbacks or partial(callbacks_of, config.get("callbacks")),
        config_yaml=OmegaConf.to_yaml(config, resolve=True),
        **others,
    )


def callbacks_of(nodes: Mapping[str, Any] | None) -> list[Callback]:
    """Every callback of the group `callbacks` that was not set to null."""
    return [instantiate(node) for node in (nodes or {}).values() if node is not None]
