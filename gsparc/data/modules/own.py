"""Measurements of one's own: `dataset=own`."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsparc.data.campaigns.recognise import campaign_of
from gsparc.data.checks.describe import raw_of
from gsparc.data.errors import DataError
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw

log = logging.getLogger(__name__)


class Own(Campaign):
    """A file of the schema in docs/own-data.md, or a table; suspicious units are warned of.

    Args:
        file: *.npz, *.h5 or *.hdf5, or a table: *.csv, *.tsv, *.txt or *.parquet.
        name: of run directories.
        columns: of a table, by quantity, where the guess from their heads will not do.
        stations_file: of a table, a second one that lists the stations.
        **rest: see `Campaign`.
    """

    def __init__(
        self,
        file: str | Path,
        name: str = "own",
        columns: Mapping[str, object] | None = None,
        stations_file: str | Path | None = None,
        **rest: Any,
    ) -> None:
        super().__init__(file, name, **rest)
        self.columns, self.stations_file = columns or {}, stations_file

    def raw(self) -> Raw:
        """The file's arrays, or the table's under the schema's names."""
        raw, notes = raw_of(self.file, self.columns, self.stations_file)
        campaign = campaign_of(raw)
        if campaign is not None:
            raise DataError(f"{self.file}: this is a file of dataset={campaign}; say dataset={campaign}")
        for note in notes:
            log.info("%s: %s", self.file, note)
        return raw
