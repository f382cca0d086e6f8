"""Plugins as choices of `model=` and `dataset=`,
scenes that come with Sionna as choices of `scene=`.
"""

from __future__ import annotations

import logging
from importlib import resources
from typing import Any

from hydra.core.config_store import ConfigStore

from gsparc.base.errors import DataError
from gsparc.base.instantiate import GROUPS, import_target, plugin_node, plugins
from gsparc.simulate.scenes.shipped import list_shipped_scenes, shipped_scene_settings

log = logging.getLogger(__name__)


def offer_plugins() -> None:
    """Make every plugin a choice of its config group, with its settings and their defaults.

    One that cannot be imported is warned of and left out.
    """
    for group in GROUPS:
        for name, path in plugins(group).items():
            try:
                defaults = plugin_node(group, name)
            except DataError as error:
                log.warning("plugin %s (%s) is left out: %s", name, path, error)
                continue
            if hasattr(import_target(path), "plain_place"):
                log.warning(
                    "plugin %s: no baseline; plain_place is called baseline_order now", name
                )
            shared: dict[str, Any] = {"name": name, "batch_size": 16} if group == "dataset" else {}
            if group == "model" and "seed" in defaults:
                # What a plugin draws follows the seed of the run.
                shared["seed"] = "${seed}"
            node = {**defaults, **shared}
            ConfigStore.instance().store(name=name, group=group, node=node, provider="plugin")


def offer_scenes() -> None:
    """Make every scene that comes with Sionna a choice of `scene=`, and `scene=help`,
    which lists them.
    """
    written = resources.files("gsparc.conf") / "scene"
    # Scenes that have a file of ours keep its settings.
    bare = [name for name in list_shipped_scenes() if not (written / f"{name}.yaml").is_file()]
    nodes = {name: shipped_scene_settings(name) for name in bare}
    for name, node in {**nodes, "help": {"name": "help"}}.items():
        ConfigStore.instance().store(name=name, group="scene", node=node, provider="sionna")
