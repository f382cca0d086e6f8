"""Rooms in the layout of NeWRF: one transmitter, many receivers, one complex channel each, as an npz.

tx_pos (3,), rx_pos (S, 3) [m]; csi (S,) or (S, K) complex; frequency_hz () or (K,) [Hz]
optional: path_offsets (S + 1,), path_last_point (P, 3) [m], path_gain (P,); line_of_sight (S,);
split_train, split_test
"""

from __future__ import annotations

from pathlib import Path

from gsparc.data.datamodule import DataModule
from gsparc.data.errors import DataError
from gsparc.data.own import Reading, interpret
from gsparc.data.raw import Raw, read_raw, renamed
from gsparc.data.schema import Measurements

NAMES = {"tx_pos": "tx_position", "rx_pos": "rx_position"}


def is_newrf(raw: Raw) -> bool:
    """Whether the arrays are named as in this layout."""
    return set(NAMES) <= set(raw.arrays)


def load_newrf(path: str | Path) -> Measurements:
    """Read such a room: kind csi, static transmitter, targets complex64 (S, 1, K) of about unit mean power.

    The channels are divided by one constant of the site, their root mean square over all rows rounded
    to 1 dB (the loader does not know the split); it is kept as `site.target_scale`.

    Raises:
        DataError: anything is missing or wrong; all problems are listed with array and row.
    """
    return read_newrf(read_raw(path), path).data


def read_newrf(raw: Raw, path: str | Path) -> Reading:
    """The same from arrays already read, with notes.

    Raises:
        DataError: as `load_newrf`.
    """
    missing = [name for name in (*NAMES, "csi", "frequency_hz") if name not in raw.arrays]
    if missing:
        raise DataError([f"{path}, {n}: missing; expected in the layout of NeWRF" for n in missing], path)
    reading = interpret(renamed(raw, NAMES), path)
    if reading.data.site.static_end != "tx":
        raise DataError(f"{path}: rx_pos does not move; expected one transmitter and many receivers", path)
    return reading


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
