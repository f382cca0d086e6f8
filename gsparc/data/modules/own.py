"""Measurements of one's own: `dataset=own`."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from gsparc.data.datamodule import DataModule
from gsparc.data.describe import suspicious_values
from gsparc.data.own import interpret, load_own
from gsparc.data.schema import Measurements
from gsparc.data.tables import is_table

log = logging.getLogger(__name__)


class Own(DataModule):
    """A file of the schema in docs/own-data.md; doubtful units are warned of.

    Args:
        file: *.npz, *.h5 or *.hdf5, or a table: *.csv, *.tsv, *.txt or *.parquet.
        columns: of a table, by quantity, where the guess from their heads will not do.
        stations_file: of a table, a second one that lists the stations.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        file: str | Path,
        name: str = "own",
        batch_size: int = 16,
        columns: Mapping[str, object] | None = None,
        stations_file: str | Path | None = None,
    ) -> None:
        super().__init__(name, batch_size)
        self.file = Path(file)
        self.columns, self.stations_file = columns or {}, stations_file

    def load(self) -> Measurements:
        """Spectra, channels or powers, as the file says."""
        if is_table(self.file):
            from gsparc.data.tables.read import read_table  # here, as pandas takes half a second to import

            data = interpret(read_table(self.file, self.columns, self.stations_file), self.file).data
        else:
            data = load_own(self.file)
        for doubt in suspicious_values(data):
            log.warning("%s: units? %s", self.file, doubt)
        return data
