"""Measurements of one's own: `dataset=own`."""

from __future__ import annotations

import logging
from pathlib import Path

from gsparc.data.datamodule import DataModule
from gsparc.data.describe import suspicious_values
from gsparc.data.own import load_own
from gsparc.data.schema import Measurements

log = logging.getLogger(__name__)


class Own(DataModule):
    """A file of the schema in docs/own-data.md; doubtful units are warned of.

    Args:
        file: *.npz, *.h5 or *.hdf5.
        name, batch_size: see `DataModule`.
    """

    def __init__(self, file: str | Path, name: str = "own", batch_size: int = 16) -> None:
        super().__init__(name, batch_size)
        self.file = Path(file)

    def load(self) -> Measurements:
        """Spectra, channels or powers, as the file says."""
        data = load_own(self.file)
        for doubt in suspicious_values(data):
            log.warning("%s: units? %s", self.file, doubt)
        return data
