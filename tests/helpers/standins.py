"""Small simulated releases of the measured ones' layouts, made when a test first asks for one."""

import struct
from pathlib import Path

import numpy as np
from measured import CAMPUS, DEGREES, ble_arrays, powder_arrays, techtile_arrays
from robots import FREQUENCY, RUN, drive, true_root

from gsparc.datasets.wsr import LOS_SET_A
from gsparc.simulate.rfid_sim import write_rfid_sim


def _city() -> dict[str, np.ndarray]:
    """A walk past three stations; one of them is off for 80 rows."""
    rng = np.random.default_rng(0)
    corners = np.array([CAMPUS, *DEGREES, CAMPUS])
    along = np.linspace(0, len(corners) - 1, 800)
    way = np.stack([np.interp(along, np.arange(len(corners)), axis) for axis in corners.T], axis=1)
    arrays = powder_arrays(way + rng.normal(0, 2e-5, way.shape))
    arrays["rssi_db"] += rng.normal(0, 1, arrays["rssi_db"].shape).astype(np.float32)
    arrays["rssi_db"][100:180, 1] = np.nan
    return arrays


def _plane() -> dict[str, np.ndarray]:
    """Powers of three waves, centimetre by centimetre; a few rows are faults."""
    places = np.stack(np.meshgrid(np.arange(80), np.arange(80), [25]), axis=-1).reshape(-1, 3) / 100
    distance = np.linalg.norm(places[:, None] - [[0, 0, 2.4], [1, 2, 2.4], [3, -1, 2.4]], axis=-1)
    level = (
        20
        * np.log10(np.abs((np.exp(-2j * np.pi * distance / 0.326) / distance).sum(axis=1)) + 0.05)
        - 20
    )
    level[700:705] = -90
    return {
        "rx_position": np.float32(places),
        "rssi_db": np.float32(level),
        "frequency_hz": np.array(920e6),
    }


def _robot_runs() -> dict[str, np.ndarray]:
    """Squared channels of three transmitters and their roots:
    five runs of 1 m in each of five patches.
    """
    rng, posts = np.random.default_rng(0), np.array([*LOS_SET_A.values()])
    starts = rng.uniform(-0.8, 0.8, (5, 1, 1, 2)) + rng.normal(0, 0.004, (5, 5, 1, 2))
    turned = rng.uniform(0, 2 * np.pi, (5, 1, 1)) + rng.normal(0, 0.005, (5, 5, 1))
    along = 0.016 * np.arange(60)[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=-1)
    where = np.pad(
        (starts + along).reshape(25, 60, 2), ((0, 0), (0, 0), (0, 1)), constant_values=0.2
    )
    root = np.concatenate([true_root(where.reshape(-1, 3), post) for post in posts])
    root += 0.1 * np.abs(root).mean() * (rng.normal(size=(2, *root.shape)).T @ [1, 1j]).T
    square = np.complex64(root**2)
    return {
        "rx_position": np.float32(np.tile(where.reshape(-1, 3), (3, 1))),
        "tx_position": np.float32(posts),
        "tx_index": np.repeat(np.arange(3), 1500),
        "run": np.tile(np.repeat(np.arange(25), 60), 3),
        "segment": np.repeat(np.arange(75), 60),
        "h2": square,
        "good": np.ones(4500, bool),
        "root_sign": np.where((root * np.sqrt(square).conj()).real < 0, -1, 1),
        "subcarrier_hz": FREQUENCY,
        "frequency_hz": np.array(5.54e9),
    }


# What precedes the channel in a packet of a 43455c0: Ethernet, IP, UDP, mark, sender, channel 48,
# chip.
PACKET = (
    "ffffffffffff4e45584d4f4e08004500012e000100000111a4ab0a0a0a0affffffff"
    "157c157c011a000011111111{}c0a5000030d06500"
)
SENDERS = "b83a5ab26e70", "b83a5ab26e71"


def _corridor(folder: Path) -> None:
    """Six logs of twelve packets, whose phases and gains are their own
    and whose guard tones hold junk.
    """
    rng, tone, table = (
        np.random.default_rng(0),
        np.fft.fftfreq(64, 1 / 64),
        "file,x,y,rssi_dbm,channel\n",
    )
    folder.mkdir()
    for i in range(6):
        name, head = (
            f"{204 + i // 2}_{1 + i % 2}.pcap",
            bytes.fromhex(PACKET.format(SENDERS[i % 2])),
        )
        table += f"{name},{9.7 + 0.6 * i},5.6,{-50 + i},48\n"
        content = struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 1 << 18, 1)
        for k in range(12):
            csi = 1 + 0.5 * np.exp(-2j * np.pi * tone * 0.02)
            csi *= (
                10 ** rng.uniform(2.2, 3)
                * np.exp(2j * np.pi * rng.uniform())
                * np.where(tone, 1, 9)
            )
            parts = np.stack([csi.real, csi.imag], axis=1).astype("<i2").tobytes()
            content += (
                struct.pack("<IIII", 1_627_494_000 + i, k, *2 * [len(head + parts)]) + head + parts
            )
        (folder / name).write_bytes(content)
    (folder / "places.csv").write_text(table)


MAKERS = {
    "rfid-s23-160": lambda path: write_rfid_sim(path, 160, seed=0),
    "nexmon": _corridor,
    f"releases/wsr/csi_rx_{RUN}.dat": lambda path: drive(path.parent, RUN, packets=150),
    "ofdm/wsr-los-a.npz": lambda path: np.savez(path, **_robot_runs()),
    "ofdm/wsr-nlos-a.npz": lambda path: np.savez(path, **_robot_runs()),
    "real/techtile-csi-920mhz.npz": lambda path: np.savez(path, **techtile_arrays()),
    "real/techtile-power-reci-rf-1.npz": lambda path: np.savez(path, **_plane()),
    "real/powder-rss-462mhz.npz": lambda path: np.savez(path, **_city()),
    "real/ble-hall-1.npz": lambda path: np.savez(path, **ble_arrays()),
}
