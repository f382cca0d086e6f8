"""Cells of a campus: pixels of a box, phones, and what is no such table."""

import numpy as np
import pytest
from mirrors import mirrored, offer
from releases import real

from gsparc.base.errors import DataError
from gsparc.data.georeference import Georeference
from gsparc.datasets.cbrs import CORNERS, HEADS, read_cbrs
from gsparc.datasets.load import load
from gsparc.datasets.public.fetch import fetch, public_sets

# Two readings of one pixel and one beyond the box, east and north of its corner [m]
ROWS = [("A", 1, -1, "Pixel", -80), ("A", 3, -3, "Pixel", -90), ("A", 600, -9, "Pixel", -60)]
ROWS += [("C", 41, -41, "Samsung", -100), ("C", 511, -511, "Pixel", -101)]


def table(rows=ROWS, heads=HEADS):
    east, north = np.array([row[1:3] for row in rows], float).T
    degrees = Georeference(*CORNERS[0]).to_degrees(np.c_[east, north])
    lines = [",".join(heads)]
    for row, latitude, longitude in zip(rows, *degrees, strict=True):
        lines.append(f"{row[0]},{latitude:.9f},{longitude:.9f},{row[3]},{row[4]}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def file(tmp_path):
    (tmp_path / "cbrs.csv").write_text(table())
    return tmp_path / "cbrs.csv"


def test_pixels_are_means_of_milliwatts_in_the_published_box(file):
    arrays = read_cbrs(file).arrays
    assert arrays["station_name"].tolist() == ["A", "C"] and len(arrays["rssi_db"]) == 3
    first = arrays["station"] == 0
    assert arrays["rssi_db"][first] == pytest.approx([10 * np.log10((1e-8 + 1e-9) / 2)])
    assert arrays["device"].tolist() == ["Pixel", "Samsung", "Pixel"]
    degrees = arrays["latitude"], arrays["longitude"]
    middles = Georeference(*CORNERS[0]).from_degrees(*degrees)
    assert np.allclose(middles, [[2, -2], [42, -42], [510, -510]], atol=1e-3)
    assert arrays["carrier_hz"].tolist() == [3.69e9, 3.58e9]
    logged = read_cbrs(file, phone="Pixel", pixel_m=None).arrays
    assert len(logged["rssi_db"]) == 4 and "device" not in logged


def test_a_table_of_something_else_is_refused(file, tmp_path, refused):
    refused("no row of dataset.phone=Nokia; say Pixel or Samsung", read_cbrs, file, "Nokia")
    other = tmp_path / "other.csv"
    other.write_text(table([("G", *ROWS[0][1:])]))
    refused("PCI: 'G' is none of A, B", read_cbrs, other)
    other.write_text(table(heads=("cell", *HEADS[1:4], "rssi")))
    refused("line 1: no column PCI and rsrp", read_cbrs, other)


def test_the_set_is_fetched_and_is_then_the_default(monkeypatch, tmp_path):
    listed = public_sets()["cbrs"]
    (source,) = listed.sources
    assert listed.licence == "Apache-2.0" and len(source.revision) == 40
    with mirrored(monkeypatch) as mirror:
        served = mirror.serve(source.path, table().encode())
        facts = {"dataset": "cbrs", "strip": listed.strip, "opens": listed.opens}
        offer(monkeypatch, tmp_path, served, **facts)
        with pytest.raises(DataError, match="get it with `gsparc data room`"):
            load({"name": "cbrs"})
        fetch("room")
        assert len(load({"name": "cbrs"})) == 3


def test_pixels_of_four_measured_cells():
    file = str(real("cbrs/mast1.csv"))
    counts = [
        len(load({"name": "cbrs", "file": file, "stations": [cell], "phone": "Samsung"}))
        for cell in "ABCD"
    ]
    assert counts == [548, 234, 591, 639], counts
