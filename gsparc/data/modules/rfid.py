"""The RFID release: `dataset=rfid`."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsparc.data.campaigns.rfid import WAVELENGTH, describe_missing, load_rfid, planar_array
from gsparc.data.datamodule import DataModule
from gsparc.data.errors import DataError
from gsparc.data.modules.stand_in import StandIn
from gsparc.data.schema import Measurements

log = logging.getLogger(__name__)


class RFID(DataModule):
    """The RFID release (NeRF2, set s23) or any folder in its layout.

    Args:
        root: the folder; absent: the stand-in.
        gateway: which receiver of gateway_info.yml; None takes the first.
        wavelength_m: carrier wavelength [m].
        array: rows, columns and spacing_m of the receiver's array, see `planar_array`; None: the release's.
        normalisation: how the published images were scaled.
        stand_in: used, loudly, when no root is given.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        root: str | Path | None = None,
        gateway: str | None = None,
        wavelength_m: float = WAVELENGTH,
        array: Mapping[str, Any] | None = None,
        normalisation: str = "max",
        stand_in: StandIn | None = None,
        name: str = "rfid",
        batch_size: int = 16,
    ) -> None:
        super().__init__(name, batch_size)
        self.root = None if root is None else Path(root)
        self.gateway, self.wavelength_m, self.normalisation = gateway, float(wavelength_m), str(normalisation)
        self.array = planar_array(**array) if array else None
        self.stand_in = stand_in

    def load(self) -> Measurements:
        """Spectra (S, 90, 360) uint8 of tags that move about a static gateway."""
        if self.root is None or not self.root.exists():
            missing = describe_missing(self.root)
            if self.root is not None or self.stand_in is None:
                raise DataError(missing)
            log.warning("%s Using the SIMULATED stand-in rfid-sim instead.", missing)
            return simulated(self.stand_in)
        return load_rfid(
            self.root,
            gateway=self.gateway,
            wavelength_m=self.wavelength_m,
            array=self.array,
            normalisation=self.normalisation,
        )


def simulated(stand_in: StandIn) -> Measurements:
    """The stand-in's spectra."""
    folder = stand_in.folder()
    log.warning("rfid-sim: SIMULATED data in the layout of the RFID release, at %s", folder)
    return load_rfid(folder)
