"""Rooms in the layout of NeWRF: one transmitter, many receivers, one complex channel each, as an npz.

tx_pos (3,), rx_pos (S, 3) [m]; csi (S,) or (S, K) complex; frequency_hz () or (K,) [Hz]
optional: path_offsets (S + 1,), path_last_point (P, 3) [m], path_gain (P,); line_of_sight (S,);
split_train, split_test
"""

from __future__ import annotations

from pathlib import Path

from gsparc.data.datasets.campaign import Campaign
from gsparc.data.errors import DataError
from gsparc.data.own import interpreted
from gsparc.data.raw import Raw, read_raw, renamed
from gsparc.data.schema import Measurements

NAMES = {"tx_pos": "tx_position", "rx_pos": "rx_position"}


def raw_of_newrf(path: str | Path) -> Raw:
    """Read such a room under the schema's names.

    Raises:
        DataError: no such file, or arrays are missing, each in a line.
    """
    raw = read_raw(path)
    missing = [name for name in (*NAMES, "csi", "frequency_hz") if name not in raw.arrays]
    if missing:
        raise DataError([f"{path}, {n}: missing; expected in the layout of NeWRF" for n in missing], path)
    return renamed(raw, NAMES)


def load_newrf(path: str | Path) -> Measurements:
    """Such a room as measurements: targets complex64 (S, 1, K) of about unit mean power, see `interpret`.

    Raises:
        DataError: anything is missing or wrong; all problems are listed with array and row.
    """
    return interpreted(raw_of_newrf(path), path)


class NeWRF(Campaign):
    """One transmitter, many receivers, complex channels; settings of `Campaign`."""

    choice, reader = "newrf", staticmethod(raw_of_newrf)
