"""`gsparc locate` from a trained model to its files."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from campaigns import compose, powers, spectra
from PIL import Image

from gsparc.commands import locate
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


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("prior=wall", "prior=wall: one of box, trained"),
        ("share=1.5", "share=1.5: a number between 0 and 1"),
        ("offset_db=-1", "offset_db=-1"),
        ("against=[wknn]", "against: no baseline 'wknn'; there are nearest"),
    ],
)
def test_a_wrong_setting_is_one_line(trained, tmp_path, monkeypatch, setting, said):
    with pytest.raises(ValueError, match=r"^[^\n]*$") as raised:
        located(trained, tmp_path, monkeypatch, setting, "calibrate=0")
    assert said in str(raised.value)


def test_a_method_without_variance_is_refused_in_one_line(tmp_path, monkeypatch):
    file = powers(tmp_path / "own.npz")
    train(
        compose("dataset=own", f"dataset.file='{file}'", "model=idw", "baselines=[]", "logger=none"), tmp_path
    )
    with pytest.raises(ValueError, match="idw states no variance"):
        located(tmp_path / "model.ckpt", tmp_path / "run", monkeypatch, "calibrate=0")
