"""What `gsparc simulate` wrote: `dataset=sionna`."""

from __future__ import annotations

from pathlib import Path

from gsparc.data.campaigns.sionna import load_sionna
from gsparc.data.datamodule import DataModule
from gsparc.data.schema import Measurements


class Sionna(DataModule):
    """One transmitter, many receivers, read as spectra or as channels.

    Args:
        file: *.h5.
        target: `spectrum`, `csi` or `rssi`; None takes what the file was mainly made for.
        truth: another simulation of the same receivers, which test rows are compared with.
        name, batch_size: see `DataModule`.
    """

    def __init__(
        self,
        file: str | Path,
        target: str | None = None,
        truth: str | Path | None = None,
        name: str = "sionna",
        batch_size: int = 16,
    ) -> None:
        super().__init__(name, batch_size)
        self.file, self.target, self.truth = Path(file), target, truth

    def load(self) -> Measurements:
        """Spectra (S, H, W), channels (S, A, K) or powers (S, 1)."""
        return load_sionna(self.file, self.target, self.truth)
