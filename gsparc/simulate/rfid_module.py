"""The simulated stand-in in the RFID release's layout as a dataset of its own: `dataset=rfid_sim`."""

from __future__ import annotations

from pathlib import Path

from gsparc.data.datamodule import DataModule
from gsparc.data.datasets.campaign import simulated
from gsparc.data.datasets.rfid import load_rfid
from gsparc.data.schema import Measurements
from gsparc.simulate.rfid_sim import RFIDStandIn


class RFIDSim(DataModule):
    """See `RFIDStandIn`.

    Args:
        count, seed, root: of the stand-in.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        count: int = 640,
        seed: int = 0,
        root: str | Path = "outputs/stand-ins",
        name: str = "rfid_sim",
        batch_size: int = 16,
    ) -> None:
        super().__init__(name, batch_size)
        self.stand_in = RFIDStandIn(count, seed, root)

    def load(self) -> Measurements:
        """Simulated when it is not there yet, then read like the release."""
        return simulated(self.stand_in, "RFID", load_rfid)
