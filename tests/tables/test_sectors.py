"""Lists of sites with their sectors, and slots of scanners."""

import csv
import re

import numpy as np
import pytest
from networks import network

from gsparc.base.errors import Caution, DataError
from gsparc.datasets.own import read_any
from gsparc.tables.sectors import band_hz, earfcn_hz


def write(path, heads, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([heads, *rows])
    return path


def drive_of(folder, count=4, moments=120):
    """Rows that name their cells by PCI and EARFCN, PCIs used twice; and a list of sites."""
    one = network(0)
    listed = one.listed(count)[:moments]
    rows = [
        [*one.moment[m, :2].round(2), c % 15, 1300 if c < 15 else 6300, one.measured[m, c].round(1)]
        for m, c in zip(*np.nonzero(listed), strict=True)
    ]
    sites = [
        [
            f"S{c // 3}",
            f"S{c // 3}_{c % 3}",
            c % 15,
            1300 if c < 15 else 6300,
            *place.round(1),
            azimuth,
            2,
            tilt - 2,
            65,
            43,
            "N",
        ]
        for c, (place, azimuth, tilt) in enumerate(
            zip(one.place, one.azimuth, one.tilt, strict=True)
        )
    ]
    heads = [
        "Site",
        "Cell Name",
        "PCI",
        "DL EARFCN",
        "x",
        "y",
        "Antenna Height [m]",
        "Azimuth",
        "M-Tilt",
        "E-Tilt",
        "HBW",
        "Tx Power [dBm]",
        "Vendor",
    ]
    drive = write(folder / "drive.csv", ["x", "y", "PCI", "EARFCN", "RSRP [dBm]"], rows)
    return one, drive, heads, sites


def test_a_list_of_sites_is_read_whole(tmp_path):
    """Azimuth, tilt and band were read nowhere, and nothing said so."""
    one, drive, heads, sites = drive_of(tmp_path)
    reading = read_any(drive, stations_file=write(tmp_path / "sites.csv", heads, sites))
    stations = reading.data.site.stations
    number = [
        int(pci) + 15 * (channel == "6300")
        for pci, channel in (name.split() for name in stations.name)
    ]
    np.testing.assert_allclose(stations.sector[:, 0], one.azimuth[number])
    np.testing.assert_allclose(stations.sector[:, 1], one.tilt[number])
    np.testing.assert_allclose(
        stations.position + reading.data.site.origin, one.place[number], atol=0.06
    )
    assert set(stations.carrier_hz) == {1815e6, 806e6} and set(stations.sector[:, 4]) == {43}
    assert stations.sector[:, 5].tolist() == [i // 3 for i in number]
    assert list(stations.label) == [f"S{i // 3}_{i % 3}" for i in number]
    unread = [note for note in reading.notes if "not read: column 'Vendor'" in note]
    assert len(unread) == 1 and isinstance(unread[0], Caution)
    assert not any("Height" in note and "not used" in note for note in reading.notes)
    matched = [note for note in reading.notes if "stations are matched by" in note]
    assert len(matched) == 1 and matched[0].endswith("sites by 'Site'"), matched
    assert "'Cell Name'" in matched[0] and "'PCI+DL EARFCN'" in matched[0]


def test_a_cell_number_that_two_listed_stations_share_is_named(tmp_path, refused):
    """Every cell of the drive was said to be in no list."""
    rng, cells = np.random.default_rng(0), [["A", 7, 0, 0], ["B", 8, 90, 0], ["C", 7, 9e4, 0]]
    rows = [[*rng.uniform(0, 90, 2).round(1), 7 + i % 2, -70 - i % 9] for i in range(40)]
    drive = write(tmp_path / "drive.csv", ["x", "y", "PCI", "RSRP [dBm]"], rows)
    listed = write(tmp_path / "sites.csv", ["name", "PCI", "x", "y"], cells)
    refused(
        r"PCI 7 names A, C of the list of stations; leave only",
        read_any,
        drive,
        stations_file=listed,
    )


def test_cells_that_a_list_lacks_are_counted(tmp_path):
    _, drive, heads, sites = drive_of(tmp_path)
    seen = {(row[2], row[3]) for row in csv.reader(drive.open())}
    lost = next(i for i, site in enumerate(sites) if (str(site[2]), str(site[3])) in seen)
    reading = read_any(
        drive, stations_file=write(tmp_path / "sites.csv", heads, sites[:lost] + sites[lost + 1 :])
    )
    assert any(
        note.startswith("1 of ") and "not in the list, with" in note for note in reading.notes
    )
    assert np.isnan(reading.data.site.stations.position).any(axis=1).sum() == 1


def test_channels_and_bands():
    found = earfcn_hz(np.array([100.0, 1300, 6300, 38000, np.nan]))
    np.testing.assert_allclose(found[:4], [2120e6, 1815e6, 806e6, 2595e6])
    assert np.isnan(found[4])
    np.testing.assert_allclose(
        band_hz(np.array([3.0, 20, 1800, 3500])), [1805e6, 791e6, 1800e6, 3500e6]
    )
    # Bands by the thousand were believed
    assert np.isnan(band_hz(np.array([3000.0, 20e3, 0.003]))).all()


def test_channels_by_the_thousand_were_carriers_of_13_ghz():
    """1,300,000 is a channel number between the bands of NR."""
    assert np.isnan(earfcn_hz(np.array([1300e3, 900e3, 81e3 + 500]))).all()
    np.testing.assert_allclose(earfcn_hz(np.array([2079167.0])), [28e9], rtol=1e-3)


def test_slots_of_neighbours_become_rows(tmp_path):
    """`Serving` and `N1` were taken for stations."""
    one = network(0)
    order = np.argsort(-one.measured, 1)[:100, :3]
    heads = [
        "x",
        "y",
        "Serving PCI",
        "Serving RSRP [dBm]",
        "N1 PCI",
        "N1 RSRP [dBm]",
        "N2 PCI",
        "N2 RSRP [dBm]",
    ]
    rows = [
        [*place[:2].round(2), *(v for c in cells for v in (c + 10, level[c].round(1)))]
        for place, cells, level in zip(one.moment, order, one.measured, strict=False)
    ]
    rows[3][6:8] = ["", ""]
    reading = read_any(write(tmp_path / "drive.csv", heads, rows))
    data = reading.data
    assert set(data.site.stations.name) == {str(c + 10) for c in np.unique(order)} | set()
    assert (data.censored == 0).sum() == 299 and ("299 rows of 100 moments") in " ".join(
        reading.notes
    )


@pytest.mark.parametrize("form", ["{}", "PCI {}", "{}_RSRP", "RSRP {} [dBm]"])
def test_heads_that_hold_a_number_of_the_list_name_its_cells(tmp_path, form):
    """Of heads 101, PCI 101 and 101_RSRP there was no column of levels, or a line for each cell."""
    one, _, heads, sites = drive_of(tmp_path)
    count, moments = 15, slice(60)
    rows = np.hstack([one.moment[moments, :2].round(2), one.measured[moments, :count].round(1)])
    drive = write(
        tmp_path / "wide.csv", ["x", "y", *(form.format(100 + c) for c in range(count))], rows
    )
    listed = write(tmp_path / "s.csv", heads, [[*s[:2], 100 + s[2], *s[3:]] for s in sites[:count]])
    stations = read_any(drive, stations_file=listed).data.site.stations
    assert (
        stations.name == tuple(str(100 + c) for c in range(count)) and stations.label[4] == "S1_1"
    )
    wrong = write(tmp_path / "w.csv", ["x", "y", *(f"AP{c}" for c in range(count))], rows)
    with pytest.raises(DataError) as refused:
        read_any(wrong, stations_file=listed)
    assert len(refused.value.problems) == 1 and ("and 10 more: no listed station") in str(
        refused.value
    )


def test_levels_without_the_suffix_of_the_others_are_named(tmp_path):
    """Of a release the fixed stations, without _rss, were `and 27 more` of what is not used."""
    one = network(0)
    rows = np.hstack(
        [one.moment[:60, :2].round(2), one.measured[:60, :5].round(1), np.full((60, 1), -1)]
    )
    drive = write(
        tmp_path / "a.csv", ["x", "y", "a_rss", "b_rss", "c", "d", "noise", "z_rate"], rows
    )
    notes = [note for note in read_any(drive).notes if isinstance(note, Caution)]
    said = "columns 'c' and 'd' hold values like these levels and are not used: of stations, too?"
    assert any(note.startswith(said) for note in notes), notes


def test_stations_without_heights_stood_at_0_m_with_no_warning(tmp_path):
    """The note was one of a dozen."""
    _, drive, heads, sites = drive_of(tmp_path)
    flat = heads.index("Antenna Height [m]")
    heads, sites = heads[:flat] + heads[flat + 1 :], [row[:flat] + row[flat + 1 :] for row in sites]
    reading = read_any(drive, stations_file=write(tmp_path / "sites.csv", heads, sites))
    said = next(note for note in reading.notes if "no height of the stations: taken as 0 m" in note)
    assert isinstance(said, Caution)


def read_list(folder, **columns):
    """Stations of a list with further columns, and all notes."""
    _, drive, heads, sites = drive_of(folder)
    names = [*heads[:6], *columns]
    rows = [
        [*row[:6], *(values[i % len(values)] for values in columns.values())]
        for i, row in enumerate(sites)
    ]
    reading = read_any(drive, stations_file=write(folder / "sites.csv", names, rows))
    return reading.data.site, " ".join(reading.notes)


def test_unknown_azimuths_and_widths_are_no_numbers(tmp_path):
    """An azimuth of -1 was 359 degrees, a width of 0 no positive definite covariance."""
    site, notes = read_list(tmp_path, Azimuth=[-1, 30, 120], HBW=[0, 65, 65], Tilt=[-2, -4, -6])
    sector = site.stations.sector
    assert np.isnan(sector[:, 0]).any() and np.isnan(sector[:, 2]).any()
    assert "-1 unknown" in notes and "0 unknown" in notes and (sector[:, 1] > 0).all()
    assert "'Tilt' are all below 0: read as below the horizon" in notes


def test_frequencies_in_kilohertz_and_channels_of_nr(tmp_path):
    """1842500 was 1.8 MHz, 632628 was 57 GHz."""
    site, notes = read_list(tmp_path, Frequency=[1842500])
    assert site.carrier_hz == 1842.5e6 and "carrier_hz in kHz" in notes
    np.testing.assert_allclose(earfcn_hz(np.array([632628.0, 422000.0])), [3489.42e6, 2110e6])


def change(folder, head, values, every=True):
    """All cautions of a list in which the cells of a column are values,
    or only the fourth is one.
    """
    _, drive, heads, sites = drive_of(folder, moments=30)
    column = [name.partition(" [")[0] for name in heads].index(head.partition(" [")[0])
    heads[column] = head
    for i, site in enumerate(sites):
        site[column] = values(site[column]) if every or i == 3 else site[column]
    try:
        notes = read_any(drive, stations_file=write(folder / "sites.csv", heads, sites)).notes
    except DataError as refused:
        return [str(refused)]
    return [note for note in notes if isinstance(note, Caution) and "'Vendor'" not in note]


@pytest.mark.parametrize(
    ("head", "values", "says"),
    [
        (
            "Tx Power [dBm]",
            lambda v: 20,
            r"holds 20 in line 5; .* in another unit",
        ),
        ("Tx Power", lambda v: 43000, r"holds 43000 in line 5; .*mW"),
        ("HBW", lambda v: 1.1345, r"holds 1.1345 in line 5; .*rad"),
        ("HBW [deg]", lambda v: 0.065, r"holds 0.065 in line 5"),
        ("M-Tilt", lambda v: -v, r"holds -2 in line 5; .* of 0 to 30"),
        ("E-Tilt", lambda v: 10 * v + 40, r"holds \d+ in line 5; .* of 0 to 30"),
        ("Antenna Height [m]", lambda v: -25, r"holds -25 in line 5; "),
    ],
)
def test_a_single_value_in_another_unit_was_believed(tmp_path, head, values, says):
    said, *_ = change(tmp_path, head, values, every=False)
    assert re.search(says, said), said
    assert not change(tmp_path, head, lambda v: v)


def test_the_unit_of_a_cell_that_a_warning_advises_is_read(tmp_path):
    """20 W among dBm were 20 dBm; what is no unit of powers was cut off in silence."""
    assert not change(tmp_path, "Tx Power [dBm]", lambda v: "20 W", every=False)
    assert not change(tmp_path, "Tx Power [W]", lambda v: "43 dBm")
    (said,) = change(tmp_path, "Tx Power [dBm]", lambda v: "20 parsecs", every=False)
    assert "'20 parsecs' in line 5: no station_power_db; unknown" in said
