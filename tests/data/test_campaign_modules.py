"""`dataset=techtile`, `powder`, `ble`: settings, and the measurements that come of them."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from measured import (
    ANTENNAS,
    CYCLES,
    DEGREES,
    HOSTS,
    ble_arrays,
    powder_arrays,
    techtile_arrays,
    write_npz,
    write_release,
    write_walk,
)
from releases import real

from gsparc.data.errors import DataError
from gsparc.data.load import datamodule, load
from gsparc.data.own import interpret
from gsparc.data.raw import Raw, read_raw
from gsparc.data.selection import keep_above

MAKERS = {"techtile": techtile_arrays, "powder": powder_arrays, "ble": ble_arrays}
EVERY = pytest.mark.parametrize("name", MAKERS)


@EVERY
def test_settings_of_the_configuration(tmp_path, name):
    path = write_npz(tmp_path, name)
    module = datamodule({"name": name, "file": str(path), "stations": [0, 2], "max_rows": 9})
    assert module.selection.stations == (0, 2) and module.selection.max_rows == 9
    assert module.name == name and module.selection.runs is None
    assert {"station_height", "station_position"} & set(module.raw().arrays)


@EVERY
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_row": 9}, "dataset.max_row: no such setting of dataset={name}; did you mean 'max_rows'?"),
        ({"max_rows": 1}, "dataset.max_rows=1: expected a whole number, at least 2"),
        ({"stations": []}, "dataset.stations=[]: expected names"),
        ({"min_rssi_db": "x"}, "dataset.min_rssi_db=x: expected a level in dB"),
        ({"file": None}, "dataset.file is not set; say dataset.file=FILE for dataset={name}"),
        ({"root": "x"}, "dataset.root is not a setting of dataset={name}; say dataset.file=..."),
    ],
)
def test_settings_that_cannot_be(tmp_path, name, settings, words):
    with pytest.raises(DataError) as caught:
        datamodule({"name": name, "file": str(write_npz(tmp_path, name)), **settings})
    assert words.format(name=name) in str(caught.value)


@EVERY
def test_the_setting_is_named_where_nothing_is_left(tmp_path, name):
    path = str(write_npz(tmp_path, name))
    with pytest.raises(DataError, match=r"dataset\.stations=x: "):
        load({"name": name, "file": path, "stations": "x"})
    with pytest.raises(DataError, match=r"dataset\.runs"):
        load({"name": name, "file": path, "runs": ["EXP999"]})
    with pytest.raises(DataError, match=r"dataset\.min_rssi_db=99"):
        load({"name": name, "file": path, "min_rssi_db": 99})


def test_techtile_is_links_to_antennas(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        data = load({"name": "techtile", "file": str(write_release(tmp_path))})
    stations, arrays = data.site.stations, read_of_release(tmp_path)
    assert data.site.kind == "csi" and data.site.static_end == "rx" and data.site.carrier_hz == 920e6
    assert np.allclose(stations.position + data.site.origin, ANTENNAS) and stations.name == tuple(HOSTS)
    assert len(data) == arrays["mask"].sum() and data.target.shape == (len(data), 1, 1)
    links = arrays["csi"][data.place, data.station]
    assert np.allclose(data.target[:, 0, 0] * data.site.target_scale, links, rtol=1e-5)
    assert np.allclose(data.moving + data.site.origin, arrays["tx_position"][data.place])
    runs = arrays["run"][data.place]
    assert len(set(zip(runs, data.run, strict=True))) == 2
    assert "1 of 15 cycles left out: no position" in caplog.text


def read_of_release(folder):
    """The arrays of the release's file in `folder`."""
    from gsparc.data.datasets.techtile import raw_of_techtile

    return raw_of_techtile(folder / "csi.nc").arrays


def test_one_run_of_techtile(tmp_path, caplog):
    settings = {"file": str(write_release(tmp_path)), "runs": ["EXP005"], "stations": ["B05", "A05"]}
    with caplog.at_level(logging.WARNING):
        data = load({"name": "techtile", **settings})
    assert data.site.stations.name == ("A05", "B05") and len(data) == 2 * CYCLES - 1
    assert "dataset.runs=EXP005: 6 of 14 rows left out" in caplog.text
    assert "dataset.stations: 1 of 3 stations left out" in caplog.text


@pytest.mark.parametrize(
    "write", [lambda folder: write_npz(folder, "powder"), write_walk], ids=["npz", "csv"]
)
def test_powder_is_links_on_the_earth(tmp_path, write):
    data, arrays = load({"name": "powder", "file": str(write(tmp_path))}), powder_arrays()
    assert data.site.kind == "rssi" and data.site.static_end == "rx" and len(data) == 58
    heard = 10 * np.log10(data.target[:, 0].astype(float) * data.site.target_scale)
    assert np.allclose(heard, arrays["rssi_db"][data.place, data.station], atol=1e-3)
    world = data.moving + data.site.origin
    degrees = np.stack(data.site.georeference.to_degrees(world[:, :2]), axis=-1)
    expected = np.stack([arrays["latitude"], arrays["longitude"]], axis=-1)[data.place]
    assert np.abs(degrees - expected).max() < 1e-7
    assert np.allclose(world[:, 2], 1.5)
    stations = data.site.stations.position + data.site.origin
    where = np.stack(data.site.georeference.to_degrees(stations[:, :2]), axis=-1)
    assert np.abs(where - DEGREES).max() < 1e-7 and np.allclose(stations[:, 2], 10)


def test_ble_is_links_to_sensors(tmp_path):
    data, arrays = load({"name": "ble", "file": str(write_npz(tmp_path, "ble"))}), ble_arrays()
    assert data.site.static_end == "rx" and len(data) == 60 and data.site.carrier_hz == 2.44e9
    assert data.site.stations.name == tuple(arrays["station"])
    assert np.allclose(data.site.stations.position + data.site.origin, arrays["station_position"])


def test_faults_below_a_level_are_no_links(tmp_path):
    def faulty(arrays):
        rssi = arrays["rssi_db"].copy()
        rssi[2, 1] = -120
        return {**arrays, "rssi_db": rssi}

    path = write_npz(tmp_path, "ble", faulty)
    data = load({"name": "ble", "file": str(path), "min_rssi_db": -100})
    assert len(data) == 59 and not ((data.place == 2) & (data.station == 1)).any()


def test_powers_of_an_unknown_transmitter():
    raw = keep_above(Raw({"rx_position": PLANE, "rssi_db": np.linspace(-90, -10, 50)}), -75, "plane").raw
    data = interpret(raw, "plane").data
    assert data.site.static_position is None and data.site.static_end == "tx" and np.isnan(data.tx).all()
    assert len(data) == len(raw.arrays["rssi_db"])


PLANE = np.random.default_rng(0).uniform([0, 0, 0.25], [1.25, 1.25, 0.26], (50, 3))


def test_measured_campaigns():
    for name, file, links in (
        ("techtile", "techtile-csi-920mhz.npz", 1015 * 42 - 4),
        ("ble", "ble-hall-1.npz", 81 * 12),
        ("ble", "ble-hall-2.npz", 45 * 12),
    ):
        assert len(load({"name": name, "file": str(real(f"real/{file}"))})) == links


def test_measured_campus():
    path = real("real/powder-rss-462mhz.npz")
    arrays = read_raw(path).arrays
    data = load({"name": "powder", "file": str(path), "stations": ["ebc-nuc1-b210"]})
    column = arrays["station"].tolist().index("ebc-nuc1-b210")
    assert len(data) == np.isfinite(arrays["rssi_db"][:, column]).sum()
    # The file's own metres take a degree of latitude for 110.574 km, 0.4 % short.
    moved = data.moving[-1, :2] - data.moving[0, :2]
    rows = [int(data.row_names[i].partition(",")[0].removeprefix("row ")) for i in (0, -1)]
    by_file = np.diff(arrays["mobile_position"][rows], axis=0)[0]
    assert np.allclose(moved, by_file, rtol=0.005, atol=0.5)


def test_measured_plane():
    path = real("real/techtile-power-reci-rf-1.npz")
    data = interpret(keep_above(read_raw(path), -75, path).raw, path).data
    assert len(data) == 20309 and data.site.static_position is None
