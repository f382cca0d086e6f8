"""What columns are taken for: asked where readings differ, written to a file, read from it."""

import numpy as np
import pytest
from doors import said
from strangers import BAND, CASES, LEVELS, PLACES, ROWS, table

from gsparc.base.errors import DataError
from gsparc.datasets.own import Own, read_any
from gsparc.tables.read import parse_table
from gsparc.tables.said_columns import beside
from gsparc.tables.sheet import are_alike

TWO = table("x,y,RSRP,RSSI", *PLACES.T, *LEVELS[:, :2].T)
EQUAL = table("x,y,RSRP,RSSI", *PLACES.T, LEVELS[:, 0], LEVELS[:, 0])


def test_training_stops_where_columns_are_open_and_takes_an_answer(write):
    path = write(TWO)
    with pytest.raises(DataError, match=r"rssi_db=RSRP \(.* in line 2\), or .*rssi_db=RSSI"):
        Own(path).load()
    answered = Own(path, columns={"rssi_db": "RSSI"})
    assert answered.load().site.sha256 != Own(path, guess=True).load().site.sha256
    assert answered.said == {"rssi_db": "RSSI"}


def test_readings_that_build_the_same_arrays_are_not_asked(write):
    assert "asked" not in said(write(EQUAL)) and len(Own(write(EQUAL)).load()) == ROWS


def test_a_question_stands_first_and_check_fails_until_it_is_answered(write):
    path = write(TWO)
    assert said(path).startswith("asked ") and "1 question, on which training stops" in said(path)
    assert ": good" in said(path, columns={"rssi_db": "RSRP"})


def test_answers_of_training_are_kept_for_other_files(write):
    module = Own(write(TWO), guess=True)
    module.load()
    assert module.said == {"rssi_db": "RSRP"}


ARRAYS = {name: case for name, case in CASES.items() if not case[1].get("stations_file")}


@pytest.mark.parametrize("name", ARRAYS)
def test_a_file_about_columns_reads_the_same(write, name):
    content, settings, *_ = CASES[name]
    path, columns = write(content), settings.get("columns", {})
    try:
        plain = parse_table(path, columns, guess=True)
    except DataError:
        return
    said(path, columns=columns)
    about = beside(path)
    about.write_text(about.read_text().replace("role: '?', likely:", "role:"))
    again = parse_table(path, columns_file=about)
    assert are_alike(plain, again)


def test_a_file_about_columns_is_taken_once_edited_and_never_written_over(write):
    path = write(table("x,y,alt,rssi", *PLACES.T, LEVELS[:, 1], LEVELS[:, 0]))
    assert "columns.yaml says what each is taken for" in said(path)
    about = beside(path)
    assert "columns are what" not in said(path)  # as it was written
    about.write_text(edited := about.read_text().replace("role: z", "role: unused"))
    assert "was edited, and is taken" in said(path) and about.read_text() == edited
    assert not np.ptp(read_any(path).data.moving[:, 2])


def test_a_file_about_columns_of_other_heads_is_refused(write, refused):
    path = write(table("x,y,rssi", *PLACES.T, LEVELS[:, 0]))
    said(path)
    kept = beside(path).rename(path.with_name("kept.yaml"))
    path.write_text(table("x,y,rssi,run", *PLACES.T, LEVELS[:, 0], BAND))
    refused("the table's heads changed since", read_any, path, columns_file=kept)


def test_what_is_open_stays_open_in_a_file_about_columns(write):
    path = write(TWO)
    said(path)
    assert "role: '?', likely: rssi_db" in beside(path).read_text()
    with pytest.raises(DataError, match="could each be rssi_db"):
        Own(path, columns_file=beside(path)).load()


RANKED = [
    sorted(zip("abc", row, strict=True), key=lambda pair: -pair[1])[:2] for row in LEVELS.tolist()
]
RANKS = [[str(pair[rank][part]) for pair in RANKED] for rank in (0, 1) for part in (0, 1)]


@pytest.mark.parametrize("heads", ["mac1,rssi1,mac2,rssi2", "BSSID_1,RSSI_1,BSSID_2,RSSI_2"])
def test_ranks_were_taken_for_stations(write, heads):
    data = read_any(write(table(f"x,y,{heads}", *PLACES.T, *RANKS))).data
    assert data.site.stations.name == ("a", "b", "c") or set(data.site.stations.name) == set("abc")


def test_ranks_beside_names_of_another_word_are_asked(write):
    path = write(table("x,y,who1,rssi1,who2,rssi2", *PLACES.T, *RANKS))
    with pytest.raises(DataError, match=r"rssi_db=rssi\* dataset.columns.station=who\*"):
        Own(path).load()
    lists = {"station": "who*", "rssi_db": "rssi*"}
    assert set(read_any(path, columns=lists).data.site.stations.name) == set("abc")
    wide = read_any(path, columns={"rssi_db": ["rssi1", "rssi2"]}).data
    assert wide.site.stations.name == ("1", "2")


@pytest.mark.parametrize("way", ["RSSI A...RSSI C*-1", ["RSSI A*-1", "RSSI B*-1", "RSSI C*-1"]])
def test_one_answer_takes_all_columns_of_a_block(write, way):
    content = table("x,y,RSSI A,RSSI B,RSSI C", *PLACES.T, *-LEVELS.T)
    with pytest.raises(DataError, match=r'rssi_db="RSSI A\.\.\.RSSI C\*-1"'):
        Own(write(content)).load()
    data = read_any(write(content), columns={"rssi_db": way}).data
    assert len(data) == 3 * ROWS and data.site.stations.name == ("A", "B", "C")


PHASES = table("x,y,RSSI,phase", *PLACES.T, LEVELS[:, 0], np.linspace(0, 6, ROWS))


def test_a_level_beside_a_phase_is_asked(write):
    with pytest.raises(DataError, match=r"rssi_db=RSSI .*csi_amp=RSSI dataset.columns.csi_phase"):
        Own(write(PHASES)).load()
    polar = {"csi_amp": "RSSI", "csi_phase": "phase"}
    csi = parse_table(write(PHASES), polar).arrays["csi"]
    np.testing.assert_allclose(20 * np.log10(abs(csi)), LEVELS[:, 0])


def test_a_floor_is_a_height_or_a_group_of_rows(write):
    path = write(table("x,y,Floor ID,rssi", *PLACES.T, BAND, LEVELS[:, 0]))
    with pytest.raises(DataError, match=r'z="Floor ID\*3.2".*, or dataset.columns.z=none .*run='):
        Own(path).load()
    heights = Own(path, columns={"z": "Floor ID*3.2"}).load().moving[:, 2]
    assert np.ptp(heights) == pytest.approx(3.2)
    group = Own(path, columns={"z": "none", "run": "Floor ID"}).load()
    assert not np.ptp(group.moving[:, 2]) and len(np.unique(group.run)) == 2
    Own(write(table("x,y,floor,rssi", *PLACES.T, 0 * BAND, LEVELS[:, 0]))).load()  # one alone


GRID = 47.4 + PLACES / 1e4


@pytest.mark.parametrize(
    "heads, says",
    [
        ("grid_lat,grid_lon", "dataset.columns.lat=grid_lat dataset.columns.lon=grid_lon"),
        ("ECoord,NCoord", "dataset.columns.x=ECoord dataset.columns.y=NCoord"),
    ],
)
def test_heads_that_hold_a_coordinate_are_proposed(write, refused, heads, says):
    refused(says, parse_table, write(table(f"{heads},rssi", *GRID.T, LEVELS[:, 0])))


def test_points_that_a_spreadsheet_moved_are_one_sentence(write, refused):
    moved = [f"4.652.{row}.391" if row % 3 else f"{row}.5" for row in range(100, 100 + ROWS)]
    error = refused(
        "160 of 240 cells hold several points, like '4.652.100.391' in line 2: a spreadsheet",
        parse_table,
        write(table("x,y,rssi", moved, PLACES[:, 1], LEVELS[:, 0])),
    )
    assert len(error.problems) == 1


def test_halves_of_the_earth_in_one_cell(write):
    cells = [f"{51 + y / 1e3:.5f} N {x / 1e3:.5f} W" for x, y in PLACES]
    arrays = parse_table(write(table("where,rssi", cells, LEVELS[:, 0]))).arrays
    np.testing.assert_allclose(arrays["longitude"], -PLACES[:, 0] / 1e3, atol=1e-5)


def test_pairs_that_no_row_names_were_taken_for_silence(tmp_path):
    """Somebody chose which to measure; a table of a column a station listened to all."""
    heard = np.quantile(LEVELS, 0.4) < LEVELS
    rows = [
        f"{x},{y},{name},{level}"
        for (x, y), row, keep in zip(PLACES, LEVELS, heard, strict=True)
        for name, level, kept in zip("abc", row, keep, strict=True)
        if kept
    ]
    path = tmp_path / "pairs.csv"
    path.write_text("\n".join(["x,y,anchor,rssi", *rows]))
    with pytest.raises(DataError, match=r"not heard, or not measured.*absent=weaker.*unknown"):
        Own(path).load()
    assert Own(path, absent="unknown").load().censored is None
    assert (Own(path, absent="weaker").load().censored > 0).any()
    wide = np.where(heard, LEVELS.astype(int).astype(str), "")
    path.write_text(table("x,y,AP1,AP2,AP3", *PLACES.T, *wide.T))
    assert (Own(path).load().censored > 0).any()


def test_heads_that_say_which_of_a_list_were_stations(write):
    path = write(table("x,y,rsrp_serving,rsrp_best_neighbour,rsrp_gap", *PLACES.T, *LEVELS.T))
    with pytest.raises(DataError, match=r"rssi_db=rsrp_serving \(.*=rsrp_best_neighbour"):
        Own(path).load()


SELDOM = np.where(np.arange(ROWS)[:, None] % 40 == 0, LEVELS[:, :1], 100).astype(int)


@pytest.mark.parametrize("name", ["MAC", "spot "])
def test_rarely_heard_stations_of_a_block_were_dropped(write, name):
    levels = np.c_[LEVELS.astype(int), np.repeat(SELDOM, 3, axis=1)]
    heads = ",".join(f"{name}{number}" for number in range(1, 7))
    path = write(table(f"x,y,{heads}", *PLACES.T, *levels.T))
    names = read_any(path, guess=True).data.site.stations.name
    assert len(names) == 6 and names[0] == f"{name}1"
