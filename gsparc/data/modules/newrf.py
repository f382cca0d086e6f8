"""Rooms in the layout of NeWRF: `dataset=newrf`."""

from __future__ import annotations

from pathlib import Path

from gsparc.data.campaigns.newrf import load_newrf
from gsparc.data.datamodule import DataModule
from gsparc.data.schema import Measurements


class NeWRF(DataModule):
    """One transmitter, many receivers, complex channels.

    Args:
        file: *.npz.
        name, batch_size: see `DataModule`.
    """

    def __init__(self, file: str | Path, name: str = "newrf", batch_size: int = 16) -> None:
        super().__init__(name, batch_size)
        self.file = Path(file)

    def load(self) -> Measurements:
        """Channels (S, 1, K) complex64."""
        return load_newrf(self.file)
