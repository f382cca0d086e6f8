"""Files of published campaigns are known by the names of their arrays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gsparc.data.campaigns.ble import raw_of_ble
from gsparc.data.campaigns.powder import raw_of_powder
from gsparc.data.campaigns.techtile import raw_of_techtile
from gsparc.data.raw import Raw

LOADERS: dict[str, Callable[[Path], Raw]] = {
    "techtile": raw_of_techtile,
    "powder": raw_of_powder,
    "ble": raw_of_ble,
}
PLANE = 2  # coordinates of places in POWDER's files


def campaign_of(raw: Raw) -> str | None:
    """The choice of conf/dataset that reads a file with these arrays; None where it is of none of them."""
    held = raw.arrays
    if {"rx_antenna_position", "csi"} <= set(held):
        return "techtile"
    if {"mobile_position", "rssi_db"} <= set(held):
        flat = held["mobile_position"].ndim == 2 and held["mobile_position"].shape[1] == PLANE
        return "powder" if flat else "ble"
    return None
