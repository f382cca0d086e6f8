"""Packets of Wi-Fi logs, read by `csiread`: Nexmon and Intel 5300; ESP32 on no log of a card yet.

`csiread` trusts the lengths that a file states: a packet longer than its buffer overwrites its
stack, and a file that is not there ends the process. So lengths are looked at before it reads.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError, readable
from gsparc.datasets.wsr import RECORD, TONES, read_log
from gsparc.physics.decibels import to_decibels

SUFFIXES = {".pcap": "nexmon", ".dat": "intel", ".csv": "esp32"}
HT40 = 0x800  # of the rates of an Intel 5300: 40 MHz
TONES_40 = np.array([*range(-58, 0, 4), *range(2, 59, 4)])  # of 128 that it reports there
STREAMS = 3  # most antennas at either end of the cards
BUFFER = 1024  # bytes of `csiread` for a record of an Intel 5300
TICKS = 2.0**32  # microseconds after which the clock of an Intel 5300 begins again
HEADS = 16, 60  # bytes of a packet before its Ethernet frame, and of that before the channel
# MHz by bytes of the channel, after which come a few that are none
POINTS = {256: 20, 512: 40, 1024: 80}
PADDING = 256  # bytes, more than those
OLD_MAGIC = b"\x11" * 4  # of Nexmon's packets without RSSI


@dataclass(frozen=True)
class Packets:
    """What a log says of its packets.

    Attributes:
        time_s: (n,) float64 [s], of the clock that the card or the computer logs.
        sender: (n,) str, the address that each is from; empty where the log does not say.
        csi: (n, A, K) complex, in the card's own scale.
        tone: (K,) int, subcarriers counted from the carrier.
        rssi_dbm: (n,) float64, NaN where the log does not say.
        carrier_hz: of all packets; None where the log does not say.
        position: (n, 3) [m] where they were received, which no log says.
    """

    time_s: np.ndarray
    sender: np.ndarray
    csi: np.ndarray
    tone: np.ndarray
    rssi_dbm: np.ndarray
    carrier_hz: float | None = None
    position: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def read_packets(path: Path, card: str | None = None, chip: str = "43455c0") -> Packets:
    """Read the packets of a log.

    Args:
        path: *.pcap of Nexmon, *.dat of an Intel 5300, or what `card` names.
        card: `nexmon`, `intel` or `esp32`; None: by the file's ending.
        chip: of Nexmon: `4339`, `43455c0`, `4358` or `4366c0`.

    Raises:
        DataError: `csiread` is missing, or the file, or it is no log of this card.
    """
    try:
        import csiread
    except ImportError:
        raise DataError(
            f"{path}: Wi-Fi logs need csiread; say: pip install 'gsparc[wifi]'"
        ) from None
    card = card or SUFFIXES.get(path.suffix.lower())
    if card not in READERS:
        raise DataError(f"{path}: no log of a known card; say dataset.card={'|'.join(READERS)}")
    with readable(path, f"not readable as a log of {card}", Exception):  # `csiread` raises anything
        packets = READERS[card](path, csiread, chip)
    if not len(packets.csi):
        raise DataError(f"{path}: no packet with a channel in it; is it a log of {card}?")
    return packets


def channel_hz(channel: int) -> float:
    """Return the carrier [Hz] of a channel of Wi-Fi at 2.4 or 5 GHz, by its number."""
    first = 2407 if channel < 14 else 2414 if channel == 14 else 5000
    return 1e6 * (first + 5 * channel)


def format_address(octets: np.ndarray) -> np.ndarray:
    """Return addresses (n, 6) as texts (n,) like `b8:3a:5a:b2:6e:70`."""
    return np.array([":".join(f"{octet:02x}" for octet in address) for address in octets], str)


def _nexmon(path: Path, csiread: Any, chip: str) -> Packets:
    frames = list(_frames(path))
    sizes = sorted({size for size, _, _ in frames})
    if len(sizes) != 1 or sizes[0] not in POINTS:
        listed = ", ".join(map(str, sizes)) or "none"
        raise DataError(
            f"{path}: bytes of channels: {listed}; expected those of one of 20, 40, 80 MHz"
        )
    silent = frames[0][1] == OLD_MAGIC
    log = (csiread.Nexmon if silent else csiread.NexmonPull256)(
        str(path), chip, POINTS[sizes[0]], False
    )
    log.read()
    # Other cores and streams are packets of their own; the last packet may be cut short.
    rows = np.flatnonzero((log.core == 0) & (log.spatial == 0))
    rows = rows[rows < sum(whole for _, _, whole in frames)]
    spec, points = int(log.chan_spec[0]), sizes[0] // 4
    rssi = (
        np.full(len(rows), np.nan)
        if silent
        else log.rssi[rows].astype(np.uint8).view(np.int8).astype(float)
    )
    return Packets(
        log.sec[rows] + log.usec[rows] * (1e-9 if log.nano else 1e-6),
        format_address(log.src_addr[rows]),
        log.csi[rows, None],
        np.fft.fftfreq(points, 1 / points).round().astype(int),  # in the order of an FFT
        np.where(rssi < 0, rssi, np.nan),
        channel_hz(spec & 0xFF),
    )


def _frames(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Bytes of the channel and first bytes of each of Nexmon's packets,
    and whether it is there whole.
    """
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


def _intel(path: Path, csiread: Any, _: str) -> Packets:
    content = path.read_bytes()
    size = int.from_bytes(content[:2], "big")
    # With time and sender, which `csiread` would take for the channel
    if size + 2 == RECORD.itemsize:
        records = read_log(path)
        # Of zeros: no level in dB
        power = np.sum(np.abs(records.csi) ** 2, axis=2).mean(axis=1).clip(1e-300)
        sender = format_address(np.frombuffer(records.sender.tobytes(), np.uint8).reshape(-1, 6))
        return Packets(records.time, sender, records.csi.swapaxes(1, 2), TONES, to_decibels(power))
    at, count = 0, 0
    while at + 2 < len(content):
        size = int.from_bytes(content[at : at + 2], "big")
        if size > BUFFER:
            raise DataError(
                f"{path}, byte {at}: a record of {size} bytes; is it a log of an Intel 5300?"
            )
        at, count = at + 2 + size, count + 1
    log = csiread.Intel(str(path), STREAMS, STREAMS, if_report=False, bufsize=count)
    log.read()
    wide = (log.rate & HT40) > 0
    valid = (log.Nrx == log.Nrx.max(initial=0)) & (wide == wide[:1])
    tick = log.timestamp_low[valid].astype(np.float64)
    tick += TICKS * np.cumsum(np.diff(tick, prepend=tick[:1]) < 0)
    return Packets(
        1e-6 * tick,
        np.full(len(tick), ""),
        # The first transmit antenna
        log.csi[valid, :, : int(log.Nrx.max(initial=0)), 0].swapaxes(1, 2),
        TONES_40 if wide[:1].any() else TONES,
        log.get_total_rss()[valid],
    )


def _esp32(path: Path, csiread: Any, _: str) -> Packets:
    log = csiread.ESP32(str(path), if_report=False)
    log.read()
    # Of the legacy training field, which comes first
    tone = np.fft.fftfreq(64, 1 / 64).round().astype(int)
    carrier = channel_hz(int(log.channel[0]))
    csi = log.csi[:, None, :64]
    return Packets(
        1e-6 * log.local_timestamp, np.array(log.mac), csi, tone, log.rssi * 1.0, carrier
    )


READERS = {"nexmon": _nexmon, "intel": _intel, "esp32": _esp32}
