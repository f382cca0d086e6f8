"""Files in the forms that other tools write, of a place that is simulated:
what is read is the truth.
"""

import gzip
import json

import numpy as np
import pandas as pd
import pytest
from doors import said

from gsparc.datasets.own import read_any
from gsparc.tables.own import interpret
from gsparc.tables.raw import Raw
from gsparc.tables.read import parse_table
from gsparc.tables.sheet import say_column

COUNT, LIGHT = 60, 299792458.0
RNG = np.random.default_rng(7)
ROOM = np.round(
    np.c_[RNG.uniform(0, 5, COUNT), RNG.uniform(0, 4, COUNT), RNG.uniform(1, 2, COUNT)], 4
)
AT, TONES = np.array([4.0, 2.5, 2.2]), 3.5e9 + 4e6 * np.arange(8)
CHANNELS = sum(
    gain * np.exp(-2j * np.pi * TONES * away[:, None] / LIGHT) / away[:, None]
    for gain, away in (
        (g, np.linalg.norm(ROOM - AT * m, axis=1)) for g, m in ((1, 1), (0.5, [-1, 1, 1]))
    )
)
LATITUDE, LONGITUDE = 48.2 + ROOM[:, 1] / 1e3, 16.37 + ROOM[:, 0] / 1e3
LEVEL = np.round(-60 - 8 * ROOM[:, :2])
CELLS = ("101", "205")


def text(*heads_and_columns):
    heads, *columns = heads_and_columns
    return (
        "\n".join([heads, *(",".join(map(str, row)) for row in zip(*columns, strict=True))]) + "\n"
    )


def levels(reading):
    """Levels (places,) of each station by its name."""
    data, names = reading.data, reading.data.site.stations.name
    db = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    return {name: db[data.station == number].tolist() for number, name in enumerate(names)}


def assert_levels(reading, names=CELLS):
    expected = {n: pytest.approx(v.tolist(), abs=1e-3) for n, v in zip(names, LEVEL.T, strict=True)}
    assert levels(reading) == expected


def assert_channels(data, expected=CHANNELS):
    scaled = data.target[:, 0] * data.site.target_scale
    np.testing.assert_allclose(scaled, expected, rtol=2e-4, atol=2e-4 * np.abs(expected).max())


RECORDS = [
    {"lat": y, "lon": x, "pci": cell, "rsrp": level}
    for y, x, row in zip(LATITUDE, LONGITUDE, LEVEL, strict=True)
    for cell, level in zip(CELLS, row, strict=True)
]
HEARD = [
    [
        {
            "gateway_ids": {"gateway_id": n},
            "rssi": v,
            "location": {"latitude": at, "longitude": 16.4},
        }
        for n, v, at in zip(CELLS, row, (48.1, 48.3), strict=True)
    ]
    for row in LEVEL
]
UPLINKS = [
    {"uplink_message": {"decoded_payload": {"latitude": y, "longitude": x}, "rx_metadata": heard}}
    for y, x, heard in zip(LATITUDE, LONGITUDE, HEARD, strict=True)
]
POINTS = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [one["lon"], one["lat"]]},
            "properties": {"pci": one["pci"], "rsrp": one["rsrp"]},
        }
        for one in RECORDS
    ],
}
TRACK = (
    '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    + "".join(
        f'<trkpt lat="{one["lat"]}" '
        f'lon="{one["lon"]}"><ele>180</ele><extensions><rsrp>{one["rsrp"]}</rsrp>'
        f"<pci>{one['pci']}</pci></extensions></trkpt>"
        for one in RECORDS
    )
    + "</trkseg></trk></gpx>"
)
MARKS = (
    "<kml><Document>"
    + "".join(
        f'<Placemark><ExtendedData><Data name="RSRP"><value>{one["rsrp"]}</value></Data><Data '
        'name="PCI"><value>'
        f"{one['pci']}</value></Data></ExtendedData><Point><coordinates>{one['lon']},{one['lat']},0</coordinates>"
        "</Point></Placemark>"
        for one in RECORDS
    )
    + "</Document></kml>"
)
FILES = {
    "log.jsonl": "\n".join(map(json.dumps, RECORDS)),
    "log.json": json.dumps(RECORDS),
    "points.geojson": json.dumps(POINTS),
    "ttn.jsonl": "\n".join(map(json.dumps, UPLINKS)),
    "track.gpx": TRACK,
    "marks.kml": MARKS,
    **{
        f"{way}.json": pd.DataFrame(RECORDS).to_json(orient=way)
        for way in ("columns", "index", "split")
    },
    "drive.log": pd.DataFrame(RECORDS).to_csv(index=False),
}


@pytest.mark.parametrize("name", FILES)
def test_records_were_refused_without_a_word_of_tables(tmp_path, name):
    (tmp_path / name).write_text(FILES[name], encoding="utf-8")
    reading = read_any(tmp_path / name)
    assert_levels(reading)
    assert reading.data.site.georeference.latitude == pytest.approx(np.median(LATITUDE), abs=0.005)


WITHOUT = {
    "place.json": json.dumps([*RECORDS, {"pci": "1", "rsrp": -70}]),
    "place.geojson": json.dumps(
        {"features": [*POINTS["features"], {"geometry": None, "properties": {"pci": "1"}}]}
    ),
    "place.gpx": TRACK.replace(
        "</trkseg>", "<trkpt><extensions><rsrp>-70</rsrp></extensions></trkpt></trkseg>"
    ),
    "place.kml": MARKS.replace("</Document>", "<Placemark><name>a</name></Placemark></Document>"),
    "level.json": json.dumps([*RECORDS, {k: v for k, v in RECORDS[0].items() if k != "rsrp"}]),
}


@pytest.mark.parametrize("name", WITHOUT)
def test_a_record_without_its_place_or_level_was_a_traceback(tmp_path, name):
    (tmp_path / name).write_text(WITHOUT[name], encoding="utf-8")
    found = said(tmp_path / name)
    assert "no place; these 1 of" in found or ("1 of" in found and "values are missing" in found), (
        found
    )


BROKEN = {
    "a.geojson": ('{"features": []}', "no column of levels"),
    "b.json": ("{}", "no rows"),
    "c.jsonl": ("\n".join(map(json.dumps, RECORDS))[:-9], f"line {len(RECORDS)}, column"),
    "d.json": (
        json.dumps(
            [
                {k: v for k, v in one.items() if k != "pci"} | ({"pci": "7"} if i else {})
                for i, one in enumerate(RECORDS)
            ]
        ),
        "row 0: no station",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_records_were_a_traceback_or_another_line(tmp_path, name):
    content, says = BROKEN[name]
    (tmp_path / name).write_text(content)
    assert says in said(tmp_path / name)


def test_columns_of_json_as_pandas_writes_them_were_one_record(tmp_path):
    pd.DataFrame(RECORDS).to_json(tmp_path / "log.json")
    assert_levels(read_any(tmp_path / "log.json"))


def test_feather_and_gzip_were_unknown_endings(tmp_path, refused):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame(RECORDS)
    frame.to_feather(tmp_path / "log.feather")
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(frame.to_csv(index=False).encode()))
    (tmp_path / "bad.csv.gz").write_bytes(b"\x1f\x8b" + bytes(9))
    for name in ("log.feather", "log.csv.gz"):
        assert_levels(read_any(tmp_path / name))
    refused("damaged or not compressed by gzip", read_any, tmp_path / "bad.csv.gz")


@pytest.mark.parametrize(
    "start, way",
    [
        (b"\x93NUMPY", "savez it beside rx_position"),
        (b"! VNA\n# Hz S MA R 50\n", r"Touchstone"),
        (b"\x80\x05", "a pickle; write Parquet"),
        (b"PK\x03\x04", "save it as CSV"),
    ],
)
def test_files_that_no_reader_takes_show_the_way_out(tmp_path, start, way, refused):
    (tmp_path / "mine.dat").write_bytes(start + b"1 2 3")
    refused(way, parse_table, tmp_path / "mine.dat")


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.mat", "a.parquet", "a.csv"])
def test_a_pointer_of_git_was_a_damaged_file(tmp_path, name, refused):
    (tmp_path / name).write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    )
    refused("not the file but a Git LFS pointer to it; git lfs pull", read_any, tmp_path / name)


OTHERS = {
    "phones": ("timestamp,latitude,longitude,nrPci,ssRsrp", "dBm"),
    "German": ("Zeit,Breite,Länge,Standort,Pegel (dBm)", "dBm"),
    "RFID": ("Timestamp,Latitude,Longitude,Antenna_sensor,PeakRssiInCdbm", "dBm"),
    "radios": ("time,lat,lon,gateway,power_dbfs", "dB"),
    "G-NetTrack": ("CellID,Latitude,Longitude,CGI,Level (dBm)", "dBm"),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_heads_of_other_tools_were_refused(tmp_path, kind):
    heads, unit = OTHERS[kind]
    factor = 100 if "Cdbm" in heads else 1
    every = [(1, one["lat"], one["lon"], one["pci"], one["rsrp"] * factor) for one in RECORDS]
    path = tmp_path / "log.csv"
    path.write_text(text(heads, *zip(*every, strict=True)), encoding="utf-8")
    settings = {"columns": {"station": "Antenna_sensor"}} if kind == "RFID" else {}
    reading = read_any(path, **settings)
    assert_levels(reading)
    assert reading.data.site.level_unit == unit


def test_slots_of_tems_were_no_slots(tmp_path):
    heads = (
        "All-Latitude,All-Longitude,Serving Cell Identity,Serving Physical Cell ID,Serving Cell "
        "RSRP (dBm)"
    )
    heads += ",Neighbor Cell Physical Cell ID[1],Neighbor Cell RSRP (dBm)[1]"
    path = tmp_path / "tems.csv"
    same = [[name] * COUNT for name in ("9", *CELLS)]
    columns = (LATITUDE, LONGITUDE, same[0], same[1], LEVEL[:, 0], same[2], LEVEL[:, 1])
    path.write_text(text(heads, *columns))
    reading = read_any(path)
    assert_levels(reading)
    assert not any("Serving Cell Identity" in note and "tells" in note for note in reading.notes)


def test_networks_with_names_of_their_own_were_no_levels(tmp_path, refused):
    path = tmp_path / "survey.csv"
    path.write_text(
        text("X,Y,Office WiFi,printer,noise floor", *ROOM.T[:2], *LEVEL.T, [-96] * COUNT)
    )
    refused("hold values like levels, no head says so: which are", read_any, path)
    answer = {"rssi_db": ["Office WiFi", "printer"]}
    assert_levels(read_any(path, columns=answer), ("Office WiFi", "printer"))
    assert_levels(read_any(path, guess=True), ("Office WiFi", "printer"))


def test_rows_between_two_fixes_were_refused_one_by_one(tmp_path):
    empty = np.arange(COUNT) % 3 > 0
    places = [np.where(empty, "", np.char.mod("%.6f", v)) for v in (LATITUDE, LONGITUDE)]
    path = tmp_path / "qxdm.csv"
    path.write_text(text("GPS Lat,GPS Lon,RSRP", *places, LEVEL[:, 0]))
    assert len(read_any(path).data) == 20 and (
        "no place; these 40 of 60 rows are left out"
    ) in said(path)


def test_advice_on_columns_was_no_word_of_a_shell():
    """`dataset.columns.rssi_db=RSRP (LTE pcell)` is refused by the shell and by the settings."""
    assert say_column("rssi_db", "RSRP (x)") == "'dataset.columns.rssi_db=\"RSRP (x)\"'"
    assert say_column("rssi_db", "loss*-1") == "dataset.columns.rssi_db=loss*-1"


SETTINGS = {"tx_position": AT.tolist()}


def test_lists_and_complex_numbers_in_cells_were_no_channels(tmp_path):
    complexes = tmp_path / "matlab.csv"
    cells = [[f"{v.real:.9g}{v.imag:+.9g}i" for v in tone] for tone in CHANNELS.T]
    complexes.write_text(
        text("pos_1,pos_2,pos_3," + ",".join(f"h_{k}" for k in range(8)), *ROOM.T, *cells)
    )
    lists = tmp_path / "picoscenes.csv"
    parts = abs(CHANNELS), np.angle(CHANNELS)
    inside = [[f"[{' '.join(f'{v:.7f}' for v in row)}]" for row in part] for part in parts]
    lists.write_text(text("x,y,z,tones,mag,phase", *ROOM.T, [8] * COUNT, *inside))
    for path in (complexes, lists):
        reading = read_any(path, columns={"frequency_hz": "3.5e9:3.528e9"}, **SETTINGS)
        assert_channels(reading.data)
        np.testing.assert_allclose(reading.data.site.tones(), TONES)


def test_an_esp32_was_read_as_its_rssi_alone(tmp_path, refused):
    """64 pairs, imaginary before real, from the carrier up and then from below."""
    tones = np.fft.fftfreq(64, 1 / 64).round().astype(int)
    values = RNG.integers(-99, 99, (COUNT, 64, 2))
    data = ['"[' + ",".join(map(str, row.ravel())) + ']"' for row in values]
    path = tmp_path / "esp.csv"
    columns = ["CSI_DATA"] * COUNT, ["1a:00:00:00:00:00"] * COUNT, [-40] * COUNT, data, *ROOM.T
    path.write_text(text("type,mac,rssi,data,x,y,z", *columns))
    refused(r"dataset\.columns\.csi_re=csi_re_\*", read_any, path, **SETTINGS)
    ends = {"csi_re": "csi_re_*", "frequency_hz": "2.427e9:2.4466875e9"}
    data = read_any(path, columns=ends, **SETTINGS).data
    order = np.argsort(tones)
    assert_channels(data, (values[..., 1] + 1j * values[..., 0])[:, order])
    np.testing.assert_allclose(data.site.tones(), 2.437e9 + 312.5e3 * tones[order])


def test_a_row_for_each_tone_was_a_place_for_each(tmp_path):
    """As network analysers and notebooks write them:
    rows of a place were measurements of one tone.
    """
    rows = [
        (*place, f"{tone:.0f}", 20 * np.log10(abs(v)), np.degrees(np.angle(v)))
        for place, row in zip(ROOM, CHANNELS, strict=True)
        for tone, v in zip(TONES, row, strict=True)
    ]
    path = tmp_path / "vna.csv"
    path.write_text(text("x,y,z,freq_hz,s21_mag_db,s21_phase_deg", *zip(*rows, strict=True)))
    reading = read_any(path, **SETTINGS)
    assert_channels(reading.data)
    np.testing.assert_allclose(reading.data.site.tones(), TONES)


def test_tones_named_by_their_frequencies_were_no_tones(tmp_path):
    heads = "x_mm,y_mm,z_mm," + ",".join(
        f"S21_{p}_{f / 1e9:.3f}GHz" for f in TONES for p in ("re", "im")
    )
    path = tmp_path / "wide.csv"
    columns = [part for tone in CHANNELS.T for part in (tone.real, tone.imag)]
    path.write_text(text(heads, *(1e3 * ROOM.T), *columns))
    reading = read_any(path, **SETTINGS)
    assert_channels(reading.data)
    np.testing.assert_allclose(reading.data.site.tones(), TONES)


KNOWN = {"rx_position": ROOM, "tx_position": AT, "frequency_hz": TONES}
SHAPES = {
    "Sionna": {
        "rx_positions": ROOM,
        "tx_positions": AT[None],
        "frequencies": TONES,
        "h_freq": CHANNELS[:, None, None, None, None],
    },
    "DeepMIMO": {
        "location": ROOM,
        "tx_loc": AT,
        "channel": CHANNELS[:, None, None],
        "freqs": TONES,
    },
    "real and imaginary parts": {**KNOWN, "csi": np.stack([CHANNELS.real, CHANNELS.imag], 2)},
    "of networks": {**KNOWN, "H": np.stack([CHANNELS.real, CHANNELS.imag], 1)},
}


@pytest.mark.parametrize("kind", SHAPES)
def test_arrays_under_the_names_of_other_tools_were_unknown(kind):
    assert_channels(interpret(Raw(SHAPES[kind]), "file").data)


def test_one_tone_of_stations_in_degrees_lost_its_axis():
    """Channels (S, T, A, 1) became (S, T, A) where stations stand in degrees."""
    north, east = 59 + ROOM[:, 1] * 9e-6, 18 + ROOM[:, 0] * 1.7e-5
    places = {
        "latitude": north,
        "longitude": east,
        "rx_height": ROOM[:, 2],
        "station_height": [3.0, 3.0],
    }
    stations = {"station_latitude": [59.0, 59.0], "station_longitude": [18.0, 18.1]}
    array = {"array_position": np.eye(3)[:2] * 0.05, "frequency_hz": [3e9]}
    csi = np.broadcast_to(CHANNELS[:, :1, None, None], (len(CHANNELS), 2, 2, 1))
    arrays = {
        key: np.asarray(one) for key, one in {**places, **stations, **array, "csi": csi}.items()
    }
    assert interpret(Raw(arrays), "file").data.target.shape[1:] == (2, 1)


def test_a_file_without_a_known_array_was_refused_without_its_names(refused):
    raw = Raw({"tau": np.ones((9, 3)), "rx_pos": np.ones((9, 3)), "tx_pos": np.ones(3)})
    refused(r"found none of them among tau \(9, 3\)", interpret, raw, "file")


@pytest.mark.parametrize(
    "setting, changes",
    [
        ("feet", {"rx_position": ROOM / 0.3048, "tx_position": AT / 0.3048}),
        ("exchange_xy", {"rx_position": ROOM[:, [1, 0, 2]]}),
        ("downwards", {"rx_position": ROOM * [1, 1, -1]}),
    ],
)
def test_places_of_another_frame_were_good(tmp_path, setting, changes):
    """Feet were called delays that had been taken out; axes of one end alone were not noticed."""
    np.savez(tmp_path / "mine.npz", **{**KNOWN, "csi": CHANNELS, **changes})
    assert f"dataset.{setting}=true mends it" in said(tmp_path / "mine.npz")
    mended = read_any(tmp_path / "mine.npz", **{setting: True}).data
    np.testing.assert_allclose(mended.tx[0] - mended.rx_position[0], AT - ROOM[0], atol=1e-5)
    assert "mends it" not in said(tmp_path / "mine.npz", **{setting: True})
