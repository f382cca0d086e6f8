"""What takes the place of a release that is not on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol


class StandIn(Protocol):
    """Simulated measurements in a release's layout, handed to the release's module by the configuration."""

    def folder(self) -> Path:
        """Where they are; simulated when they are not there yet.

        Raises:
            ValueError: settings that cannot be simulated.
        """
