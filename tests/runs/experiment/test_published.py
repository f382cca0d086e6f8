"""Published rows stand beside those measured here, where both are of the same test rows."""

import pandas as pd
import pytest
from compared import averages, drawn, filled
from refusals import refused

from gsparc.runs.experiment.published import beside_published, read_published
from gsparc.runs.experiment.table import columns_of_csv, markdown, split_by_problem


@pytest.fixture
def file(tmp_path):
    """A table of two problems: errors over draws in dB, and PSNR of two methods."""
    cells = [*drawn("gp", 5.0, 6.0, 7.0, kind="rssi", split="drawn"), filled("gp", 30.0)]
    rows = averages([*cells, *(filled("gsrf", 20.0 + seed, seed, 1.0) for seed in range(2))])
    pd.DataFrame(columns_of_csv(rows)).to_csv(tmp_path / "table.csv", index=False)
    return tmp_path / "table.csv"


def test_a_table_is_read_as_it_was_written(file):
    again = pd.DataFrame(columns_of_csv(read_published(file)))
    assert again.to_csv(index=False) == file.read_text()


def test_rows_of_the_same_test_rows_stand_beside_a_new_method(file):
    own = averages([filled("mine", 31.0), filled("gp", 29.0)])
    every = beside_published(own, read_published(file))
    (effort,) = split_by_problem(every)
    assert list(zip(effort.method, effort.score_db, strict=True)) == [
        ("mine", 31.0),
        ("gp", 29.0),
        ("gsrf", 20.5),
    ]
    assert "| gsrf* |" in markdown([effort], "mine")
    assert (
        len(beside_published(averages([filled("mine", 31.0, split="other")]), read_published(file)))
        == 1
    )


def test_rows_of_other_data_stood_beside(file):
    """Test rows were known by their numbers, which another simulation of a room has, too."""
    own = averages([filled("mine", 31.0, **{"dataset/sha256": "other"})])
    assert len(beside_published(own, read_published(file))) == 1


def test_a_table_of_an_older_program_lacks_a_column(file):
    """Each column that is added to `compare.csv` made the tables written before unreadable."""
    older = pd.read_csv(file).drop(columns=["given", "memory_mb"])
    older.to_csv(file, index=False)
    rows = read_published(file)
    assert set(rows.given) == {""} and rows.memory_mb.isna().all()


def test_a_file_that_is_no_table_is_named(tmp_path, file):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    refused(
        "other.csv: no compare.csv: it has no column dataset",
        read_published,
        tmp_path / "other.csv",
    )
    refused("absent.csv: cannot be read", read_published, tmp_path / "absent.csv")
