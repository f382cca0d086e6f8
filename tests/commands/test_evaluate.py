"""The command: a checkpoint and a folder in, summary.json and a table out, one line on error."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from omegaconf import OmegaConf

from gsparc.commands.cli import run
from gsparc.commands.evaluate import evaluate_files
from gsparc.commands.listing import COMMANDS
from gsparc.data.load import load, split_for
from gsparc.evaluation.console import one_line
from gsparc.evaluation.open_runs import aligned
from gsparc.evaluation.summary import remarks
from gsparc.models import checkpoint, loading
from gsparc.models.baselines.nearest import Nearest
from gsparc.training.context import FitContext


@pytest.fixture
def room(tmp_path):
    """A small room in the layout of NeWRF: one transmitter, complex channels."""
    rng = np.random.default_rng(0)
    rx = rng.uniform(0, 4, (40, 3)) + np.array([1000, 0, 0])
    distance = np.linalg.norm(rx - [1002, 2, 1], axis=1)
    np.savez(
        tmp_path / "room.npz",
        tx_pos=np.array([1002.0, 2.0, 1.0]),
        rx_pos=rx,
        csi=(np.exp(-1j * distance) / distance).astype(np.complex64),
        frequency_hz=np.float64(2.4e9),
    )
    return tmp_path / "room.npz"


@pytest.fixture
def trained(room, tmp_path):
    config = {
        "dataset": {"name": "newrf", "file": str(room)},
        "split": {"name": "random"},
        "model": {"_target_": "gsparc.models.baselines.nearest.Nearest"},
        "seed": 3,
    }
    data = load(config["dataset"])
    split = split_for(config["split"], data)
    method = Nearest()
    seconds = method.fit(data, split.folds[0], FitContext(tmp_path)).seconds
    path = tmp_path / "nearest.ckpt"
    extra = {"train_s": seconds, "fold": 0, "split_sha256": split.sha256}
    checkpoint.save(path, method, OmegaConf.to_yaml(config), extra)
    return path


def command(*arguments, **environment):
    return subprocess.run(
        [sys.executable, "-m", "gsparc", "evaluate", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )


def test_the_command_leaves_summary_samples_and_table(trained, tmp_path):
    run = tmp_path / "run"
    cache = f"cache={tmp_path / 'cache'}"
    done = command(f"ckpt={trained}", f"hydra.run.dir={run}", "eval_on=test", cache, "threads=1")
    assert done.returncode == 0, done.stderr
    facts = json.loads((run / "summary.json").read_text())
    assert facts["test/nmse"] == facts["baseline/nearest/nmse"] and facts["test/skill"] == 0
    assert (
        facts["seed"] == 3 and facts["machine/threads"] == 1 and facts["dataset/name"] and facts["versions"]
    )
    assert (run / "per_sample.csv").exists() and (run / "split.json").exists()
    assert "query" in done.stdout and "nearest" in done.stdout and "complex_gp" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "error: ckpt is not set; give ckpt=..."),
        (["ckpt=none.ckpt"], "error: none.ckpt: no such checkpoint"),
        (["eval_onn=val"], "error: eval_onn: no such setting; did you mean 'eval_on'?"),
        (["dataset.rot=x"], "error: dataset.rot: no such setting; did you mean 'dataset.root'?"),
    ],
)
def test_an_error_is_one_clear_line(arguments, line, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["evaluate", f"hydra.run.dir={tmp_path}", *arguments])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit) as stopped:
        COMMANDS["evaluate"].run()
    assert stopped.value.code == 1 and capsys.readouterr().err.strip() == line


def test_the_traceback_comes_when_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["evaluate", f"hydra.run.dir={tmp_path}", "ckpt=none.ckpt"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(checkpoint.CheckpointError, match="no such checkpoint"):
        COMMANDS["evaluate"].run()


def test_a_sweep_names_the_job_that_failed(tmp_path):
    done = command("-m", "ckpt=none.ckpt", "eval_on=val,test", f"hydra.sweep.dir={tmp_path}")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "overrides: ['ckpt=none.ckpt', 'eval_on=val']" in done.stderr
    assert done.stderr.strip().endswith("error: none.ckpt: no such checkpoint")


def test_an_interrupt_is_not_an_error(tmp_path, monkeypatch, capsys):
    def interrupted(config):
        raise KeyboardInterrupt("go on with ckpt_path=last.ckpt")

    monkeypatch.setattr(sys, "argv", ["evaluate", f"hydra.run.dir={tmp_path}", "ckpt=x"])
    with pytest.raises(SystemExit) as stopped:
        run(interrupted, "evaluate")
    assert stopped.value.code == 130 and "go on with ckpt_path" in capsys.readouterr().err


def test_another_subset_and_split(trained, caplog):
    found, _, _ = evaluate_files([trained], eval_on="val", baselines=["nearest"])
    assert found.facts["val/samples"] == found.facts["split/val"] and not caplog.records
    found, _, split = evaluate_files([trained], split={"name": "corner"})
    assert split.name == "corner" and "were TRAINED on" in caplog.text
    said = re.match(r"another split \(random\): (\d+) of these (\d+) test", found.facts["split/foreign"])
    assert 0 < int(said[1]) < int(said[2]) == found.facts["split/test"]
    assert any("were TRAINED on" in line for line in remarks(found.facts))


def test_a_checkpoint_that_names_no_rows_is_marked_unless_its_settings_do(trained, tmp_path):
    """Written from Python: any split was taken for its own."""
    method, stored = loading.load(trained)
    bare = tmp_path / "bare.ckpt"
    checkpoint.save(bare, method, stored.config)
    assert evaluate_files([bare])[0].facts["split/foreign"] is None
    said = evaluate_files([bare], split={"name": "corner"})[0].facts["split/foreign"]
    assert re.match(r"another split \(random\): [1-9]\d* of these \d+ test rows were TRAINED on", said)
    checkpoint.save(bare, method)
    said = evaluate_files([bare], stored.configuration["dataset"], {"name": "random"})[0].facts[
        "split/foreign"
    ]
    assert said == "rows that it does not name; these test rows may have been TRAINED on"


def test_data_centred_elsewhere_are_moved_not_misread(trained, room):
    stored = checkpoint.read(trained)
    data = load({"name": "newrf", "file": str(room)})
    shift = np.array([0.25, -0.5, 0.125])
    site = dataclasses.replace(
        data.site,
        origin=data.site.origin + shift,
        static_position=data.site.static_position - shift,
        target_scale=data.site.target_scale * 4,
    )
    moved = dataclasses.replace(
        data, site=site, tx=data.tx - shift, rx_position=data.rx_position - shift, target=data.target / 4
    )
    back = aligned(moved, stored.site)
    assert np.allclose(back.moving, data.moving) and np.allclose(back.target, data.target)
    assert np.allclose(back.tx, data.tx) and np.array_equal(back.site.origin, data.site.origin)
    assert aligned(data, stored.site) is data
    away = data.site.static_position + np.array([1, 0, 0])
    for change, words in (
        ({"static_position": away}, "is 1 m from"),
        ({"kind": "rssi"}, "with kind csi"),
    ):
        other = dataclasses.replace(data, site=dataclasses.replace(data.site, **change))
        with pytest.raises(ValueError, match=words):
            aligned(other, stored.site)


def test_what_is_in_target_units_is_converted_with_the_target(trained, room):
    """An uplink kept its own unit: whoever hears it and predicts a downlink was wrong by the ratio."""
    stored = checkpoint.read(trained)
    data = load({"name": "newrf", "file": str(room)})
    heard = np.full((len(data), 2, 3), 1 + 1j, np.complex64)
    noise = np.full(len(data), 0.5, np.float32)
    louder = dataclasses.replace(data.site, target_scale=data.site.target_scale * 4)
    own = dataclasses.replace(
        data, site=louder, target=data.target / 4, uplink=heard / 4, noise_variance=noise / 16
    )
    back = aligned(own, stored.site)
    assert np.allclose(back.target, data.target)
    assert np.allclose(back.uplink, heard) and np.allclose(back.noise_variance, noise)
    assert back.uplink.dtype == np.complex64 and back.noise_variance.dtype == np.float32


def test_folds_need_their_checkpoints(trained):
    method, stored = loading.load(trained)
    checkpoint.save(trained, method, stored.config, {})
    with pytest.raises(ValueError, match="give as many checkpoints"):
        evaluate_files([trained, trained])
    checkpoint.save(trained, method, stored.config, {"fold": 4})
    with pytest.raises(ValueError, match="fold 4 was trained, split=random has 1 folds"):
        evaluate_files([trained])


def test_a_bug_is_named_by_its_type():
    assert one_line(KeyError("x")) == "KeyError: 'x' (HYDRA_FULL_ERROR=1 shows where)"
    assert one_line(ValueError("first line\nsecond")) == "first line"
    assert one_line(ValueError()) == "ValueError:  (HYDRA_FULL_ERROR=1 shows where)"
