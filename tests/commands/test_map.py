"""`gsparc map` and `gsparc plan`: files whole, a promise kept with the model, errors in one line."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from campaigns import compose
from hydra.core.hydra_config import HydraConfig
from PIL import Image
from towns import town_model

import gsparc
from gsparc.maps import map_of

ROOT = Path(__file__).parents[2]


def run(command, *settings, folder):
    line = [sys.executable, "-m", "gsparc", command, *settings, f"hydra.run.dir={folder}", "threads=1"]
    return subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return Path(shutil.copy(town_model(), tmp_path_factory.mktemp("model") / "model.ckpt"))


@pytest.fixture(scope="module")
def mapped(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    Image.new("RGB", (400, 300), "white").save(folder / "floor.png")
    plan = [f"plan={folder / 'floor.png'}", "plan_points=[[0,300,0,0],[400,300,80,0]]"]
    done = run("map", f"ckpt={model}", "step_m=2", "threshold_db=-85", *plan, folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, done.stdout


def test_every_layer_a_table_and_a_page(mapped):
    folder, said = mapped
    layers = ("power", "best_server", "sinr", "outage", "expected_error", "width", "power_west", "power_east")
    assert all((folder / f"{name}.png").stat().st_size > 5000 for name in layers)
    facts = json.loads((folder / "summary.json").read_text())
    assert facts["promise/calibrated"] == 1 and 0.8 < facts["promise/held/share"] <= 1
    assert facts["map/stations"] == 2 and "held-out blocks" in said
    with np.load(folder / "map.npz") as found:
        told = np.isfinite(found["power_db"])
        assert found["power_db"].shape == (2, 30, 40) and told.mean() > 0.8
        assert (found["lower_db"] < found["upper_db"])[told].all()
        assert np.isnan(found["lower_db"][~told]).all()
    page = (folder / "map.html").read_text(encoding="utf-8")
    assert "best_server" in page and "http" not in page.replace("http-equiv", "")


def test_the_promise_stays_with_the_model(mapped, model):
    found = map_of(gsparc.load(model), step_m=5.0)
    assert found.calibrated and np.isfinite(found.power_db).any()
    far = map_of(gsparc.load(model), [0, 0, 200, 60], step_m=5.0)
    assert np.isnan(far.power_db[:, :, -1]).all() and far.refused[:, -1].all()
    near, edge = far.expected_error_db[0, 5, 5], np.nanmax(far.expected_error_db[0])
    assert edge > near


def test_a_plan_from_the_model(mapped, model, tmp_path):
    done = run("plan", f"ckpt={model}", "count=6", "route=true", "area=[-20,0,80,60]", folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "6 places: expected error" in done.stdout and "a walk of" in done.stdout
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 7 and (tmp_path / "plan.png").exists()


@pytest.mark.parametrize(
    ("command", "settings", "said"),
    [
        ("map", ["step_m=0"], "above 0 metres"),
        ("map", ["stations=[nord]"], "no station 'nord'"),
        ("map", ["plan=missing.png"], "no such file"),
        ("map", ["plan_points=[[0,0,0,0],[1,1,1,1]]"], "goes with an image"),
        ("map", ["promise.share=1.5"], "share=1.5"),
        ("map", ["dataset.file=gone.npz", "renew=true"], "gone.npz"),
        ("plan", ["count=0"], "at least 1"),
        ("place", [], "train with stations=together"),
    ],
)
def test_errors_come_before_anything_is_written(model, tmp_path, monkeypatch, command, settings, said):
    runtime = type("R", (), {"output_dir": tmp_path})
    monkeypatch.setattr(HydraConfig, "get", lambda: type("C", (), {"runtime": runtime}))
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        import_module(f"gsparc.commands.{command}").task(
            compose(f"ckpt='{model}'", *settings, config=command)
        )
    assert len(str(error.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_model_that_cannot_place_was_restored_before_it_said_so(model, tmp_path, monkeypatch):
    runtime = type("R", (), {"output_dir": tmp_path})
    monkeypatch.setattr(HydraConfig, "get", lambda: type("C", (), {"runtime": runtime}))
    place = import_module("gsparc.commands.place")
    monkeypatch.setattr(place, "load", lambda path: pytest.fail("all stations are restored"))
    with pytest.raises(ValueError, match="train with stations=together"):
        place.task(compose(f"ckpt='{model}'", config="place"))


def test_errors_are_one_line(model, tmp_path):
    done = run("map", f"ckpt={model}", "step_m=0", folder=tmp_path / "run")
    assert done.returncode == 1 and "above 0 metres" in done.stderr
    assert len([line for line in done.stderr.splitlines() if line.startswith("error:")]) == 1


def test_an_interrupt_leaves_no_half_written_file(model, tmp_path):
    line = [sys.executable, "-m", "gsparc", "map", f"ckpt={model}", "step_m=0.03", "promised=false"]
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # whoever runs the tests may ignore it
    running = subprocess.Popen(
        [*line, f"hydra.run.dir={tmp_path}", "threads=1"], cwd=ROOT, preexec_fn=heard,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    until = time.monotonic() + 60
    while not (tmp_path / "map.log").exists() and time.monotonic() < until:
        time.sleep(0.02)
    time.sleep(1.5)
    assert running.poll() is None, "it ended before it could be interrupted"
    running.send_signal(signal.SIGINT)
    began = time.monotonic()
    running.communicate(timeout=60)
    assert running.returncode == 130 and time.monotonic() - began < 10
    assert not [file for file in tmp_path.iterdir() if file.suffix in (".npz", ".png", ".html", ".partial")]
