"""Variants of one model, and rivals: what a command compares under the same data, split and clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gsparc.data.load import load, split_for
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.methods.method import FitContext, Method
from gsparc.methods.registry import build, method_class
from gsparc.studies import limits
from gsparc.studies.context import context_of


@dataclass(frozen=True)
class Setting:
    """What a comparison runs on.

    Attributes:
        data: all measurements.
        fold: the first of the split.
        run_dir: where everything goes.
        makers: unfitted methods by the name they get in the table.
        context: of every fit, but for its folder.
    """

    data: Measurements
    fold: Fold
    run_dir: Path
    makers: dict[str, Callable[[], Method]]
    context: FitContext


def setting(config: DictConfig) -> Setting:
    """From `dataset`, `split`, `model`, `trainer`, `seed`, `threads`, `variants` and `rivals`.

    `variants` maps names to overrides of the model; `rivals` lists methods by name.
    """
    limits.check(OmegaConf.to_container(config, resolve=True))  # type: ignore[arg-type]
    if config.threads is not None:
        torch.set_num_threads(int(config.threads))
    data = load(OmegaConf.to_container(config.dataset, resolve=True))  # type: ignore[arg-type]
    fold = split_for(OmegaConf.to_container(config.split, resolve=True), data).folds[0]  # type: ignore[arg-type]

    def maker(overrides: Any) -> Callable[[], Method]:
        def make() -> Method:
            return build(OmegaConf.merge(config.model, overrides))  # type: ignore[arg-type]

        return make

    makers: dict[str, Callable[[], Method]] = {str(k): maker(v) for k, v in config.variants.items()}
    makers |= {name: method_class(name) for name in config.rivals}
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    return Setting(data, fold, run_dir, makers, context_of(config, run_dir))
