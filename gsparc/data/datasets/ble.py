"""Received powers of a Bluetooth beacon at the sensors of a hall, as an npz.

mobile_position (S, 3), station_position (T, 3) [m]; rssi_db (S, T) [dBm]; station (T,) names;
frequency_hz () [Hz]
"""

from __future__ import annotations

from pathlib import Path

from gsparc.data.datasets.campaign import Campaign, Expected, check_layout
from gsparc.data.raw import Raw, read_raw
from gsparc.data.schema import TEXT

LAYOUT = {
    "mobile_position": Expected(("S", 3), place=True, field="tx_position"),
    "station_position": Expected(("T", 3), place=True),
    "rssi_db": Expected(("S", "T")),
    "station": Expected(("T",), TEXT, optional=True, field="station_name"),
    "frequency_hz": Expected((), optional=True, field="carrier_hz"),
}


def raw_of_ble(path: str | Path) -> Raw:
    """Read such a file; NaN is no value.

    Returns:
        `tx_position` (S, 3), `station_position` (T, 3) [m], `rssi_db` (S, T) [dBm], `station_name` (T,)
        and `carrier_hz` () where the file has them.

    Raises:
        DataError: no such file, or an array is missing or wrong; all problems with array and row.
    """
    raw = read_raw(path)
    return Raw(check_layout(raw, path, LAYOUT), {**raw.attributes, "layout": "ble"})


class BLE(Campaign):
    """Powers of a beacon at many places, at the sensors of a hall; settings of `Campaign`."""

    choice, reader = "ble", staticmethod(raw_of_ble)
