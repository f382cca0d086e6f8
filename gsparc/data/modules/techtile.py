"""A transmitter on a robot under a ceiling of antennas: `dataset=techtile`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsparc.data.campaigns.techtile import raw_of_techtile
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw


class Techtile(Campaign):
    """Channels of a moving transmitter at 42 ceiling antennas; see `raw_of_techtile`.

    Args:
        file: *.npz, or the release's *.nc.
        antennas: places of the antennas of a NetCDF file; None: `techtile_antenna_locations.yml` beside it.
        name: of run directories.
        **rest: see `Campaign`.
    """

    def __init__(
        self, file: str | Path, antennas: str | Path | None = None, name: str = "techtile", **rest: Any
    ) -> None:
        super().__init__(file, name, **rest)
        self.antennas = antennas

    def raw(self) -> Raw:
        """Channels (S, T) of a moving transmitter at T stations."""
        return raw_of_techtile(self.file, self.antennas)
