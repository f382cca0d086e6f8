"""A walking transmitter on a campus: `dataset=powder`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsparc.data.campaigns.powder import STATION_M, WALKER_M, raw_of_powder
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw


class Powder(Campaign):
    """Powers of a walking transmitter at fixed stations; see `raw_of_powder`.

    Args:
        file: *.npz, or the release's *.csv.
        station_table: coordinates of the stations of a CSV; None: `location_coordinates.json` beside it.
        tx_height, station_height: above ground [m].
        stations, runs, min_rssi_db, max_rows, level_steps: see `Campaign`.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        file: str | Path,
        station_table: str | Path | None = None,
        tx_height: float = WALKER_M,
        station_height: float = STATION_M,
        stations: Sequence[str | int] | None = None,
        runs: Sequence[str | int] | None = None,
        min_rssi_db: float | None = None,
        max_rows: int | None = None,
        level_steps: Mapping[str, Sequence[int]] | None = None,
        name: str = "powder",
        batch_size: int = 16,
    ) -> None:
        super().__init__(file, name, batch_size, stations, runs, min_rssi_db, max_rows, level_steps)
        self.station_table, self.heights = station_table, (tx_height, station_height)

    def raw(self) -> Raw:
        """Powers (S, T) of a moving transmitter at T stations."""
        return raw_of_powder(self.file, self.station_table, *self.heights)
