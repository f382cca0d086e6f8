"""Logs of Wi-Fi cards with a table of places: subcarriers, levels and places of each packet."""

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from releases import release
from robots import RUN

from gsparc.datasets.load import load
from gsparc.datasets.own import read_any
from gsparc.datasets.wifi_csi import read_wifi_csi
from gsparc.datasets.wsr import RECORD, SPACING_HZ, TONES, read_log

csiread = pytest.importorskip("csiread")
CARRIER = 5.54e9


@pytest.fixture
def robot(tmp_path) -> Path:
    """A log of an Intel 5300 with senders and the computer's time,
    and the way of the robot that wrote it.
    """
    (tmp_path / "way.csv").write_text("time_s,x,y,z\n1624839900,0,0,1\n1624839960,6,0,1\n")
    content = release(f"releases/wsr/csi_rx_{RUN}.dat").read_bytes()
    (tmp_path / "rx.dat").write_bytes(content)
    return tmp_path / "rx.dat"


def standard(content: bytes) -> bytes:
    """The same records without time, sender and counter, as the card's own tool writes them."""
    rows = np.frombuffer(content, np.uint8).reshape(-1, RECORD.itemsize)
    short = np.delete(rows, np.s_[RECORD.fields["second"][1] : RECORD.fields["csi"][1]], axis=1)
    short[:, :2] = divmod(short.shape[1] - 2, 256)
    return short.tobytes()


def test_a_folder_of_nexmon_with_its_places(caplog):
    caplog.set_level(logging.INFO)
    folder = release("nexmon")
    raw = read_wifi_csi(folder).arrays
    tone = (raw["frequency_hz"] - 5.24e9) / SPACING_HZ
    assert tone.tolist() == [*range(-26, 0), *range(1, 27)]
    assert (
        "52 of 64 subcarriers" in caplog.text
        and ("the level of each row is its RSSI") in caplog.text
    )
    log = csiread.Nexmon(str(folder / "204_1.pcap"), "43455c0", 20, False)
    log.read()
    shape = np.fft.fftshift(log.csi, axes=1)[:, 32 + tone.astype(int)]
    found = raw["csi"][:12, 0]
    assert np.allclose(
        found * shape[:, :1], shape * found[:, :1], rtol=1e-4, atol=1e-6 * np.abs(shape).max()
    )
    level = 10 * np.log10(np.mean(np.abs(raw["csi"][:, 0]) ** 2, axis=1))
    assert np.allclose(level[[0, 12]], [-50, -49], atol=1e-3)
    data = load({"name": "wifi_csi", "file": str(folder)})
    logs = len(list(folder.glob("*.pcap")))
    assert data.target.shape == (12 * logs, 1, 52) and len(np.unique(data.place)) == logs
    assert np.isnan(data.site.stations.position).all() and len(data.site.stations) == 2
    assert data.site.level_unit == "dBm"


def test_tones_of_channels_from_a_transmitter_at_an_unknown_place_were_said_to_be_zero(caplog):
    notes = " ".join(read_any(release("nexmon")).notes)
    load({"name": "wifi_csi", "file": str(release("nexmon"))})
    assert "dataset=wifi_csi" in notes and "are 0 in all rows" not in caplog.text


def test_packets_of_an_intel_5300_along_a_track(robot):
    log = read_log(robot)
    settings = {"places": robot.with_name("way.csv"), "carrier_hz": CARRIER}
    sender = ":".join(f"{part:02x}" for part in log.sender[0].tobytes())
    raw = read_wifi_csi(robot, transmitters={sender: (1, 2, 3)}, **settings).arrays
    assert np.allclose(raw["frequency_hz"], CARRIER + SPACING_HZ * TONES)
    assert np.allclose(raw["rx_position"][:, 0], (log.time - 1624839900) / 10)
    assert np.allclose(raw["csi"], log.csi.swapaxes(1, 2)) and len(raw["station_name"]) == 3
    assert np.isfinite(raw["station_position"]).all(axis=1).sum() == 1
    robot.with_name("way.csv").write_text("file,x,y\nrx.dat,1,2\n")
    robot.write_bytes(standard(robot.read_bytes()))
    plain = read_wifi_csi(robot, **settings).arrays
    assert np.allclose(plain["csi"], raw["csi"], rtol=1e-5)  # by `csiread`, and by our own reader
    assert (plain["rx_position"] == [1, 2, 0]).all()
    assert np.ptp(plain["time_s"]) == pytest.approx(np.ptp(raw["time_s"]), abs=0.01)


def esp32(folder: Path, parts: np.ndarray) -> Path:
    """The log of packets at one place, of their real and imaginary parts (packets, 128)."""
    head = "CSI_DATA,AP,3C:71:BF:6D:2A:78,{},11,1,0,0,0,0,0,0,0,0,-96,0,{},0,{},0,0,0,0,1.5,"
    head += "128,[{} ]\n"
    lines = [
        head.format(-40 - i, 6, 1000 * i, " ".join(map(str, row))) for i, row in enumerate(parts)
    ]
    (folder / "walk.csv").write_text("".join(lines))
    (folder / "places.csv").write_text("file,x,y,z\nwalk,1,2,3\n")
    return folder


def test_an_esp32_and_a_subcarrier_without_a_level(tmp_path):
    parts = np.random.default_rng(0).integers(20, 90, (5, 128))
    parts[:, 20:22] = 0  # subcarrier 10
    raw = read_wifi_csi(esp32(tmp_path, parts)).arrays
    assert raw["frequency_hz"].mean() == pytest.approx(2.437e9, abs=SPACING_HZ)
    tone = ((raw["frequency_hz"] - 2.437e9) / SPACING_HZ).round()
    assert (
        len(tone) == 51 and 10 not in tone and raw["station_name"].tolist() == ["3C:71:BF:6D:2A:78"]
    )


def test_a_packet_of_zeros_made_all_levels_nan(tmp_path, caplog):
    parts = np.random.default_rng(0).integers(20, 90, (5, 128))
    parts[2] = 0
    raw = read_wifi_csi(esp32(tmp_path, parts)).arrays
    assert len(raw["csi"]) == 4 and np.isfinite(raw["csi"]).all() and "1 packets" in caplog.text


def test_logs_that_are_none(robot, tmp_path, refused, monkeypatch):
    refused("places.csv: missing; expected a table of places", read_wifi_csi, robot)
    table = tmp_path / "places.csv"
    table.write_text("file,z\nrx.dat,1\n")
    refused("columns file, z; expected x, y", read_wifi_csi, robot)
    table.write_text("file,x,y\nother.dat,1,2\n")
    refused("no packet has a place", read_wifi_csi, robot)
    table.write_text("file,x,y\nrx.dat,1,two\n")
    refused("places.csv: expected numbers in .*could not convert", read_wifi_csi, robot)
    table.write_text("file,x,y\nrx.dat,1,2\n")
    refused("say dataset.carrier_hz", read_wifi_csi, robot)
    sound = standard(robot.read_bytes())
    robot.write_bytes(b"\xff\xf0" + sound[2:])  # longer than the buffer of csiread
    refused("byte 0: a record of 65520 bytes", read_wifi_csi, robot, None, None, "43455c0", CARRIER)
    robot.write_bytes(b"")
    refused("no packet with a channel in it", read_wifi_csi, robot, None, None, "43455c0", CARRIER)
    refused("expected those of one of 20, 40, 80 MHz", read_wifi_csi, robot, None, "nexmon")
    refused("no such log", read_wifi_csi, tmp_path / "absent", table)
    monkeypatch.setitem(sys.modules, "csiread", None)
    refused("pip install 'gsparc\\[wifi\\]'", read_wifi_csi, robot)
