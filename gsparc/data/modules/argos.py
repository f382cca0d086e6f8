"""The Argos release: `dataset=argos`."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsparc.data.campaigns.argos import describe_missing, load_argos
from gsparc.data.datamodule import DataModule
from gsparc.data.errors import DataError
from gsparc.data.modules.stand_in import StandIn
from gsparc.data.position_encoder.autoencoder import EncoderSettings
from gsparc.data.position_encoder.store import encoder_for
from gsparc.data.schema import Measurements

log = logging.getLogger(__name__)


class Argos(DataModule):
    """The Argos release or any folder in its layout; see `load_argos`.

    Args:
        root: the folder; absent: the stand-in.
        antenna: number of the antenna to predict, or `all`.
        positions: `encoder`, or `true` (stand-in only).
        align: turn snapshots by the phase and mean delay of their own uplink.
        encoder: `file` or `folder`, and `EncoderSettings`.
        stand_in: used, loudly, when no root is given.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        root: str | Path | None = None,
        antenna: int | str = 0,
        positions: str | bool = "encoder",
        align: bool = True,
        encoder: Mapping[str, Any] | None = None,
        stand_in: StandIn | None = None,
        name: str = "argos",
        batch_size: int = 16,
    ) -> None:
        super().__init__(name, batch_size)
        self.root = None if root is None else Path(root)
        self.antenna, self.align = antenna, bool(align)
        self.positions = str(positions).lower()  # `true` in YAML is no text
        given = dict(encoder or {})
        file, room = given.pop("file", None), Path(given.pop("folder", "outputs/encoders"))
        self.encoder = (room, EncoderSettings(**given), file)
        self.stand_in = stand_in

    def load(self) -> Measurements:
        """Downlink channels (S, A, 26) complex64 with the uplink of the same snapshots."""
        if self.root is not None and self.root.exists():
            return self._folder(self.root)
        missing = describe_missing(self.root)
        if self.root is not None or self.stand_in is None:
            raise DataError(missing)
        log.warning("%s Using the SIMULATED stand-in argos-sim instead.", missing)
        return self._simulated(self.stand_in)

    def _simulated(self, stand_in: StandIn) -> Measurements:
        folder = stand_in.folder()
        log.warning("argos-sim: SIMULATED data in the layout of the Argos release, at %s", folder)
        return self._folder(folder)

    def _folder(self, folder: Path) -> Measurements:
        return load_argos(
            folder,
            encoder_for(*self.encoder),
            antenna=self.antenna,
            positions=self.positions,
            align=self.align,
        )


class ArgosSim(Argos):
    """The simulated stand-in in the Argos layout: `dataset=argos_sim`.

    Args:
        stand_in: what simulates it.
        antenna, positions, align, encoder: see `Argos`.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        stand_in: StandIn,
        antenna: int | str = 0,
        positions: str | bool = "encoder",
        align: bool = True,
        encoder: Mapping[str, Any] | None = None,
        name: str = "argos_sim",
        batch_size: int = 16,
    ) -> None:
        super().__init__(None, antenna, positions, align, encoder, stand_in, name, batch_size)

    def load(self) -> Measurements:
        """As `Argos.load`."""
        assert self.stand_in is not None
        return self._simulated(self.stand_in)
