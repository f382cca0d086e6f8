"""`gsparc locate` from a trained model or a file of fingerprints to its files."""

import csv
import json
import shutil

import numpy as np
import pytest
import towns
from campaigns import compose, powers
from PIL import Image

from gsparc.apps.locate import locator
from gsparc.base.errors import DataError
from gsparc.commands.locate import task as locate
from gsparc.evaluation.summary import write_as_found
from gsparc.models import checkpoint

UNPLACED = {"row", "x", "y", "z", "volume_m3", "modes", "doubt"}
PLACED = UNPLACED | {"x_true", "y_true", "z_true", "error_m", "inside"}


@pytest.fixture
def trained(spectra_gp, tmp_path):
    """A copy: what it learns of its trust is stored with it."""
    return shutil.copy(spectra_gp, tmp_path / "model.ckpt")


@pytest.fixture
def hall(fingerprints, tmp_path):
    """Overrides that locate walks through a hall; beside their file the same at unknown places."""
    np.savez(tmp_path / "walks.npz", **fingerprints)
    np.savez(
        tmp_path / "unplaced.npz", **{k: v for k, v in fingerprints.items() if k != "position"}
    )
    return "dataset=fingerprints", f"dataset.file={tmp_path}/walks.npz", "dataset.split=walks"


def located(folder, *overrides):
    """Facts of the summary, and rows of the table."""
    folder.mkdir(exist_ok=True)
    locate(compose(*overrides, config="locate"), folder)
    with (folder / "locate.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return json.loads((folder / "summary.json").read_text()), rows


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


@pytest.mark.slow
def test_places_areas_and_pictures_are_written(trained, tmp_path):
    against = "against=[nearest,weighted_knn]"
    facts, rows = located(tmp_path, f"ckpt={trained}", "calibrate=2", against)
    assert set(rows[0]) == PLACED and len(rows) == facts["locate/snapshots"]
    assert facts["locate/median_m"] == pytest.approx(np.median(column(rows, "error_m")))
    assert facts["locate/median_m"] < 0.5 * facts["baseline/nearest/median_m"]
    assert facts["time/locate_ms_p50"] > 0 and 0 <= facts["locate/coverage"] <= 1
    assert (tmp_path / "posteriors.png").stat().st_size > 10_000
    assert "locate" in checkpoint.read(trained).extra


@pytest.mark.slow
def test_a_table_was_refused_and_after_the_calibration(tmp_path):
    """Rows of another file were npz alone, though training reads tables."""
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 30, (120, 2))
    level = -40 - np.linalg.norm(place[:, None] - [[0, 0], [30, 0], [15, 30]], axis=2)
    rows = [",".join(f"{value:.2f}" for value in row) for row in np.hstack([place, level])]
    for name, part in (("a", rows[:100]), ("b", rows[100:])):
        (tmp_path / f"{name}.csv").write_text("x,y,AP1,AP2,AP3\n" + "\n".join(part) + "\n")
    ckpt = towns.trained(tmp_path / "a.csv", "gp")
    facts, found = located(
        tmp_path / "run", f"ckpt={ckpt}", f"data='{tmp_path}/b.csv'", "calibrate=0"
    )
    assert len(found) == 20 and facts["locate/median_m"] < 3
    with pytest.raises(DataError, match="no such file"):  # at once
        located(tmp_path / "run", f"ckpt={ckpt}", f"data='{tmp_path}/c.csv'")


@pytest.fixture(scope="module")
def roofs(tmp_path_factory):
    """A model of all rows of a table in degrees with listed stations,
    and a phone's log of levels.
    """
    folder, rng = tmp_path_factory.mktemp("roofs"), np.random.default_rng(0)
    east_north, masts = rng.uniform(0, 300, (120, 2)), np.array([[0, 0], [300, 0], [150, 300.0]])
    level = -40 - 20 * np.log10(5 + np.linalg.norm(east_north[:, None] - masts, axis=2))
    level += rng.normal(0, 0.5, level.shape)

    def degrees(places):
        return np.column_stack([48 + places[:, 1] / 111_200, 11 + places[:, 0] / 74_500])

    names = "roof-1,roof-2,roof-3"
    listed = [f"roof-{i + 1},{a:.7f},{b:.7f},30" for i, (a, b) in enumerate(degrees(masts))]
    (folder / "masts.csv").write_text("\n".join(["name,latitude,longitude,height", *listed]) + "\n")
    log = [
        f"{i},{a:.2f},{'' if i == 3 else f'{b:.2f}'},{c:.2f}"
        for i, (a, b, c) in enumerate(level[100:])
    ]
    (folder / "phone.csv").write_text("\n".join([f"scan,{names}", *log]) + "\n")
    known = np.hstack([degrees(east_north), np.full((120, 1), 1.5), level])[:100]
    head = f"latitude,longitude,height,{names}"
    np.savetxt(folder / "walk.csv", known, "%.7f", ",", header=head, comments="")
    more = f"dataset.stations_file='{folder}/masts.csv'", "split=none", "eval_on=train"
    ckpt = towns.trained(folder / "walk.csv", "gp", *more)
    return ckpt, folder, degrees(east_north[100:])


@pytest.mark.slow
def test_a_phones_log_without_places_was_refused(roofs, tmp_path):
    """`no coordinates among ...; say dataset.columns.x=COLUMN`,
    where Python located the same levels.
    """
    ckpt, folder, true = roofs
    facts, found = located(
        tmp_path / "run", f"ckpt={ckpt}", f"data='{folder}/phone.csv'", "calibrate=0"
    )
    assert set(found[0]) == UNPLACED - {"volume_m3"} | {"area_m2", "latitude", "longitude"}
    assert "locate/median_m" not in facts
    assert [row["row"] for row in found] == [f"line {number + 2}" for number in range(20)]
    off = (np.stack([column(found, name) for name in ("latitude", "longitude")], 1) - true) * [
        111_200,
        74_500,
    ]
    assert np.median(np.linalg.norm(off, axis=1)) < 30


@pytest.mark.slow
def test_a_long_log_was_refused_though_it_has_times(roofs, tmp_path, caplog):
    """`which are of one moment? expected one row a moment`,
    though rows of one scan have one time.
    """
    ckpt, folder, _ = roofs
    head, *rows = [row.split(",") for row in (folder / "phone.csv").read_text().splitlines()]
    links = [
        (int(row[0]), name, level)
        for row in rows
        for name, level in zip(head[1:], row[1:], strict=True)
    ]

    def log(name, columns, line):
        (tmp_path / f"{name}.csv").write_text(
            "\n".join([columns, *(line(*link) for link in links)]) + "\n"
        )
        return f"ckpt={ckpt}", f"data='{tmp_path}/{name}.csv'", "calibrate=0"

    timed = log("timed", "date,time,cell,rssi", lambda i, a, b: f"2026-11-27,10:00:{i:02d},{a},{b}")
    wide = located(tmp_path / "wide", f"ckpt={ckpt}", f"data='{folder}/phone.csv'", "calibrate=0")[
        1
    ]
    with caplog.at_level("INFO"):
        found = located(tmp_path / "run", *timed)[1]
    assert "20 snapshots in 59 rows" in caplog.text
    # Of one column of times, which was read as x.
    stamped = log(
        "stamped", "Timestamp,cell,rssi", lambda i, a, b: f"2026-11-27 10:00:{i:02d},{a},{b}"
    )
    assert located(tmp_path / "stamped", *stamped)[1] == found
    assert [[row[axis] for axis in "xy"] for row in found] == [
        [row[axis] for axis in "xy"] for row in wide
    ]
    for name, columns, line, said in (
        (
            "scan",
            "scan,cell,rssi",
            lambda i, a, b: f"{i},{a},{b}",
            "expected a column of times, or one row",
        ),
        (
            "day",
            "date,cell,rssi",
            lambda i, a, b: f"2026-11-27,{a},{b}",
            "'date' has 1 values in 60 rows",
        ),
        (
            "each",
            "time,cell,rssi",
            lambda i, a, b: f"{i}.{a[-1]},{a},{b}",
            "'time' has 60 values in 60 rows",
        ),
        (
            "gap",
            "time,cell,rssi",
            lambda i, a, b: f"{i or ''},{a},{b}",
            "'time' has 20 values in 60 rows, 3 empty",
        ),
    ):
        with pytest.raises(DataError, match=said):
            located(tmp_path / name, *log(name, columns, line))


def test_a_final_model_spoke_of_test_rows_alone(roofs, tmp_path):
    """`eval_on=test: the split has no test rows`, and no word of what to do."""
    with pytest.raises(
        DataError, match=r"has no test rows; say data=FILE of what is to be located, or eval_on"
    ):
        located(tmp_path / "run", f"ckpt={roofs[0]}")


@pytest.mark.slow
def test_each_call_calibrated_anew_for_minutes(roofs, tmp_path, monkeypatch, caplog):
    """Areas were calibrated anew by every call, though the checkpoint held what was learned."""
    monkeypatch.setattr(locator, "HELD_OUT", 6)
    ckpt = shutil.copy(roofs[0], tmp_path / "model.ckpt")
    given = f"ckpt={ckpt}", f"data='{roofs[1]}/phone.csv'", "rows=3"
    first, rows = located(tmp_path / "first", *given, "calibrate=2")
    with caplog.at_level("INFO"):
        again, same = located(tmp_path / "again", *given, "calibrate=2")
    assert "calibrated before, on" in caplog.text and same == rows
    assert again["locate/calibrated_on"] == first["locate/calibrated_on"] > 0
    caplog.clear()
    with caplog.at_level("INFO"):
        located(tmp_path / "other", *given, "calibrate=2", "share=0.8")
    assert "calibration 1 of 2" in caplog.text


@pytest.mark.slow
def test_200_snapshots_left_out_were_each_sought_twice_from_the_coarse_grid_on(
    roofs, tmp_path, monkeypatch, caplog
):
    """Minutes before the first answer of a model of many stations."""
    monkeypatch.setattr(locator, "TRUSTED", 8)
    monkeypatch.setattr(locator, "HELD_OUT", 20)
    ckpt, before = shutil.copy(roofs[0], tmp_path / "model.ckpt"), []
    search = locator.Locator.search_cells
    counted = lambda *given: before.append(given[3:]) or search(*given)  # noqa: E731
    monkeypatch.setattr(locator.Locator, "search_cells", counted)
    with caplog.at_level("INFO"):
        facts, _ = located(
            tmp_path / "run", f"ckpt={ckpt}", "eval_on=train", "rows=1", "calibrate=2"
        )
    assert (
        facts["locate/calibrated_on"] == 20
        and ("calibrated on 20 left-out snapshots") in caplog.text
    )
    assert [bool(one and one[0]) for one in before[:48]] == [False] * 8 + [True] * 8 + [
        False
    ] * 12 + [True] * 20


@pytest.mark.slow
def test_the_log_showed_trust_as_an_object(roofs, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(locator, "HELD_OUT", 3)
    given = f"ckpt={roofs[0]}", "store=false", "eval_on=train", "rows=1", "calibrate=2"
    with caplog.at_level("INFO"):
        located(tmp_path / "run", *given)
    assert "3 left-out snapshots: areas take 100.0 %" in caplog.text and "Trust(" not in caplog.text


@pytest.mark.slow
def test_a_calibration_of_another_plan_or_prior_was_taken(roofs, tmp_path, monkeypatch, caplog):
    """A plan that changed under its name was not noticed,
    and `calibrate=0` took whatever was stored.
    """
    monkeypatch.setattr(locator, "HELD_OUT", 6)
    ckpt, paper = (
        shutil.copy(roofs[0], tmp_path / "model.ckpt"),
        np.full((40, 40, 3), 255, np.uint8),
    )
    low, high = (site := checkpoint.read(ckpt).site).moving_box[:, :2] + site.origin[:2]
    points = f"plan_points=[[0,40,{low[0]},{low[1]}],[40,40,{high[0]},{low[1]}]]"
    given = f"ckpt={ckpt}", "eval_on=train", "rows=1", f"plan='{tmp_path}/plan.png'", points
    said = []
    for number, wall in enumerate((0, 0, 20)):
        paper[:, :wall] = 0
        Image.fromarray(paper).save(tmp_path / "plan.png")
        caplog.clear()
        with caplog.at_level("INFO"):
            located(tmp_path / str(number), *given, "calibrate=2")
        said += [
            [word in caplog.text for word in ("calibrated before", "calibration was of cells=")]
        ]
    assert said == [[False, False], [True, False], [False, True]]
    located(tmp_path / "stored", *given, "calibrate=0")
    with pytest.raises(
        ValueError, match=r"was calibrated with plan=.*, plan_points=.*, cells=\w{8}: "
    ):
        located(tmp_path / "box", *given[:3], "calibrate=0")


def test_ctrl_c_lost_all_that_was_located(tmp_path):
    """`locate.csv` was written at the end alone."""

    def found():
        yield from range(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_as_found(found(), tmp_path / "locate.csv", lambda some: {"x": some})
    assert (tmp_path / "locate.csv").read_text().split() == ["x", "0", "1", "2"]


@pytest.mark.slow
def test_what_was_heard_beyond_the_trained_places_was_located_at_their_edge_unsaid(
    tmp_path, capsys
):
    """Areas of 90 % held none of 35 places of a hall's other part, without a word."""
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 30, (160, 2)) * [1, 0.5]
    level = -40 - 25 * np.log10(
        1 + np.linalg.norm(place[:, None] - [[0, 0], [15, 20], [18, -5]], axis=2)
    )
    rows = np.hstack([place, level + rng.normal(0, 0.5, level.shape)])
    far = place[:, 0] > 20
    for name, part in (("a", rows[~far]), ("b", rows[far])):
        np.savetxt(
            tmp_path / f"{name}.csv", part, "%.3f", ",", header="x,y,AP1,AP2,AP3", comments=""
        )
    ckpt = towns.trained(tmp_path / "a.csv", "gp")
    facts, found = located(
        tmp_path / "run", f"ckpt={ckpt}", f"data='{tmp_path}/b.csv'", "calibrate=0"
    )
    beyond = [row["doubt"] == "beyond the trained places" for row in found]
    assert facts["locate/beyond"] == sum(beyond) > 0.6 * len(found)
    assert facts["locate/median_m"] < 0.3 * facts["baseline/nearest/median_m"], (
        "sought beyond the edge"
    )
    said = capsys.readouterr().out
    assert (
        f"{sum(beyond)} of {len(found)} snapshots are beyond the trained places: no promise"
    ) in said
    assert f"{len(found)} true places lie outside" in said
    facts, found = located(tmp_path / "own", f"ckpt={ckpt}", "calibrate=0")
    assert facts["locate/beyond"] <= 0.2 * len(found)


def test_a_method_without_variance_is_refused_in_one_line(tmp_path):
    ckpt = towns.trained(powers(tmp_path / "own.npz"), "idw")
    with pytest.raises(ValueError, match="idw states no variance"):
        located(tmp_path / "run", f"ckpt={ckpt}", "calibrate=0")


def test_fingerprints_from_a_file_to_places(hall, tmp_path):
    facts, rows = located(tmp_path, *hall, "against=[nearest,weighted_knn]")
    assert len(rows) == facts["locate/snapshots"] == 60 and facts["split/train"] == 300
    assert set(rows[0]) == PLACED - UNPLACED - {"inside"} | set("xyz")
    assert facts["locate/median_m"] == pytest.approx(np.median(column(rows, "error_m")))
    assert facts["locate/median_m"] < facts["baseline/nearest/median_m"]
    assert "baseline/weighted_knn/median_m" not in facts, "is what locates them"
    assert facts["locate/coverage"] is None and len(facts["dataset/sha256"]) == 64


def test_a_mean_of_milliseconds_was_called_a_median(hall, tmp_path):
    facts, _ = located(tmp_path, *hall, "against=[]")
    assert facts["time/locate_ms"] > 0 and "time/locate_ms_p50" not in facts, (
        "all are located at once"
    )


def test_fingerprints_of_unknown_places(hall, tmp_path):
    more = f"data='{tmp_path}/unplaced.npz'", "rows=20"
    facts, rows = located(tmp_path, *hall, *more)
    assert len(rows) == 20 and set(rows[0]) == set("xyz")
    assert "locate/median_m" not in facts and facts["split/name"] == "file"
