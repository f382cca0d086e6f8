"""Packets of Wi-Fi logs of Nexmon, read by `csiread`.

`csiread` trusts the lengths that a file states: a packet longer than its buffer overwrites its stack, and a
file that is not there ends the process. So lengths are looked at before it reads. Logs of other cards: write
what `csiread` reads of them, with their places, as a file of the schema.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.errors import DataError, readable

HEADS = 16, 60  # bytes of a packet before its Ethernet frame, and of that before the channel
POINTS = {256: 20, 512: 40, 1024: 80}  # MHz by bytes of the channel, after which come a few that are none
PADDING = 256  # bytes, more than those
OLD_MAGIC = b"\x11" * 4  # of Nexmon's packets without RSSI


@dataclass(frozen=True)
class Packets:
    """What a log says of its packets.

    Attributes:
        time_s: (n,) float64 [s], of the clock that the card or the computer logs.
        sender: (n,) str, the address that each is from.
        csi: (n, A, K) complex, in the card's own scale.
        tone: (K,) int, subcarriers counted from the carrier.
        rssi_dbm: (n,) float64, NaN where the log does not say.
        carrier_hz: of all packets.
        position: (n, 3) [m] where they were received, which no log says.
    """

    time_s: np.ndarray
    sender: np.ndarray
    csi: np.ndarray
    tone: np.ndarray
    rssi_dbm: np.ndarray
    carrier_hz: float
    position: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def channel_hz(channel: int) -> float:
    """Return the carrier [Hz] of a channel of Wi-Fi at 2.4 or 5 GHz, by its number."""
    first = 2407 if channel < 14 else 2414 if channel == 14 else 5000
    return 1e6 * (first + 5 * channel)


def format_address(octets: np.ndarray) -> np.ndarray:
    """Return addresses (n, 6) as texts (n,) like `b8:3a:5a:b2:6e:70`."""
    return np.array([":".join(f"{octet:02x}" for octet in one) for one in octets], str)


def read_packets(path: Path, chip: str = "43455c0") -> Packets:
    """Read the packets of a log.

    Args:
        path: *.pcap of Nexmon.
        chip: `4339`, `43455c0`, `4358` or `4366c0`.

    Raises:
        DataError: `csiread` is missing, or the file, or it is no log of Nexmon.
    """
    try:
        import csiread
    except ImportError:
        raise DataError(f"{path}: Wi-Fi logs need csiread; say: pip install 'gsparc[wifi]'") from None
    with readable(path, "not readable as a log of Nexmon", Exception):  # `csiread` raises anything
        packets = _nexmon(path, csiread, chip)
    if not len(packets.csi):
        raise DataError(f"{path}: no packet with a channel in it; is it a log of Nexmon?")
    return packets


def _nexmon(path: Path, csiread: Any, chip: str) -> Packets:
    frames = list(_frames(path))
    sizes = sorted({size for size, _, _ in frames})
    if len(sizes) != 1 or sizes[0] not in POINTS:
        found = ", ".join(map(str, sizes)) or "none"
        raise DataError(f"{path}: bytes of channels: {found}; expected those of one of 20, 40, 80 MHz")
    silent = frames[0][1] == OLD_MAGIC
    log = (csiread.Nexmon if silent else csiread.NexmonPull256)(str(path), chip, POINTS[sizes[0]], False)
    log.read()
    # Other cores and streams are packets of their own; the last packet may be cut short.
    one = np.flatnonzero((log.core == 0) & (log.spatial == 0))
    one = one[one < sum(whole for _, _, whole in frames)]
    spec, points = int(log.chan_spec[0]), sizes[0] // 4
    rssi = np.full(len(one), np.nan) if silent else log.rssi[one].astype(np.uint8).view(np.int8).astype(float)
    return Packets(
        log.sec[one] + log.usec[one] * (1e-9 if log.nano else 1e-6),
        format_address(log.src_addr[one]),
        log.csi[one, None],
        np.fft.fftfreq(points, 1 / points).round().astype(int),  # in the order of an FFT
        np.where(rssi < 0, rssi, np.nan),
        channel_hz(spec & 0xFF),
    )


def _frames(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Bytes of the channel and first bytes of each of Nexmon's packets, and whether it is there whole."""
    content = path.read_bytes()
    order = "big" if content[:1] == b"\xa1" else "little"
    before, head = HEADS
    at = 24
    while at + before <= len(content):
        size = int.from_bytes(content[at + 8 : at + 12], order)  # type: ignore[arg-type]
        frame = content[at + before : at + before + size]
        if frame[6:12] == b"NEXMON":
            yield (size - head) // PADDING * PADDING, frame[42:46], len(frame) == size
        at += before + size
