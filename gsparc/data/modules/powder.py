"""A walking transmitter on a campus: `dataset=powder`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsparc.data.campaigns.powder import STATION_M, WALKER_M, raw_of_powder
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw


class Powder(Campaign):
    """Powers of a walking transmitter at fixed stations; see `raw_of_powder`.

    Args:
        file: *.npz, or the release's *.csv.
        station_table: coordinates of the stations of a CSV; None: `location_coordinates.json` beside it.
        tx_height, station_height: above ground [m].
        name: of run directories.
        **rest: see `Campaign`.
    """

    def __init__(
        self,
        file: str | Path,
        station_table: str | Path | None = None,
        tx_height: float = WALKER_M,
        station_height: float = STATION_M,
        name: str = "powder",
        **rest: Any,
    ) -> None:
        super().__init__(file, name, **rest)
        self.station_table, self.heights = station_table, (tx_height, station_height)

    def raw(self) -> Raw:
        """Powers (S, T) of a moving transmitter at T stations."""
        return raw_of_powder(self.file, self.station_table, *self.heights)
