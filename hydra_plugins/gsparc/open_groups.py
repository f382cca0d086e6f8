"""Lets a configuration name settings of a model or of data that its file leaves to their class."""

from __future__ import annotations

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

# What is no setting is refused where the class is known: `registry.fill_defaults`,
# `load.datamodule`.
for group, known in {"model": (), "dataset": ("name", "root", "file")}.items():
    node = {group: OmegaConf.create(dict.fromkeys(known), flags={"struct": False})}
    ConfigStore.instance().store(group, node, "command", "_global_", "gsparc")
