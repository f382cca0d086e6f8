"""A Bluetooth beacon in a hall: `dataset=ble`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsparc.data.campaigns.ble import raw_of_ble
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw


class BLE(Campaign):
    """Powers of a beacon at many places, at the sensors of a hall; see `raw_of_ble`.

    Args:
        file: *.npz.
        stations, runs, min_rssi_db, max_rows, level_steps: see `Campaign`.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        file: str | Path,
        stations: Sequence[str | int] | None = None,
        runs: Sequence[str | int] | None = None,
        min_rssi_db: float | None = None,
        max_rows: int | None = None,
        level_steps: Mapping[str, Sequence[int]] | None = None,
        name: str = "ble",
        batch_size: int = 16,
    ) -> None:
        super().__init__(file, name, batch_size, stations, runs, min_rssi_db, max_rows, level_steps)

    def raw(self) -> Raw:
        """Powers (S, T) of a moving transmitter at T stations."""
        return raw_of_ble(self.file)
