"""Tables of measurements: what is understood, what is said, and spoilt ones with one line each."""
# ruff: noqa: E501 (a case is a row of a table)

import sys

import numpy as np
import pytest

from gsparc.base.errors import Caution, DataError
from gsparc.tables.heads import parse_head
from gsparc.tables.own import interpret
from gsparc.tables.query_places import read_query_places
from gsparc.tables.read import parse_table

PLAIN = "x,y,z,rssi\n1,2,3,-80\n4,5,6,-81.5\n"
STATIONS = "name,x,y,z\na,1,2,3\nb,2,3,4\n"


@pytest.mark.parametrize(
    "head, role, unit",
    [
        ("RSRP [dBm]", "rssi_db", "dBm"),
        ("Rx Power (dBm)", "rssi_db", "dBm"),
        ("power_dbm", "rssi_db", "dBm"),
        ("rss", "rssi_db", None),
        ("power [mW]", "rssi", "mW"),
        ("lat", "latitude", None),
        ("latitude_deg", "latitude", "deg"),
        ("GPS Longitude", "longitude", None),
        ("lng", "longitude", None),
        ("x_m", "x", "m"),
        ("x/mm", "x", "mm"),
        ("rx_x", "rx_x", None),
        ("txZ", "tx_z", None),
        ("rx pos y [cm]", "rx_y", "cm"),
        ("height", "z", None),
        ("alt", "z", None),
        ("gateway_height_m", "station_z", "m"),
        ("bs_lat", "station_latitude", None),
        ("station", "station", None),
        ("Cell ID", "station", None),
        ("pci", "station", None),
        ("frequency_mhz", "carrier_hz", "MHz"),
        ("h_re_0", "csi_re", None),
        ("csi_im", "csi_im", None),
        ("run", "run", None),
        ("time", None, None),
        ("tx_power_dbm", None, None),
        ("noise_power", None, None),
        ("", None, None),
    ],
)
def test_usual_heads(head, role, unit):
    found = parse_head(head)
    assert found.role == role and (unit is None or found.unit.name == unit)


@pytest.mark.parametrize(
    "content, name",
    [
        (PLAIN, "plain.csv"),
        (PLAIN.replace("\n", "\r"), "old.csv"),
        (PLAIN.replace(",", "\t"), "tabs.tsv"),
        (PLAIN.replace(",", ";"), "semicolons.csv"),
        (PLAIN.replace(",", "  "), "spaces.txt"),
        ("# " + PLAIN, "savetxt.csv"),
        ("# by hand\n\n" + PLAIN + "\n,,,\n% end\n", "comments.csv"),
        ("sep=;\n" + PLAIN.replace(",", ";"), "excel.csv"),
        (PLAIN.replace("-80", '"-80"').replace("x,", '"x",'), "quotes.csv"),
        (PLAIN.replace("x,y", "X [m], Y [m]").replace("rssi", " RSSI (dBm) "), "units.csv"),
        (
            PLAIN.replace("z,rssi", "z,rssi,note")
            .replace("-80", "-80,caf\xe9")
            .replace("81.5", "81.5,")
            .encode("cp1252"),
            "latin.csv",
        ),
    ],
)
def test_the_same_table_in_other_forms(write, content, name):
    arrays = parse_table(write(content, name)).arrays
    np.testing.assert_array_equal(arrays["rx_position"], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(arrays["rssi_db"], [-80, -81.5])
    assert name != "plain.csv" or arrays["row_name"].tolist() == ["line 2", "line 3"]


def test_units_are_converted_and_said(write):
    text = (
        "x [mm],y [cm],z_km,power [mW],frequency "
        "(MHz)\n1000,200,0.003,1e-6,2400\n2000,300,0.004,2e-6,2400\n"
    )
    table = parse_table(write(text))
    arrays = table.arrays
    np.testing.assert_allclose(arrays["rx_position"], [[1, 2, 3], [2, 3, 4]])
    np.testing.assert_allclose(arrays["rssi"], [1e-9, 2e-9])
    assert arrays["carrier_hz"] == 2.4e9 and arrays["carrier_hz"].shape == ()
    said = " ".join(table.notes)
    assert "column 'x [mm]' taken as x [m], mm turned into m" in said
    assert "column 'power [mW]' taken as rssi [W], mW turned into W" in said
    assert "MHz turned into Hz" in said and "taken as the receiver's" in said


def test_a_column_of_times_was_listed_as_not_used_without_a_word(write):
    notes = parse_table(write("x,y,rssi,day\n1,2,-80,Mon\n4,5,-81,Tue\n")).notes
    said = next(note for note in notes if "'day'" in note)
    assert "rows count in the order of the file" in said and "dataset.columns.run=COLUMN" in said


SECONDS, DAY = 45296.5, 1793836800.0  # of 12:34:56.5, and of 5 November 2026


@pytest.mark.parametrize(
    "head, first, second, seconds, what",
    [
        ("Time", "12:34:56.500", "12:34:57", SECONDS, "clock times of a day that is not named"),
        ("Time", "12:34:56:500", "00:00:01:000", SECONDS, "clock times"),
        ("UTC time", "2026-11-05T12:34:56.5Z", "2026-11-05T12:34:57Z", DAY + SECONDS, "dates"),
        ("Timestamp", "2026-11-05 13:34:56.5+01:00", "", DAY + SECONDS, "dates"),
        ("Timestamp", "05/11/2026 12:34:56.5", "13/11/2026 12:34:57", DAY + SECONDS, "dates"),
        ("DateTime", "05.11.2026 12:34:56.5", "06.11.2026 12:34:56", DAY + SECONDS, "dates"),
        (
            "Timestamp",
            "05/11/2026 12:34:56.5",
            "06/11/2026 12:34:57",
            DAY + SECONDS,
            "dates, day before month?",
        ),
        ("Time", "11/5/2026 12:34:56 PM", "11/5/2026 1:34:56 PM", DAY + SECONDS - 0.5, "dates"),
        ("epoch", "1793882096.5", "1793882097", DAY + SECONDS, "since 1970, in units of 1 s"),
        (
            "timestamp",
            "1793882096500",
            "1793882096700",
            DAY + SECONDS,
            "since 1970, in units of 0.001 s",
        ),
        ("time_ms", "500", "700", 0.5, "milliseconds"),
        ("time_s", "0.5", "0.2", 0.5, "seconds, not in order of time"),
    ],
)
def test_times_are_read_as_drive_tests_write_them(write, head, first, second, seconds, what):
    table = parse_table(write(f"x,y,rssi,{head}\n1,2,-80,{first}\n4,5,-81,{second}\n"))
    assert table.arrays["time_s"][0] == pytest.approx(seconds, abs=1e-3)
    assert any(note.startswith(f"column '{head}' taken as time_s: {what}") for note in table.notes)


def test_midnight_passes_and_a_date_stands_beside_its_clock(write, refused):
    clock = parse_table(write("x,y,rssi,time\n1,2,-80,23:59:59\n4,5,-81,00:00:01\n"))
    assert np.diff(clock.arrays["time_s"]) == 2
    rows = "25/11/2026,1,2,-80,12:34:57\n25/11/2026,4,5,-81,12:34:56\n26/11/2026,4,6,-82,12:34:56\n"
    both = parse_table(write(f"Date,x,y,rssi,Time\n{rows}"))
    assert "columns 'Date' and 'Time' taken as time_s: dates, not in order of time" in both.notes
    assert interpret(both, "drive").data.sequence.tolist() == [1, 0, 2]
    refused("holds no times", parse_table, write("x,y,rssi,day\n1,2,-80,Mon\n"), {"time_s": "day"})


def test_columns_of_levels_in_db_did_not_say_how_dbm_are_asked_for(write):
    notes = parse_table(write("x,y,AP1,AP2\n1,2,-80,-70\n4,5,-81,-71\n")).notes
    assert any(
        "taken as rssi_db [dB] of the stations" in n and n.endswith("(dBm? set unit=dBm)")
        for n in notes
    )


def test_levels_without_a_unit_were_said_to_be_in_dbm(write):
    """A map of the same levels said dB."""
    table = parse_table(write("x,y,z,RSSI\n1,2,3,-80\n4,5,6,-81\n"))
    assert "column 'RSSI' taken as rssi_db [dB]" in table.notes
    assert interpret(table, "table").data.site.level_unit == "dB"


def test_rsrp_was_in_db_where_its_head_named_no_unit(write):
    """3GPP TS 36.214 defines it in dBm; the measurements, and so their hash, are the same."""
    tables = [
        parse_table(write(f"x,y,z,{head}\n1,2,3,-80\n4,5,6,-81\n")) for head in ("RSRP_1", "RSSI")
    ]
    assert any("taken as rssi_db [dBm]" in note for note in tables[0].notes)
    rsrp, rssi = (interpret(table, "table").data.site for table in tables)
    assert rsrp.level_unit == "dBm" and rsrp.sha256 == rssi.sha256


SUMS = {
    "rssi": [-60, -61],
    "rssi-tx-power": [-62, -64],
    "rssi-tx-power*0.5+snr": [-54, -54.5],
    "rssi*2-113": [-233, -235],
}


@pytest.mark.parametrize("text", SUMS)
def test_levels_were_one_column_times_a_number(write, text):
    """An exact head is taken before a sum: heads may hold a plus or a minus."""
    path = write("x,y,rssi,tx-power,snr\n1,2,-60,2,7\n2,1,-61,3,8\n")
    assert parse_table(path, {"rssi_db": text}).arrays["rssi_db"].tolist() == SUMS[text]


def test_source_and_destination_were_no_ends_and_tags_had_no_place(write):
    links = parse_table(
        write("src_x,src_y,dst_x,dst_y,rssi_dbm\n1,2,3,4,-50\n5,6,7,8,-60\n")
    ).arrays
    assert links["tx_position"].tolist() == [[1, 2], [5, 6]]
    assert links["rx_position"].tolist() == [[3, 4], [7, 8]]
    tags = parse_table(write("tag_x,tag_y,rssi_dbm\n1,2,-50\n5,6,-60\n")).arrays
    assert tags["rx_position"].tolist() == [[1, 2], [5, 6]]


def test_what_is_said_wins_over_guesses(write, refused):
    text = "lat,lon,px,py,RSRP,RSSI\n40,8,1,2,-80,-60\n40,9,3,4,-81,-61\n"
    said = {
        "rssi_db": "rsrp",
        "tx_x": "px",
        "tx_y": "py",
        "tx_z": 1.5,
        "rx_x": 0,
        "rx_y": 0,
        "rx_z": 2,
    }
    # lat and lon are of an end without a name, which is a third one: it must be said to be none
    refused("expected two ends", parse_table, write(text), said)
    arrays = parse_table(write(text.replace("lat,lon", "a,b")), said).arrays
    np.testing.assert_array_equal(arrays["rssi_db"], [-80, -81])
    np.testing.assert_array_equal(arrays["tx_position"], [[1, 2, 1.5], [3, 4, 1.5]])
    np.testing.assert_array_equal(arrays["rx_position"], [0, 0, 2])
    degrees = parse_table(
        write(text), {"lat": "lat", "lon": "lon", "rssi_db": "RSSI", "height": 1.5}
    ).arrays
    assert degrees["latitude"].tolist() == [40, 40] and degrees["rx_height"] == 1.5


def test_a_column_that_another_file_lacks_was_refused_without_how_to_leave_it_out(write, refused):
    """`evaluate` of a model that was trained with dataset.columns.sensitivity_db=sens."""
    refused(
        "no such column; .*; or say dataset.columns.sensitivity_db=null",
        parse_table,
        write(PLAIN),
        {"sensitivity_db": "sens"},
    )


def test_long_layout_with_a_second_file(write, caplog):
    listed = "Name;lat;lon;height [m];sensitivity_db;frequency [MHz]\n33;40,1;8,1;10;-120;800\n"
    listed += "212;40,2;8,2;20;-110;1800\n5;41;8;3;-110;800\n"
    stations = write(listed, "stations.csv")
    table = parse_table(write("lat,lon,rssi,pci\n40,8,-80,212\n40,8,-90,33\n"), {}, stations)
    arrays = table.arrays
    assert arrays["station_name"].tolist() == ["33", "212", "5"] and arrays["station"].tolist() == [
        1,
        0,
    ]
    np.testing.assert_array_equal(arrays["station_latitude"], [40.1, 40.2, 41])
    np.testing.assert_array_equal(arrays["station_height"], [10, 20, 3])
    np.testing.assert_array_equal(arrays["sensitivity_db"], [-120, -110, -110])
    np.testing.assert_array_equal(arrays["carrier_hz"], [8e8, 1.8e9, 8e8])
    assert "stations of the list, heard in no row, and kept: 5" in table.notes


def test_names_that_a_join_wrote_as_floats_were_other_stations(write):
    """Drives joined with a list: 379.0 stood beside 379, two stations for one."""
    stations = write("pci,x,y,z\n379.0,0,0,9\n12.0,9,9,9\n", "stations.csv")
    drive = write("x,y,rssi,pci\n1,1,-80,379\n1,2,-81,379.0\n2,1,-90,12.0\n")
    arrays = parse_table(drive, {}, stations).arrays
    assert arrays["station_name"].tolist() == ["379", "12"] and arrays["station"].tolist() == [
        0,
        0,
        1,
    ]


def test_stations_that_a_column_parts_stand_where_the_list_has_the_whole(write):
    stations = write("pci,x,y,z\n7,1,2,3\n8,4,5,6\n", "stations.csv")
    drive = write("x,y,rssi,pci,beam\n1,1,-80,7,a\n1,2,-81,8,a\n2,1,-90,7,b\n")
    arrays = parse_table(drive, {"station": "pci+beam"}, stations).arrays
    assert arrays["station_name"].tolist() == ["7 a", "7 b", "8 a"]
    assert arrays["station_position"].tolist() == [[1, 2, 3], [1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    "heads, columns",
    [
        ("rssi_b,rssi_a", {}),
        ("b,a", {}),
        ("level of b (s),level of a (s)", {"rssi_db": "level of * (s)"}),
        ("b dBm,a dBm", {"rssi_db": "* dBm"}),
    ],
)
def test_wide_layout(write, heads, columns):
    text = f"x,y,z,{heads}\n1,2,3,-80,-90\n4,5,6,,-91\n"
    arrays = parse_table(write(text), columns, write(STATIONS, "stations.csv")).arrays
    assert arrays["station_name"].tolist() == ["b", "a"] and "station" not in arrays
    np.testing.assert_array_equal(arrays["rssi_db"], [[-80, -90], [np.nan, -91]])
    np.testing.assert_array_equal(arrays["station_position"], [[2, 3, 4], [1, 2, 3]])


@pytest.mark.parametrize("style", ["{}", "rssi_{}", "RSRP {} [dBm]"])
@pytest.mark.parametrize(
    ("mark", "above"), [(";", "# by hand, on a Monday, north of here\n"), (",", "% a; b\n")]
)
def test_names_of_wide_tables_lost_signs_and_comments_decided_separators(
    write, refused, style, mark, above
):
    """Columns of misspelt stations were left out without a word, and quotes stayed in names."""
    heads = [style.format(name) for name in ("#2", "-1")]
    heads = [f'"{head}"' if head[0] == "#" else head for head in heads]
    rows = (["x", "y", *heads], ["1", "2", "-80", "-90"], ["4", "5", "-81", "-91"])
    table = above + "".join(mark.join(row) + "\n" for row in rows)
    arrays = parse_table(
        write(table), {}, write('name,x,y\n-1,5,6\n"#2",7,8\n', "stations.csv")
    ).arrays
    assert arrays["station_name"].tolist() == ["#2", "-1"]
    assert arrays["rssi_db"].tolist() == [[-80, -90], [-81, -91]]
    assert arrays["station_position"].tolist() == [[7, 8], [5, 6]]
    misspelt = write('name,x,y\n-1b,5,6\n"#2",7,8\n', "stations.csv")
    refused(
        "no column says which station|could each be rssi_db",
        parse_table,
        write(table),
        {},
        misspelt,
    )


def test_channels(write):
    text = "tx_x,tx_y,tx_z,h_re_0,h_im_0,h_re_1,h_im_1\n1,2,3,1,2,3,4\n2,2,3,5,6,,\n"
    said = {"rx_x": 0, "rx_y": 0, "rx_z": 0, "frequency_hz": "2.4e9:2.5e9"}
    arrays = parse_table(write(text), said).arrays
    assert arrays["csi"][0].tolist() == [1 + 2j, 3 + 4j] and arrays["frequency_hz"].tolist() == [
        2.4e9,
        2.5e9,
    ]
    assert arrays["mask"].tolist() == [[True, True], [True, False]]
    one = "x,y,z,tx_x,tx_y,tx_z,real,imag,frequency_ghz\n1,2,3,0,0,0,1,2,2.4\n2,2,3,0,0,0,5,6,2.4\n"
    raw = parse_table(write(one))
    assert raw.arrays["frequency_hz"] == 2.4e9 and raw.arrays["csi"].shape == (2,)
    assert interpret(raw, "drive.csv").data.site.kind == "csi"


ENDS = {"rx_x": 0, "rx_y": 0, "rx_z": 0, "frequency_hz": "1e9:5e9"}


def test_negative_numbers_of_tones_lost_their_sign(write, refused):
    """csi_re_-2 and csi_re_2 were one tone: 2 of 4 loaded, or in the order 1, 2, -1, -2."""
    heads = [f"csi_{part}_{tone}" for tone in (1, -2, 2, -1) for part in ("re", "im")]
    text = ",".join(["x,y,z", *heads]) + "\n1,2,3,1,0,-2,0,2,0,-1,0\n4,5,6,1,9,-2,8,2,7,-1,6\n"
    for said in ({}, {"csi_re": "csi_re_*", "csi_im": "csi_im_*"}):
        table = parse_table(write(text), {**ENDS, **said})
        assert table.arrays["csi"].real.tolist() == [[-2, -1, 1, 2]] * 2
        assert table.arrays["csi"][1].imag.tolist() == [8, 6, 9, 7]
        assert table.arrays["frequency_hz"].tolist() == [1e9, 2e9, 4e9, 5e9]
        assert any("spaced as the numbers of the tones" in note for note in table.notes)
    for head, says in (
        ("csi_re_02", "'csi_re_02': the same tone as 'csi_re_2'"),
        ("csi_re-1", "'csi_re-1': .* is no number of a tone"),
        ("csi_re_m1", "'csi_re_m1': .* is no number of a tone"),
        ("csi_re_0_1", "'csi_re_0_1': .* is no number of a tone"),
    ):
        refused(says, parse_table, write(text.replace("csi_re_-1", head)), ENDS)


def test_two_ends_in_degrees_become_stations(write):
    text = (
        "rx_lat,rx_lon,tx_lat,tx_lon,rsrp\n40,8,40.1,8,-80\n40,8.1,40.1,8,-80\n40,8.2,40.3,8,-80\n"
    )
    arrays = parse_table(write(text + "40,8.3,40.3,8,-80\n")).arrays
    assert arrays["station_latitude"].tolist() == [40.1, 40.3] and arrays["station"].tolist() == [
        0,
        0,
        1,
        1,
    ]
    assert arrays["longitude"].tolist() == [8, 8.1, 8.2, 8.3]


def test_line_breaks_in_quoted_cells_were_refused(write):
    heads = '"Latitude\n(deg)",lon,"RSRP\r\n[dBm]",note'
    table = parse_table(write(heads + '\n48.1,16,-80,"a\nb ""c"", d"\n48.2,16,"-81",\n'))
    assert table.arrays["rssi_db"].tolist() == [-80, -81]
    assert table.arrays["row_name"].tolist() == ["line 4", "line 6"]
    assert any("'RSRP [dBm]' taken as rssi_db" in note for note in table.notes)


# What is in the file, settings, and words of the line that refuses it.
SPOILT = {
    "empty": ("", {}, "empty; expected a line of heads"),
    "heads only": ("x,y,rssi\n", {}, "line 1 names columns, but there are no rows"),
    "no heads": ("1,2,-80\n2,3,-81\n", {}, "line 1 holds numbers; expected the names"),
    "a log without heads": (
        "48.2,16.3,LTE,LTE,-80\n48.3,16.3,LTE,LTE,-81\n",
        {},
        "line 1 holds numbers; expected the names",
    ),
    "one column": ("rssi\n-80\n-81\n", {}, "line 1 ('rssi') is a single column"),
    "a line too long": ("x,y,rssi\n1,2,-80\n1,2,3,-81\n", {}, "line 3 (4 cells): expected 3 cells"),
    "decimal commas between commas": (
        "x,y\n1,5,2,5\n2,5,3,5\n",
        {},
        "2 heads, but every line below has 4",
    ),
    "two open quotes": (
        'x,y,rssi\n1,"2,-80\n3,"4,-81\n',
        {},
        "line 2: a quotation mark is not closed",
    ),
    "two columns of one name": (
        "x,y,x,rssi\n1,2,3,-80\n",
        {},
        "columns 1 and 3 are both named 'x'",
    ),
    "mixed decimal marks": (
        "x;y;rssi\n1,5;2;-80,5\n1,6;2;-80.5\n",
        {},
        "column 'rssi', line 3: '-80.5': is no finite number; this",
    ),
    "text in a column of numbers": (
        "# my drive\nx,y,rssi\n1,2,-80\n\n2,3,none heard\n",
        {},
        "column 'rssi', line 5: 'none heard': is no",
    ),
    "no x in any row": (
        "x,y,rssi\n,2,-80\n,3,-81\n",
        {},
        "column 'x', line 2: no value; x is needed",
    ),
    "no place at all": ("rssi,speed\n-80,1\n-81,2\n", {}, "no coordinates among 'rssi', 'speed'"),
    "no y": (
        "x,rssi\n1,-80\n2,-81\n",
        {},
        "column 'x' is x, and none is y; say dataset.columns.y=COLUMN",
    ),
    "dBW beside dB": (
        "x,y,rssi_a [dBW],rssi_b [dB]\n1,2,-110,-80\n",
        {},
        "in dBW, 'rssi_b [dB]' in dB of nothing; rename",
    ),
    "no level in any row": ("x,y,rssi\n1,2,\n2,3,-\n", {}, "column 'rssi': no value in any row"),
    "two levels": (
        "x,y,RSRP,RSSI\n1,2,-80,-60\n",
        {},
        "'RSRP' and 'RSSI' could each be rssi_db: which is it? say",
    ),
    "dBm and mW": (
        "x,y,power_dbm,power_mw\n1,2,-80,1\n",
        {},
        "are different measurements: which is meant? say dataset.col",
    ),
    "metres and degrees": (
        "x,y,lat,lon,rssi\n1,2,40,8,-80\n",
        {},
        "both say where: which is meant? say dataset.columns.x=x",
    ),
    "dBm or watts": (
        "x,y,power\n1,2,3\n2,3,4\n",
        {},
        "column 'power': no value below 0: dBm without a minus sign, W or dBm?",
    ),
    "a misspelt column": (
        PLAIN,
        {"rssi_db": "rsi"},
        "dataset.columns.rssi_db=rsi: drive.csv has no such column; did you mean 'rssi'?",
    ),
    "a misspelt quantity": (PLAIN, {"rsi_db": "rssi"}, "no such quantity; did you mean 'rssi_db'?"),
    "a unit that does not suit": (
        PLAIN.replace("rssi", "p [mW]"),
        {"rssi_db": "p"},
        "is in mW: rssi_db needs",
    ),
    "channels of stations without places": (
        "x,y,re,im,cell\n1,2,1,0,a\n2,2,1,0,b\n",
        {},
        "stations without places; add columns",
    ),
    "a station that moved": (
        "x,y,rssi,cell,cell_x,cell_y\n1,2,-80,a,5,5\n2,2,-80,a,5,6\n",
        {},
        "'a' is at (5, 5) in line 2 and at (5, 6)",
    ),
    "a row of no station": (
        "x,y,rssi,cell,cell_x,cell_y\n1,2,-80,a,5,5\n2,2,-80,,5,5\n",
        {},
        "column 'cell', line 3: no station",
    ),
    "neighbours without identity": (
        "x,y,rssi,cell_id,psc,arfcn\n1,2,-80,7,211,10\n2,2,-81,,212,10\n",
        {},
        "column 'cell_id', line 3: no station; expected its name, or dataset.columns.station=psc+arf",
    ),
    "half of a channel": (
        "x,y,h_re_0,h_im_0,h_re_1\n1,2,3,4,5\n",
        {},
        "'h_re_1' has no csi_im beside it",
    ),
    "degrees and metres": (
        "lat,lon,rssi,cell,cell_x,cell_y\n40,8,-80,a,5,5\n",
        {},
        "of stations in metres",
    ),
    "a row that may be a comment": (
        "cell,x,y,rssi\na,1,2,-80\n#a,1,3,-81\n",
        {},
        "line 3: begins with '#a': a row, or a comment?",
    ),
    "a comment that may be a row": (
        "x,y,z,rssi\n1,2,3,-80\n# 1,2,4,-99\n",
        {},
        "line 3: begins with '# 1': a row, or",
    ),
    "a trailing comma": (
        "x,y,rssi\n1,2,-80,\n2,2,-81,\n",
        {},
        "3 heads, but every line below has 4 cells, the last of them empty",
    ),
    "something about a level": (
        "x,y,rssi_delta,predicted_rssi,signal_gain,battery_level\n1,2,3,-80,1,2\n",
        {},
        "no column of levels, powers or channels",
    ),
    "perhaps a level": (
        "x,y,rssi_ema\n1,2,-80\n",
        {},
        "'rssi_ema': a received level or power, or something else?",
    ),
    "a field strength": (
        "x,y,level (dBuV/m)\n1,2,80\n",
        {},
        "[dBuV/m] is no known unit; expected one of dB, dBm, dBW",
    ),
    "percent": ("x,y,signal (%)\n1,2,80\n", {}, "'signal (%)': is in %: a quality, not a level"),
    "per cent in a head": ("x,y,signal_percent\n1,2,80\n", {}, "a quality, not a level"),
    "millimetres beside nothing": (
        "x_mm,y,rssi\n1,2,-80\n",
        {},
        "'x_mm' is in mm, 'y' says no unit; rename one, e.g. to 'y [m]'",
    ),
    "Excel": (b"PK\x03\x04" + bytes(50), {}, "not a table of text but an Excel workbook"),
    "JSON": ('[{"x": 1}, {"x"', {}, "damaged or not a JSON, GPX or KML file"),
    "zeros": (b"x,y\0,rssi\n1,2,-80\n", {}, "not text (byte 3 is zero"),
    "a planner's raster": (
        b"II*\0\x08\0\0\0",
        {},
        "a raster (TIFF), squares of a map; give the table",
    ),
    "UTF-16 cut short": (PLAIN.encode("utf-16")[:-1], {}, "damaged UTF-16"),
}


def test_swapped_degrees_are_refused(write, refused):
    path = write("lat,lon,rssi\n-111.8,40.7,-80\n-111.9,40.7,-81\n")
    says = (
        "line 2: latitude -111.8 is outside -90 to 90 degrees; are latitude and longitude swapped"
    )
    refused(says, lambda: interpret(parse_table(path), path))
    refused(says, read_query_places, path, ["rx"])


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_table_is_refused_in_a_line(write, refused, name, monkeypatch, tmp_path):
    content, columns, says = SPOILT[name]
    write(content)
    monkeypatch.chdir(tmp_path)
    problems = refused("", parse_table, "drive.csv", columns).problems
    assert says in problems[0] and len(problems) <= 3, problems
    assert all("drive.csv" in p or "dataset." in p for p in problems)


def test_channels_of_several_tones_and_stations(write):
    """They were refused with the advice to take one tone."""
    text = "x,y,station,station_x,station_y,csi_re_1,csi_im_1,csi_re_0,csi_im_0\n1,2,a,0,0,1,2,3,4\n1,2,b,5,5,5,6,7,8\n"
    arrays = parse_table(write(text), {"frequency_hz": "1e9:2e9"}).arrays
    assert arrays["csi"].tolist() == [[3 + 4j, 1 + 2j], [7 + 8j, 5 + 6j]]


def test_all_bad_cells_are_listed_at_once(write, refused):
    rows = "".join(f"{i},{'?!' if i % 2 else i},-8x\n" for i in range(20))
    said = "\n".join(refused("line 2: '-8x'", parse_table, write("x,y,rssi\n" + rows)).problems)
    assert "line 3: '?!'" in said
    assert "the same in 15 more rows" in said and "the same in 5 more rows" in said


@pytest.mark.parametrize(
    "listed, words",
    [
        ("name,x,y,z\na,1,2,3\n", "column 'station': 'b': no listed station; the list has a"),
        ("name,x,y,z\na,1,2,3\nB1,1,2,3\nb7,3,4,5\n", "did you mean 'b7'?"),
        ("name,x,y,z\na,1,2,3\na,1,2,4\n", "station 'a' is listed twice, in line 2 and line 3"),
        ("x,y,z\n1,2,3\n", "no column of names"),
        ("name,height\na,1\n", "no coordinates; expected columns x, y, z"),
        ("name,x,y\na,1,\n", "column 'y', line 2: no value; station_y is needed"),
    ],
)
def test_a_spoilt_list_of_stations(write, refused, listed, words):
    rows = write("x,y,rssi,station\n1,2,-80,a\n1,3,-81,b\n")
    refused(words, parse_table, rows, {}, write(listed, "stations.csv"))


def test_names_of_files(write, refused, tmp_path):
    refused("no such file", parse_table, tmp_path / "nothing.csv")
    refused("a folder, which dataset=rfid (argos, ...) dataset.root=", parse_table, tmp_path)
    refused(
        "expected a table (csv, parquet, json, ...), no arrays",
        parse_table,
        write(PLAIN, "drive.mat"),
    )


def test_marks_between_thousands_were_decimal_commas(write, refused):
    """\"448,262\" in quotes between commas was 448.262 m."""
    marked = write('x,y,rssi\n"448,262","412,100",-60\n"448,263","412,107",-61\n')
    refused(
        "line 2: '448,262': is no finite number; .* no marks between thousands", parse_table, marked
    )
    some = parse_table(write('x,y,rssi\n"448,262","412,1",-60\n"448,263","412,25",-61\n'))
    np.testing.assert_array_equal(some.arrays["rx_position"], [[448.262, 412.1], [448.263, 412.25]])


def test_access_points_that_receive_were_transmitters(write):
    """Stations whose places are called rx_x, ... receive: the other end is the transmitter,
    and moves.
    """
    lines = [f"{i},{i % 7},1,{'ab'[i % 2]},{50 * (i % 2)},0,3,{-50 - i % 13}" for i in range(40)]
    path = write("\n".join(["x,y,z,ap,rx_x,rx_y,rx_z,rssi", *lines]))
    arrays = parse_table(path).arrays
    assert "tx_position" in arrays and "rx_position" not in arrays
    assert "rx_position" in parse_table(write(path.read_text().replace("rx_", "tx_"))).arrays


def test_parquet(tmp_path, write, refused):
    """pandas sets columns aside as an index: stations were lost, and all rows one station's."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gsparc[tables]'")
    import pandas as pd

    columns = {"lat": [40.0, 40.1], "lon": [8.0, 8.1], "RSRP [dBm]": [-80, None], "pci": [7, 8]}
    frame = pd.DataFrame({**columns, "cell_lat": [41.0, 42.0], "cell_lon": [8.0, 8.0]})
    for index in (None, ["pci"], ["pci", "lat"]):
        (frame if index is None else frame.set_index(index)).to_parquet(tmp_path / "drive.parquet")
        arrays = parse_table(tmp_path / "drive.parquet").arrays
        assert arrays["station_name"].tolist() == ["7", "8"] and arrays["row_name"][1] == "row 1"
        assert arrays["rssi_db"][0] == -80 and np.isnan(arrays["rssi_db"][1])
        assert arrays["latitude"].tolist() == [40.0, 40.1]
    refused("damaged or not a Parquet file", parse_table, write(b"PAR1" + bytes(20), "bad.parquet"))


@pytest.mark.parametrize("head", ["RSRP [dBm]", "RSRP [dBW]", "rssi_mW", "power (W)"])
def test_powers_of_a_table_come_back_in_its_unit(write, head):
    data = interpret(parse_table(write(f"x,y,z,{head}\n1,2,3,7\n4,5,6,8.5\n")), "drive").data
    unit = data.site.power_unit()
    assert head.strip("])").endswith(unit.name)
    assert data.site.level_unit == ("dBm" if "RSRP" in head else "dBW")  # what pictures say
    assert np.allclose(unit.values(data.targets([0, 1])).numpy(), [[7], [8.5]])


def test_parquet_without_pyarrow(write, refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    says = r"Parquet needs pyarrow; say: pip install 'gsparc\[tables\]'"
    refused(says, parse_table, write(b"PAR1", "drive.parquet"))


LOSSES = "u_cm,v_cm,loss_dB\n100,200,67\n150,250,71\n"


def test_a_table_without_levels_and_coordinates_said_so_one_at_a_time(write):
    with pytest.raises(DataError) as refused:
        parse_table(write(LOSSES))
    levels, coordinates = refused.value.problems
    assert "no column of levels" in levels and "no coordinates among" in coordinates


def test_a_factor_and_the_unit_of_a_head_turned_centimetres_twice(write):
    given = {"x": "u_cm*0.01", "y": "v_cm", "rssi_db": "loss_dB*-1"}
    table = parse_table(write(LOSSES), given)
    doubts = [note for note in table.notes if isinstance(note, Caution)]
    said = "column 'u_cm' times 0.01, then cm (by its head) into m: 100 in the file is 0.01 m"
    assert doubts == [said]
    assert "column 'v_cm': cm turned into m" in table.notes


@pytest.mark.parametrize(
    ("head", "unit"), [("loss_dB", "dB"), ("loss", "dB"), ("rsrp", "dBm"), ("level [dBm]", "dBm")]
)
def test_losses_became_dbm(write, head, unit):
    table = parse_table(write(f"x,y,{head}\n1,2,67\n2,3,71\n"), {"rssi_db": f"{head}*-1"})
    assert table.attributes["level_unit"] == unit and table.arrays["rssi_db"].tolist() == [-67, -71]
    assert f"column '{head}' times -1: 100 in the file is -100 {unit}" in table.notes
