"""Text of tables: comments, heads in comments, spaces of other kinds."""

import gzip
import time

import numpy as np
import pytest
import yaml

from gsparc.base import limits
from gsparc.base.errors import DataError
from gsparc.base.files import load_yaml, read_csv
from gsparc.tables import text as text_file
from gsparc.tables.own import interpret
from gsparc.tables.read import parse_table


def test_stations_of_unknown_place_could_not_be_read(write, refused):
    """The schema had them, of powers, and methods estimate where they are."""
    text = "x,y,rssi,cell\n1,2,-80,b\n2,3,-81,a\n4,4,-82,b\n9,4,-83,a\n"
    table = parse_table(write(text))
    assert any("no places of the stations: unknown" in note for note in table.notes)
    data = interpret(table, "drive").data
    assert data.site.stations.name == ("b", "a") and np.isnan(data.site.stations.position).all()
    assert data.station.tolist() == [0, 1, 0, 1] and np.isfinite(data.site.box).all()
    for one, axes in ((text, "x,y"), (text.replace("x,y", "lat,lon"), "lat,lon")):
        some = parse_table(write(one), {}, write(f"name,{axes}\na,3,4\nb,,\n", "stations.csv"))
        known = np.isfinite(interpret(some, "drive").data.site.stations.position).all(axis=1)
        assert known.tolist() == [True, False]
    listed = write("name,x,y\na,3,4\nb,1,\n", "stations.csv")
    refused(
        "column 'y', line 3: no value; station_y is needed", parse_table, write(text), {}, listed
    )


@pytest.mark.parametrize("mark", ["#", "%", "//"])
def test_rows_that_begin_like_comments_vanished(write, mark):
    """Stations called #1, #2: two thirds of the rows were gone, and the rest was good."""
    rows = "".join(
        f"{name},{i},{i * i},-{60 + i}\n"
        for i, name in enumerate([mark + "1", mark + "2", "A"] * 9)
    )
    listed = write(f"name,x,y\nA,0,0\n{mark}1,9,9\n{mark}2,5,5\n", "stations.csv")
    table = parse_table(write("station,x,y,rssi\n" + rows), {}, listed)
    assert table.arrays["rssi_db"].tolist() == [-60.0 - i for i in range(27)]
    assert table.arrays["station"].tolist() == [1, 2, 0] * 9
    assert f"18 rows begin with '{mark}1' or the like, the first in line 2" in table.notes


def test_a_no_break_space_between_columns(write):
    """Cells were counted by one rule and parsed by another: KeyError: 3."""
    arrays = parse_table(write("x y z rssi\n1 2\xa03 -80\n4 5 6 -81.5\n", "drive.txt")).arrays
    np.testing.assert_array_equal(arrays["rx_position"], [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("x, asked", [("448,262", True), ("448,26", False)])
def test_thousands_between_semicolons_were_decimals_without_a_question(write, x, asked):
    """x of 448,262 m and y of 5412013 m: a drive 1000 times shorter to the east."""
    notes = parse_table(write(f"x;y;rssi\n{x};5412013;-80\n448,291;5412100;-81\n")).notes
    said = [note for note in notes if note.startswith("decimal commas")]
    assert (
        len(said) == 1
        and ("448,262 is 448.262; if commas stand between thousands" in said[0]) == asked
    )


def test_a_comment_mark_after_an_empty_cell_was_a_crash(write, refused):
    table = write("x\ty\trssi\n1\t2\t-70\n\t# 3\t-70\n", "a.tsv")
    refused(r"line 3: begins with '# 3.*: a row, or a comment\?", parse_table, table)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (
            "x,y,z,rssi_db\n1,2,3," + "4" * 3_000_000,
            "line 2: 3,000,006 characters; expected at most 1,048,576",
        ),
        ("#" * 3_000_000 + "\nx,y,z,rssi_db\n1,2,3,-4\n", "line 1: 3,000,000 characters"),
        (
            "x,y,z,rssi_db" + "," * 300_000 + "\n1,2,3,-4",
            "300,004 columns of 2 lines; at most 10,000",
        ),
        (
            "x,y,z,rssi_db\n" + "1,2,3,-4\n" * 9_999,
            "4 columns of 10,000 lines; at most 10,000 and 30,000 cells",
        ),
    ],
    ids=["cell", "comment", "heads", "cells"],
)
def test_lines_and_heads_without_end_took_all_memory(write, refused, monkeypatch, content, says):
    """A line of 200 MB took 10.4 GiB; 1e8 cells of a head did not end in a minute."""
    monkeypatch.setattr(text_file, "MOST_CELLS", 30_000)
    refused(says, parse_table, write(content))
    monkeypatch.setenv(limits.LIFTED_BY, "1000")
    refused(
        "a table of text of more than 1,000 bytes; write it as Parquet", parse_table, write(content)
    )


def test_a_small_file_that_unpacks_to_a_large_table_took_all_memory(tmp_path, refused, monkeypatch):
    """.9 MB held 600 MB of text, which took 12 GB; of 20 MB of it the same is told."""
    rows = b"1,2,1.5,-60\n" * 2**21
    (path := tmp_path / "rows.csv.gz").write_bytes(gzip.compress(b"x_m,y_m,z_m,rsrp_dbm\n" + rows))
    packed = path.stat().st_size
    assert limits.MOST_UNPACKED * packed < len(rows) < limits.MOST_BYTES
    began = time.process_time()
    refused(
        r"more than 16,777,216 bytes when it is unpacked; .* set GSPARC_MOST_BYTES=N",
        parse_table,
        path,
    )
    assert time.process_time() - began < 2
    monkeypatch.setattr(text_file, "MOST_CELLS", 1000)  # read to here, as it is lifted
    monkeypatch.setenv(limits.LIFTED_BY, str(2**27))
    refused("1,000 cells are read", parse_table, path)
    monkeypatch.setenv(limits.LIFTED_BY, "1e9")
    refused("GSPARC_MOST_BYTES='1e9': a whole number", parse_table, path)


@pytest.mark.parametrize(
    "text", ["[" * 200_000, "[" * 200_000 + "]" * 200_000, '{"a": ' * 100_000, "(" * 200_000]
)
@pytest.mark.parametrize("ending", [".csv", ".json", ".txt"])
def test_brackets_without_end_did_not_end(tmp_path, refused, text, ending):
    """A name of a column of 200,000 of them was searched for a unit from each on."""
    (path := tmp_path / f"deep{ending}").write_text(text)
    began = time.process_time()
    refused(
        "single column|brackets within brackets|no records|not a table|expected", parse_table, path
    )
    if "(" not in text:  # of these a text is made
        with pytest.raises((DataError, yaml.YAMLError)):
            load_yaml(text, path)
    assert time.process_time() - began < 5


def test_other_tables_of_text_have_lines_as_long(write, refused):
    refused(
        "line 2: .* characters; expected at most",
        read_csv,
        write("a,b\n" + "," * 2_000_000),
        "missing",
    )


def test_one_name_in_two_spellings_was_two_stations(write):
    """Its accent as one letter or as two, or with a space of no width:
    rows that never were lay below.
    """
    names = ["Z\u00fcrich", "Zu\u0308rich", "Z\u00fcrich\u200b"]
    rows = "".join(f"{i},{i * i % 7},{-60 - i},{names[i % 3]}\n" for i in range(9))
    data = interpret(parse_table(write("x,y,rssi,cell\n" + rows)), "drive").data
    assert data.site.stations is None or len(data.site.stations) == 1
