"""A Bluetooth beacon in a hall: `dataset=ble`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsparc.data.campaigns.ble import raw_of_ble
from gsparc.data.modules.campaign import Campaign
from gsparc.data.raw import Raw


class BLE(Campaign):
    """Powers of a beacon at many places, at the sensors of a hall; see `raw_of_ble`.

    Args:
        file: *.npz.
        name: of run directories.
        **rest: see `Campaign`.
    """

    def __init__(self, file: str | Path, name: str = "ble", **rest: Any) -> None:
        super().__init__(file, name, **rest)

    def raw(self) -> Raw:
        """Powers (S, T) of a moving transmitter at T stations."""
        return raw_of_ble(self.file)
