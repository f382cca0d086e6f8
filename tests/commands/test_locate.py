"""`gsparc locate` from a trained model to its files."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from access_points import walks
from campaigns import compose, powers, spectra
from doors import assert_refused, knock
from PIL import Image

from gsparc.commands import locate
from gsparc.commands.listing import COMMANDS
from gsparc.commands.train import train
from gsparc.locate.likelihood import Trust
from gsparc.locate.locator import kept
from gsparc.locate.search import Unknown
from gsparc.models import checkpoint


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("locate")
    file = spectra(folder / "own.npz", rows=80)
    train(compose("dataset=own", f"dataset.file='{file}'", "model=gp", "baselines=[]", "logger=none"), folder)
    return folder / "model.ckpt"


def located(ckpt, folder, monkeypatch, *more):
    folder.mkdir(exist_ok=True)
    monkeypatch.setattr(locate, "run_directory", lambda: folder)
    facts = locate.task(compose(f"ckpt='{ckpt}'", *more, config="locate"))
    with (folder / "locate.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return facts, rows


def test_places_areas_and_pictures_are_written(trained, tmp_path, monkeypatch):
    facts, rows = located(trained, tmp_path, monkeypatch, "calibrate=2", "against=[nearest,weighted_knn]")
    stored = json.loads((tmp_path / "summary.json").read_text())
    assert set(rows[0]) == {
        "x", "y", "z", "x_true", "y_true", "z_true", "error_m", "area_m2", "inside", "modes",
    }  # fmt: skip
    error = [float(row["error_m"]) for row in rows]
    assert (
        stored["locate/median_m"] == pytest.approx(np.median(error))
        and len(rows) == facts["locate/snapshots"]
    )
    assert stored["locate/median_m"] < 0.5 * stored["baseline/nearest/median_m"]
    assert stored["time/locate_ms_p50"] > 0 and 0 <= stored["locate/coverage"] <= 1
    assert (tmp_path / "posteriors.png").stat().st_size > 10_000 and (tmp_path / "errors.png").exists()
    assert "locate" in checkpoint.read(trained).extra


def test_a_file_without_places_is_located_too(trained, tmp_path, monkeypatch):
    file = tmp_path / "other.npz"
    with np.load(spectra(tmp_path / "all.npz", rows=80)) as stored:
        true = stored["tx_position"][:6]
        np.savez(file, spectrum=stored["spectrum"][:6], rx_position=stored["rx_position"])
    _, rows = located(trained, tmp_path / "run", monkeypatch, f"data='{file}'", "calibrate=0")
    assert len(rows) == 6 and set(rows[0]) == {"x", "y", "z", "area_m2", "modes"}
    found = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.3


def test_trust_of_other_settings_is_not_taken_in_silence(trained, tmp_path, monkeypatch):
    """`calibrate=0 share=0.5` used the level that was learned for 90 % of places."""
    checkpoint.amend(trained, kept(Trust(level=0.95), Unknown(), 0.9))
    with pytest.raises(ValueError, match=r"was calibrated with share=0\.9"):
        located(trained, tmp_path, monkeypatch, "calibrate=0", "share=0.5")


def test_nobody_is_located_in_a_wall(trained, tmp_path, monkeypatch):
    plan = np.full((40, 100, 3), 255, np.uint8)
    plan[:, 50:] = 0  # the right half of the room
    Image.fromarray(plan).save(tmp_path / "plan.png")
    low, high = (site := checkpoint.read(trained).site).moving_box[:, :2] + site.origin[:2]
    points = f"plan_points=[[0,40,{low[0]},{low[1]}],[100,40,{high[0]},{low[1]}]]"
    more = ("calibrate=0", f"plan='{tmp_path}/plan.png'", points)
    _, rows = located(trained, tmp_path / "run", monkeypatch, *more)
    assert all(float(row["x"]) <= 0.5 * (low + high)[0] + 0.3 for row in rows)
    assert any(float(row["x_true"]) > 0.5 * (low + high)[0] + 0.3 for row in rows)


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """Fingerprints of 12 walks through a hall, beside them one spoilt file each."""
    folder, rows = tmp_path_factory.mktemp("fingerprints"), walks(12, 0)
    held = {"rss_dbm": rows.level, "position": rows.position, "walk": rows.walk, "time_s": rows.time_s}
    held["access_point"] = rows.access_point
    spoilt = {
        "walks": held,
        "unplaced": {name: part for name, part in held.items() if name != "position"},
        "timeless": {name: part for name, part in held.items() if name != "time_s"},
        "silent": {**held, "rss_dbm": np.full_like(rows.level, np.nan)},
        "loud": {**held, "rss_dbm": np.where(np.isnan(rows.level), 100, rows.level)},
        "short": {**held, "position": rows.position[1:]},
        "others": {**held, "access_point": np.array([f"x{name}" for name in rows.access_point])},
        "endless": {**held, "position": np.full_like(rows.position, np.inf)},
    }
    for name, parts in spoilt.items():
        np.savez(folder / f"{name}.npz", **parts)
    (folder / "table.csv").write_text("WAP001,LONGITUDE\n-60,1\n")
    (folder / "text.npz").write_text("no archive")
    return folder


OWN = ("ckpt={model}",)
HALL = ("dataset=fingerprints", "dataset.file={walks}/walks.npz", "dataset.split=walks")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "ckpt is not set"),
        (("ckpt=none.ckpt",), "none.ckpt: no such checkpoint"),
        ((*OWN, "prior=wall"), "prior='wall': one of box, trained is needed"),
        ((*OWN, "share=1.5"), "share=1.5: a number above 0 and below 1"),
        ((*OWN, "share=many"), "share='many': a number"),
        ((*OWN, "offset_db=-1"), "offset_db=-1: a number of at least 0"),
        ((*OWN, "calibrate=-1"), "calibrate=-1: a whole number of at least 0"),
        ((*OWN, "rows=0"), "rows=0: a whole number of at least 1"),
        ((*OWN, "track=perhaps"), "track='perhaps': one of true, false"),
        ((*OWN, "against=[wknn]"), "against='wknn': one of nearest, knn, weighted_knn"),
        ((*OWN, "data=none.npz"), "none.npz: no such file"),
        ((*OWN, "data={walks}/walks.npz"), "walks.npz"),
        (("dataset=fingerprints",), "give dataset.file=FILE, and no ckpt"),
        ((*HALL, *OWN), "give dataset.file=FILE, and no ckpt"),
        ((*HALL, "dataset.file=none.npz"), "none.npz: no such file"),
        ((*HALL, "dataset.file={walks}/text.npz"), "text.npz"),
        ((*HALL, "dataset.file={walks}/table.csv"), "no column LATITUDE"),
        ((*HALL, "dataset.file={walks}/unplaced.npz"), "position: missing"),
        ((*HALL, "dataset.file={walks}/silent.npz"), "no row heard an access point"),
        ((*HALL, "dataset.file={walks}/loud.npz"), "found 100 in row"),
        ((*HALL, "dataset.file={walks}/short.npz"), "position: expected shape"),
        ((*HALL, "dataset.file={walks}/endless.npz"), "finite coordinates"),
        ((*HALL, "dataset.file={walks}/timeless.npz", "track=true"), "does not say when its rows were heard"),
        ((*HALL, "data={walks}/others.npz"), "no access point of"),
        ((*HALL, "dataset.split=walk"), "'walk' is none of .*; did you mean 'walks'"),
        ((*HALL, "dataset.split=released"), "split=released: the file names no such rows"),
        ((*HALL, "dataset.held_out=2"), "dataset.held_out=2: a number above 0 and below 1"),
        ((*HALL, "dataset.side_m=-1", "dataset.split=blocks"), "dataset.side_m=-1: a number above 0"),
    ],
)
def test_spoilt_input_is_one_line(trained, walked, tmp_path, words, said):
    given = [word.format(model=trained, walks=walked) for word in words]
    folder = tmp_path / "run"
    answer = knock(COMMANDS["locate"].run, "locate", [f"hydra.run.dir={folder}", "calibrate=0", *given])
    assert_refused(answer, said, folder)


def test_a_method_without_variance_is_refused_in_one_line(tmp_path, monkeypatch):
    file = powers(tmp_path / "own.npz")
    train(
        compose("dataset=own", f"dataset.file='{file}'", "model=idw", "baselines=[]", "logger=none"), tmp_path
    )
    with pytest.raises(ValueError, match="idw states no variance"):
        located(tmp_path / "model.ckpt", tmp_path / "run", monkeypatch, "calibrate=0")


def test_fingerprints_from_a_file_to_places(walked, tmp_path, monkeypatch):
    monkeypatch.setattr(locate, "run_directory", lambda: tmp_path)
    words = [word.format(walks=walked) for word in HALL]
    more = ("calibrate=1", "against=[nearest]", "track=true", "offset_db=0")
    facts = locate.task(compose(*words, *more, config="locate"))
    with (tmp_path / "locate.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    error = [float(row["error_m"]) for row in rows]
    assert len(rows) == facts["locate/snapshots"] == 60 and facts["split/train"] == 300
    assert facts["locate/median_m"] == pytest.approx(np.median(error))
    assert facts["locate/median_m"] < 0.8 * facts["baseline/nearest/median_m"]
    assert facts["locate/alone/median_m"] > 0 and 0.6 < facts["locate/coverage"] <= 1
    assert facts["locate/calibrated_on"] == 60 and len(facts["dataset/sha256"]) == 64
    assert (tmp_path / "posteriors.png").stat().st_size > 10_000 and (tmp_path / "errors.png").exists()


def test_fingerprints_of_unknown_places(walked, tmp_path, monkeypatch):
    monkeypatch.setattr(locate, "run_directory", lambda: tmp_path)
    words = [word.format(walks=walked) for word in HALL]
    more = (f"data='{walked}/unplaced.npz'", "calibrate=0", "rows=20", "prior=trained", "against=[]")
    facts = locate.task(compose(*words, *more, config="locate"))
    with (tmp_path / "locate.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 20 and set(rows[0]) == {"x", "y", "z", "area_m2", "modes"}
    assert "locate/median_m" not in facts and facts["split/name"] == "file"


def test_a_track_of_a_trained_model(trained, tmp_path, monkeypatch):
    facts, rows = located(trained, tmp_path, monkeypatch, "calibrate=0", "track=true", "against=[]")
    assert facts["locate/track"] == 1 and len(rows) == facts["locate/snapshots"]
    assert facts["locate/alone/median_m"] > 0
