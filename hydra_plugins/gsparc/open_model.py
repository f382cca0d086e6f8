"""Lets a configuration name settings of a model that its file in `conf/model` leaves to its class."""

from __future__ import annotations

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

# What is no setting is refused where the method is built: `gsparc.models.registry.fill_defaults`.
OPEN = {"model": OmegaConf.create({}, flags={"struct": False})}
ConfigStore.instance().store("model", OPEN, "command", "_global_", "gsparc")
