"""What modules of measured campaigns share: a file becomes arrays, a part of them, measurements."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsparc.data.checks.describe import suspicious_values
from gsparc.data.datamodule import DataModule
from gsparc.data.links.station_parts import rows_by_station, split_stations
from gsparc.data.own import interpret
from gsparc.data.raw import Raw
from gsparc.data.schema import Measurements
from gsparc.data.selection import Selection, select

log = logging.getLogger(__name__)


class Campaign(DataModule):
    """A published campaign with stations, of which all rows or a part are used.

    Args:
        file: what `raw` reads.
        name, batch_size: see `DataModule`.
        stations, runs, min_rssi_db, max_rows: see `gsparc.data.selection.Selection`.
        level_steps: by station, rows from which it counts as another; see `gsparc.data.links.station_parts`.
    """

    def __init__(
        self,
        file: str | Path,
        name: str,
        batch_size: int = 16,
        stations: Sequence[str | int] | None = None,
        runs: Sequence[str | int] | None = None,
        min_rssi_db: float | None = None,
        max_rows: int | None = None,
        level_steps: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        super().__init__(name, batch_size)
        self.file = Path(file)
        self.selection = Selection(stations, runs, min_rssi_db, max_rows)
        self.level_steps = rows_by_station(level_steps or {})

    @abstractmethod
    def raw(self) -> Raw:
        """The file's arrays, named as in docs/own-data.md.

        Raises:
            DataError: bad input.
        """

    def load(self) -> Measurements:
        """Read, select and interpret; what is left out and what looks wrong is logged."""
        raw = self.raw()
        selected = select(split_stations(raw, self.level_steps, self.file), self.selection, self.file)
        reading = interpret(selected.raw, self.file)
        said = [str(raw.attributes["left_out"])] if "left_out" in raw.attributes else []
        for note in (*said, *selected.notes, *reading.notes):
            log.warning("%s: %s", self.file, note)
        for hint in suspicious_values(reading.data):
            log.warning("%s: units? %s", self.file, hint)
        return reading.data
