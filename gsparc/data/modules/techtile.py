"""A transmitter on a robot under a ceiling of antennas: `dataset=techtile`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsparc.data.campaigns.techtile import raw_of_techtile
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw


class Techtile(Campaign):
    """Channels of a moving transmitter at 42 ceiling antennas; see `raw_of_techtile`.

    Args:
        file: *.npz, or the release's *.nc.
        antennas: places of the antennas of a NetCDF file; None: `techtile_antenna_locations.yml` beside it.
        stations, runs, min_rssi_db, max_rows, level_steps: see `Campaign`.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        file: str | Path,
        antennas: str | Path | None = None,
        stations: Sequence[str | int] | None = None,
        runs: Sequence[str | int] | None = None,
        min_rssi_db: float | None = None,
        max_rows: int | None = None,
        level_steps: Mapping[str, Sequence[int]] | None = None,
        name: str = "techtile",
        batch_size: int = 16,
    ) -> None:
        super().__init__(file, name, batch_size, stations, runs, min_rssi_db, max_rows, level_steps)
        self.antennas = antennas

    def raw(self) -> Raw:
        """Channels (S, T) of a moving transmitter at T stations."""
        return raw_of_techtile(self.file, self.antennas)
