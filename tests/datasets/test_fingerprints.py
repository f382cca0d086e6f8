"""Fingerprints from archives and tables, what is refused, and how rows are parted."""

import numpy as np
import pytest

from gsparc.datasets.fingerprints import Fingerprints, read_fingerprints, split_fingerprints

NAN = np.nan


def arrays(**other):
    level = np.array([[-60, NAN], [NAN, -70], [-65, -80], [-50, NAN]], np.float32)
    found = {"rss_dbm": level, "position": np.array([[0, 0, 1], [5, 0, 1], [0, 5, 1], [5, 5, 1.0]])}
    return {**found, **other}


def written(path, **other):
    np.savez(path, **{name: part for name, part in arrays(**other).items() if part is not None})
    return path


def test_archive_is_read(tmp_path):
    file = written(
        tmp_path / "a.npz", floor=np.int64(3), test=np.array([0, 1, 0, 0], bool), month=np.arange(4)
    )
    rows = read_fingerprints(file)
    assert rows.level.dtype == np.float32 and rows.position.dtype == np.float64
    assert rows.floor.tolist() == [3] * 4 and rows.access_point.tolist() == ["0", "1"]
    assert [part.tolist() for part in split_fingerprints(rows)] == [[0, 2, 3], [1]]
    assert [part.tolist() for part in split_fingerprints(rows, "later")] == [[0], [1, 2, 3]]
    flat = read_fingerprints(written(tmp_path / "b.npz", position=arrays()["position"][:, :2]))
    assert flat.position.shape == (4, 3) and not flat.position[:, 2].any()


@pytest.mark.parametrize(
    "other, said",
    [
        ({"position": None}, "position: missing"),
        ({"position": np.zeros((3, 3))}, "position: expected shape"),
        ({"position": np.full((4, 3), NAN)}, "finite coordinates"),
        ({"position": np.zeros((4, 4))}, "2 or 3 coordinates"),
        ({"rss_dbm": np.full((4, 2), NAN)}, "no row heard an access point"),
        ({"rss_dbm": np.full((4, 2), 100.0)}, "found 100 in row 0, column 0"),
        ({"rss_dbm": np.full((4, 2), np.inf)}, "found inf"),
        (
            {"floor": np.zeros(3, np.int64)},
            r"floor: expected shape \(\) or \(S,\), here \(\) or \(4,\)",
        ),
        ({"floor": np.zeros(4)}, "floor: expected whole numbers, found dtype float64"),
        ({"access_point": np.array(["a", "a"])}, "expected each once"),
        ({"test": np.array(["no"] * 4)}, "test: expected True and False"),  # was a KeyError
    ],
)
def test_bad_archives_are_refused_in_one_line(tmp_path, other, said, refused):
    refused(said, read_fingerprints, written(tmp_path / "a.npz", **other))


def test_table_is_read(tmp_path, refused):
    file = tmp_path / "a.csv"
    head = "WAP001,WAP002,LONGITUDE,LATITUDE,FLOOR,BUILDINGID\n"
    file.write_text(head + "-60,100,-7500.5,4864900,2,1\n100,-90,-7400,4864800,0,0\n")
    rows = read_fingerprints(file)
    np.testing.assert_array_equal(rows.level, np.array([[-60, NAN], [NAN, -90]], np.float32))
    np.testing.assert_allclose(rows.position, [[-7500.5, 4864900, 7.4], [-7400, 4864800, 0]])
    assert rows.building.tolist() == [1, 0] and rows.access_point.tolist() == ["WAP001", "WAP002"]
    for text, said in (
        (head.replace("LATITUDE", "Y"), "no column LATITUDE"),
        ("LONGITUDE,LATITUDE\n1,2\n", "no column WAP001"),
        (head + "loud,100,1,2,0,0\n", "column WAP001: expected numbers, found 'loud'"),
        ("", "not readable as CSV"),
    ):
        file.write_text(text)
        refused(said, read_fingerprints, file)


def invented(count: int = 200) -> Fingerprints:
    rng = np.random.default_rng(0)
    none, places = np.zeros(count, np.int64), rng.uniform(0, 20, (count, 3))
    level = rng.uniform(-90, -40, (count, 3)).astype(np.float32)
    walk = np.arange(count) % 8
    return Fingerprints(
        level,
        places,
        none,
        none,
        walk,
        none,
        none > 0,
        none.astype(float),
        np.array(["a", "b", "c"]),
    )


def test_splits_hold_out_whole_units(refused):
    rows = invented()
    for how, unit in (
        ("places", np.floor(rows.position / 4)),
        ("blocks", np.floor(rows.position[:, :2] / 4)),
        ("walks", rows.walk[:, None]),
    ):
        train, test = split_fingerprints(rows, how, side_m=4.0)
        assert len(test) > 10 and not set(train) & set(test) and len(train) + len(test) == 200
        assert not {tuple(u) for u in unit[train]} & {tuple(u) for u in unit[test]}, how
        np.testing.assert_array_equal(test, split_fingerprints(rows, how, side_m=4.0)[1])
    for how in ("released", "later"):
        refused("names no such rows", split_fingerprints, rows, how)
    refused(r"split='walk': one of .*did you mean 'walks'", split_fingerprints, rows, "walk")


def test_columns_are_those_of_another_campaign(refused):
    rows = invented().subset(np.arange(5)).select_access_points(np.array(["c", "z", "a"]))
    np.testing.assert_array_equal(rows.level[:, [2, 0]], invented().level[:5][:, [0, 2]])
    assert np.isnan(rows.level[:, 1]).all() and rows.level.dtype == np.float32
    refused("no access point of", rows.select_access_points, np.array(["y"]))
