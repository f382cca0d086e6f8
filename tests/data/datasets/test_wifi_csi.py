"""Logs of Wi-Fi cards with a table of places: subcarriers, levels and places of each packet."""

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from releases import real

from gsparc.data.datasets import wifi_csi
from gsparc.data.datasets.own import read_any
from gsparc.data.datasets.wifi_csi import read_wifi_csi
from gsparc.data.datasets.wifi_logs import Packets
from gsparc.data.datasets.wsr import SPACING_HZ
from gsparc.data.load import load

csiread = pytest.importorskip("csiread")


def test_a_folder_of_nexmon_with_its_places(caplog):
    caplog.set_level(logging.INFO)
    folder = real("nexmon")
    raw = read_wifi_csi(folder).arrays
    tone = (raw["frequency_hz"] - 5.24e9) / SPACING_HZ
    assert tone.tolist() == [*range(-26, 0), *range(1, 27)]
    assert "52 of 64 subcarriers" in caplog.text and "the level of each row is its RSSI" in caplog.text
    log = csiread.Nexmon(str(folder / "204_1.pcap"), "43455c0", 20, False)
    log.read()
    shape = np.fft.fftshift(log.csi, axes=1)[:, 32 + tone.astype(int)]
    found = raw["csi"][:12, 0]
    assert np.allclose(found * shape[:, :1], shape * found[:, :1], rtol=1e-4, atol=1e-6 * np.abs(shape).max())
    level = 10 * np.log10(np.mean(np.abs(raw["csi"][:, 0]) ** 2, axis=1))
    assert np.allclose(level[[0, 12]], [-50, -49], atol=1e-3)
    data = load({"name": "wifi_csi", "file": str(folder)})
    assert data.target.shape == (624, 1, 52) and len(np.unique(data.place)) == 52
    assert np.isnan(data.site.stations.position).all() and len(data.site.stations) == 2
    assert data.site.level_unit == "dBm"


def test_tones_of_channels_from_a_transmitter_at_an_unknown_place_were_said_to_be_zero(caplog):
    notes = " ".join(read_any(real("nexmon")).notes)
    load({"name": "wifi_csi", "file": str(real("nexmon"))})
    assert "dataset=wifi_csi" in notes and "are 0 in all rows" not in caplog.text


def logged(folder: Path, monkeypatch, csi: np.ndarray) -> Path:
    """A log of packets, one a second, at 2.437 GHz."""
    folder.joinpath("walk.pcap").touch()
    count, points = csi.shape[0], csi.shape[2]
    tone = np.fft.fftfreq(points, 1 / points).round().astype(int)
    sender = np.full(count, "3c:71:bf:6d:2a:78")
    packets = Packets(np.arange(count, dtype=float), sender, csi, tone, -40.0 - 4 * np.arange(count), 2.437e9)
    monkeypatch.setattr(wifi_csi, "read_packets", lambda path, chip: packets)
    return folder


def channels() -> np.ndarray:
    parts = np.random.default_rng(0).integers(20, 90, (2, 5, 1, 64))
    return parts[0] + 1j * parts[1]


def test_packets_along_a_track_and_a_subcarrier_without_a_level(tmp_path, monkeypatch, caplog):
    csi = channels()
    csi[..., 10] = 0
    (tmp_path / "places.csv").write_text("time_s,x,y,z\n0,0,0,1\n3,6,0,1\n")
    settings = {"transmitters": {"3c:71:bf:6d:2a:78": (1, 2, 3)}}
    raw = read_wifi_csi(logged(tmp_path, monkeypatch, csi), **settings).arrays
    assert np.allclose(raw["rx_position"], [[0, 0, 1], [2, 0, 1], [4, 0, 1], [6, 0, 1]])
    assert "1 of 5 packets left out" in caplog.text
    tone = ((raw["frequency_hz"] - 2.437e9) / SPACING_HZ).round()
    assert len(tone) == 51 and 10 not in tone and raw["station_position"].tolist() == [[1, 2, 3]]
    level = 10 * np.log10(np.mean(np.abs(raw["csi"][:, 0]) ** 2, axis=1))
    assert np.allclose(level, [-40, -44, -48, -52], atol=1e-3)


def test_a_packet_of_zeros_made_all_levels_nan(tmp_path, monkeypatch, caplog):
    csi = channels()
    csi[2] = 0
    (tmp_path / "places.csv").write_text("file,x,y,z\nwalk,1,2,3\n")
    raw = read_wifi_csi(logged(tmp_path, monkeypatch, csi)).arrays
    assert len(raw["csi"]) == 4 and np.isfinite(raw["csi"]).all() and "1 packets" in caplog.text


def test_logs_that_are_none(tmp_path, refused, monkeypatch):
    log, table = tmp_path / "rx.pcap", tmp_path / "places.csv"
    log.write_bytes(real("nexmon/204_1.pcap").read_bytes())
    refused("places.csv: missing; expected a table of places", read_wifi_csi, log)
    table.write_text("file,z\nrx.pcap,1\n")
    refused("columns file, z; expected x, y", read_wifi_csi, log)
    table.write_text("file,x,y\nother.pcap,1,2\n")
    refused("no packet has a place", read_wifi_csi, log)
    table.write_text("file,x,y\nrx.pcap,1,two\n")
    refused("places.csv: expected numbers in .*could not convert", read_wifi_csi, log)
    table.write_text("file,x,y\nrx.pcap,1,2\n")
    log.write_bytes(b"")
    refused("expected those of one of 20, 40, 80 MHz", read_wifi_csi, log)
    refused("no such log", read_wifi_csi, tmp_path / "absent", table)
    monkeypatch.setitem(sys.modules, "csiread", None)
    refused("pip install 'gsparc\\[wifi\\]'", read_wifi_csi, log)
