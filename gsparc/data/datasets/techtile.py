"""Channels of a moving transmitter at the ceiling antennas of Techtile (KU Leuven, ELLIIIT-dataset-26).

The release's NetCDF file as an npz: tx_position (S, 3), rx_antenna_position (T, 3) [m], mask (S, T), run
(S,), frequency_hz () and csi (S, T), which is `csi_real - 1j * csi_imag` of the release: it stores reference
minus received phase.
"""

from __future__ import annotations

from pathlib import Path

from gsparc.data.datasets.campaign import Campaign, read_converted
from gsparc.data.raw import Raw

NPZ = {
    **{"tx_position": "tx_position", "rx_antenna_position": "station_position", "csi": "csi"},
    **{"mask": "mask", "run": "run", "frequency_hz": "frequency_hz"},
}


def read_techtile(path: str | Path) -> Raw:
    """Read an npz.

    Returns:
        `tx_position` (S, 3), `station_position` (T, 3) [m], `csi` (S, T) complex that follows
        `exp(-j 2 pi f d / c)`, `mask` (S, T), `run` (S,), `frequency_hz` ().

    Raises:
        DataError: no such file, or arrays missing or wrong; all problems with array and row.
    """
    return read_converted(path, NPZ, name="techtile", layout="techtile")


class Techtile(Campaign):
    """Channels of a moving transmitter at 42 antennas; settings of `Campaign`."""

    choice, reader = "techtile", staticmethod(read_techtile)
    marks = frozenset({"rx_antenna_position", "csi"})
