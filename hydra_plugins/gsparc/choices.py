"""Methods as choices of `model=`, wherever gsparc's configuration is composed."""

from __future__ import annotations

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin


class MethodChoices(SearchPathPlugin):
    """Hydra asks it before it composes; other programs' configurations are left alone."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Offer every method, see `gsparc.models.registry.offer`."""
        if any(element.path == "pkg://gsparc.conf" for element in search_path.get_path()):
            from gsparc.models.registry import offer

            offer()
