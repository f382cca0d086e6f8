"""The command: a checkpoint and a folder in, summary.json and a table out, one line on error."""

import json
import os
import re
import sys

import numpy as np
import pandas as pd
import pytest
import towns
import yaml
from campaigns import channels, compose, powers
from doors import assert_refused, knock
from mirrors import mirrored
from refusals import refused

import gsparc
from gsparc.commands.evaluate import evaluate_files
from gsparc.commands.listing import COMMANDS
from gsparc.datasets.public.fetch import MIRROR
from gsparc.evaluation.console import ConsoleHandler
from gsparc.evaluation.summary import remarks
from gsparc.models import checkpoint, loading
from gsparc.models.checkpoint_content import CheckpointError


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A checkpoint of the nearest channel in a small room."""
    file = channels(tmp_path_factory.mktemp("evaluate") / "own.npz")
    return towns.trained(file, "nearest", "seed=3", "threads=1")


def test_the_command_leaves_summary_samples_and_table(trained, tmp_path):
    given = f"ckpt={trained}", f"hydra.run.dir={tmp_path / 'run'}", "eval_on=test", "threads=1"
    done = knock(COMMANDS["evaluate"].run, "evaluate", [*given])
    assert done.status == 0, done
    facts = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert facts["test/nmse"] == facts["baseline/nearest/nmse"] and facts["test/skill"] == 0
    assert facts["seed"] == 3 and facts["machine/threads"] == 1
    assert facts["dataset/name"] and facts["versions"]
    assert {"per_sample.csv", "split.json"} <= {path.name for path in (tmp_path / "run").iterdir()}
    table = "\n".join(done.out)
    assert all(word in table for word in ("query", "nearest", "complex_gp"))


@pytest.mark.slow
def test_every_command_repeated_how_columns_are_read(tmp_path, monkeypatch):
    """Ten lines stood above each answer; evaluate said nothing, of another file either."""
    rng = np.random.default_rng(0)

    def drive(name, heads):
        rows = [f"{x:.1f},{y:.1f},{-60 - x:.1f}" for x, y in rng.uniform(0, 9, (40, 2))]
        (tmp_path / name).write_text("\n".join([heads, *rows]))
        return tmp_path / name

    def said(command, *given):
        monkeypatch.setattr(ConsoleHandler, "read", set())  # as a process of its own begins
        done = knock(
            COMMANDS[command].run, command, [*given, f"hydra.run.dir={tmp_path / command}"]
        )
        assert done.status == 0, done
        return [line for line in done.out if "taken as" in line]

    first, model = drive("a.csv", "x,y,rsrp_dbm"), f"ckpt={tmp_path / 'train' / 'model.ckpt'}"
    own = "dataset=own", f"dataset.file={first}", "model=idw", "threads=1", "baselines=[]"
    assert len(said("train", *own)) == 3
    assert said("evaluate", model, "baselines=[]") == [] == said("map", model, "step_m=5")
    (other,) = said(
        "evaluate", model, "baselines=[]", f"dataset.file={drive('b.csv', 'x,y,rssi_dbm')}"
    )
    assert "column 'rssi_dbm' taken as rssi_db" in other


def test_a_last_fit_from_all_rows_tests_nothing_and_serves_all_the_same(tmp_path):
    file = powers(tmp_path / "own.npz")
    given = [f"dataset.file={file}", "dataset=own", "split=none", "model=idw", "threads=1"]
    done = knock(COMMANDS["train"].run, "train", [*given, f"hydra.run.dir={tmp_path / 'run'}"])
    assert done.status == 0, done
    facts = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (facts["split/train"] + facts["split/val"], facts["split/test"]) == (80, 0)
    assert facts["time/train_s"] > 0 and not any(
        name.startswith(("test/", "baseline/")) for name in facts
    )
    said = "\n".join(done.out)
    assert "nothing was tested: all 80 rows were learned from (split=none)" in said
    # A count of three parts stood above it, and a table of dashes.
    assert "all 80 rows are learned from (8 of them" in said and "rmse_db" not in said
    own = {"name": "own", "file": str(file)}
    found, _, _ = evaluate_files([tmp_path / "run" / "model.ckpt"], own, eval_on="val")
    assert found.facts["val/rmse_db"] < 1  # an interpolator of rows that it has learned
    assert np.isfinite(gsparc.load(tmp_path / "run" / "model.ckpt").rssi(rx=[1.0, 1.0, 1.0]))


def test_a_last_fit_stood_beside_no_baseline(tmp_path):
    """A default behind `gp` on a whole campus said nothing of it: no row was tested."""
    file, run = powers(tmp_path / "own.npz"), tmp_path / "run"
    given = [f"dataset.file={file}", "dataset=own", "split=none", "threads=1"]
    done = knock(COMMANDS["train"].run, "train", [*given, f"hydra.run.dir={run}"])
    assert done.status == 0, done
    facts = json.loads((run / "summary.json").read_text())
    fold = json.loads((run / "split.json").read_text())["folds"][0]
    assert sorted(pd.read_csv(run / "per_sample.csv")["row"]) == sorted(fold["val"])
    # It answers these rows without them; they are what it knows afterwards.
    known = evaluate_files(
        [run / "model.ckpt"], {"name": "own", "file": str(file)}, eval_on="val", baselines=[]
    )[0].facts
    assert known["val/rmse_db"] < facts["val/rmse_db"] < facts["baseline/mean/rmse_db"]
    assert "the table leaves 8 out" in "\n".join(done.out)
    assert facts["baseline/mean/ahead_pairs"] == "8 left-out rows"  # not test rows


def test_evaluate_took_no_settings_of_the_data(tmp_path):
    """`dataset.absent` and columns of another file were no settings of its configuration."""
    town = towns.town_file(tmp_path / "town.npz", rows=60)
    with np.load(town) as stored:
        places, level = stored["rx_position"], stored["rssi_db"][:, 0]
    for name, head in (("first", "power"), ("second", "rx_level")):
        rows = [f"{x},{y},{one}" for (x, y, _), one in zip(places, level, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"a,b,{head}", *rows]))
    heads = "dataset.columns={x:a,y:b,z:1.5,rssi_db:power}"
    ckpt = towns.trained(tmp_path / "first.csv", "idw", heads, "threads=1")

    def evaluated(*more):
        given = (
            f"ckpt={ckpt}",
            f"hydra.run.dir={tmp_path / 'run'}",
            "threads=1",
            "baselines=[]",
            *more,
        )
        return knock(COMMANDS["evaluate"].run, "evaluate", given)

    second = f"dataset.file={tmp_path / 'second.csv'}", "dataset.columns.rssi_db=rx_level"
    assert (
        done := evaluated(*second, "dataset.absent=unknown", "dataset.max_rows=40")
    ).status == 0, done
    facts = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert facts["dataset/rows"] == 40
    assert_refused(evaluated("dataset.absnt=unknown"), "dataset=own; did you mean 'absent'")


def test_the_traceback_comes_when_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["evaluate", f"hydra.run.dir={tmp_path}", "ckpt=none.ckpt"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        COMMANDS["evaluate"].run()


def test_a_sweep_names_the_job_that_failed(tmp_path):
    given = ["-m", "ckpt=none.ckpt", "eval_on=val,test", f"hydra.sweep.dir={tmp_path}"]
    done = knock(COMMANDS["evaluate"].run, "evaluate", given)
    assert done.status == 1 and not any("Traceback" in line for line in done.err)
    assert any("overrides: ['ckpt=none.ckpt', 'eval_on=val']" in line for line in done.err), done
    assert done.err[-1] == "error: none.ckpt: no such checkpoint"


def test_rows_that_were_trained_on_were_warned_of_twice(trained, tmp_path):
    given = [f"ckpt={trained}", "split.name=corner", "baselines=[]", f"hydra.run.dir={tmp_path}"]
    done = knock(COMMANDS["evaluate"].run, "evaluate", given)
    assert done.status == 0, done
    assert sum("TRAINED on" in line for line in (*done.out, *done.err)) == 1, done


def test_another_subset_and_split(trained, caplog):
    found, _, _ = evaluate_files([trained], eval_on="val", baselines=["nearest"])
    assert found.facts["val/samples"] == found.facts["split/val"] and "TRAINED" not in caplog.text
    found, _, split = evaluate_files([trained], split={"name": "corner"})
    assert split.name == "corner" and "were TRAINED on" in caplog.text
    said = re.match(
        r"another split \(random\): (\d+) of these (\d+) test", found.facts["split/foreign"]
    )
    assert 0 < int(said[1]) < int(said[2]) == found.facts["split/test"]
    assert any("were TRAINED on" in line for line in remarks(found.facts))


def test_a_checkpoint_that_names_no_rows_is_marked_unless_its_settings_do(trained, tmp_path):
    """Written from Python: any split was taken for its own."""
    method, stored = loading.load(trained)
    bare = tmp_path / "bare.ckpt"
    checkpoint.save(bare, method, stored.config)
    assert evaluate_files([bare])[0].facts["split/foreign"] is None
    said = evaluate_files([bare], split={"name": "corner"})[0].facts["split/foreign"]
    assert re.match(
        r"another split \(random\): [1-9]\d* of these \d+ test rows were TRAINED on", said
    )
    checkpoint.save(bare, method)
    said = evaluate_files([bare], stored.configuration["dataset"], {"name": "random"})[0].facts[
        "split/foreign"
    ]
    assert said == "rows that it does not name; these test rows may have been TRAINED on"


def test_folds_need_their_checkpoints(trained, tmp_path):
    method, stored = loading.load(trained)
    fold = tmp_path / "fold.ckpt"
    checkpoint.save(fold, method, stored.config, {})
    refused("give as many checkpoints", evaluate_files, [fold, fold])
    checkpoint.save(fold, method, stored.config, {"fold": 4})
    refused("fold 4 was trained, split=random has 1 folds", evaluate_files, [fold])


def test_another_file_was_tested_on_a_fifth_beside_baselines_that_had_learned_its_rest(
    tmp_path, caplog
):
    """The baselines knew the new file, the model did not."""
    (tmp_path / "later").mkdir()
    file, later = channels(tmp_path / "own.npz"), tmp_path / "later" / "own.npz"
    model = towns.trained(file, "nearest")
    with np.load(file) as stored:
        moved = stored["rx_position"] + [0.02, 0.01, 0]
        np.savez(
            later, **{**stored, "rx_position": moved, "csi": np.roll(stored["csi"], 1, axis=0)}
        )
    found, data, split = evaluate_files([model], {"file": str(later)}, {"name": None})
    assert split.name == "whole" and found.facts["split/foreign"] is None
    assert not any("TRAINED" in one.message for one in caplog.records if one.levelname == "WARNING")
    assert found.facts["test/samples"] == found.facts["split/test"] == len(data) == 80
    assert "baseline/nearest/nmse" not in found.facts  # as asked
    found, *_ = evaluate_files([model], {"file": str(later)}, baselines=None)
    assert found.facts["test/nmse"] == found.facts["baseline/nearest/nmse"] > 0.5
    assert found.facts["split/without_baselines"] is None
    same, *_ = evaluate_files([model], {"file": str(file)}, baselines=["nearest"])
    assert same.facts["split/name"] == "random" and same.facts["split/foreign"] is None
    asked, _, split = evaluate_files(
        [model], {"file": str(later)}, {"name": "corner"}, baselines=["nearest"]
    )
    assert (
        split.name == "corner" and asked.facts["test/nmse"] == asked.facts["baseline/nearest/nmse"]
    )
    with pytest.raises(ValueError, match="eval_on=val: the split has no val rows"):
        evaluate_files([model], {"file": str(later)}, eval_on="val")
    file.unlink()
    found, *_ = evaluate_files([model], {"file": str(later)}, baselines=None)
    assert not [name for name in found.facts if name.startswith("baseline/")]
    assert found.facts["test/nmse"] > 0.5
    assert ("no baselines: the file that the model was trained on is gone, or another") in remarks(
        found.facts
    )


@pytest.fixture
def mirror(monkeypatch):
    """A server that is somebody else's, and notes what it is asked for."""
    with mirrored(monkeypatch) as server:
        yield server


@pytest.mark.parametrize(
    ("secret", "refused"),
    [("${oc.env:GSPARC_TOKEN}", r"has \$\{\.\.\.\}"), ("plain", "plain.parquet: no such file")],
)
def test_a_stranger_s_checkpoint_sent_secrets_away(
    trained, tmp_path, monkeypatch, mirror, secret, refused
):
    """A stored `dataset.file=http://HOST/${oc.env:NAME}.parquet` was asked for, twice."""
    monkeypatch.setenv("GSPARC_TOKEN", "very-secret")
    address = os.environ[MIRROR].rstrip("/")
    method, stored = loading.load(trained)
    config = yaml.safe_load(stored.config)
    config["dataset"] |= {"file": f"{address}/{secret}.parquet"}
    bad = tmp_path / "bad.ckpt"
    checkpoint.save(bad, method, yaml.safe_dump(config), dict(stored.extra))
    for command, more in (
        ("evaluate", []),
        ("map", ["step_m=1"]),
        ("calibrate", []),
        ("locate", []),
    ):
        given = [f"ckpt={bad}", f"hydra.run.dir={tmp_path / command}", "threads=1", *more]
        assert_refused(knock(COMMANDS[command].run, command, given), refused)
    assert not mirror.asked


@pytest.mark.parametrize(
    "name", ["calibrate", "link", "locate", "tradeoff", "map", "place", "plan", "view"]
)
def test_settings_of_data_were_refused_beside_their_file(name):
    """`dataset.not_heard: no such setting; there are file, name, root`,
    where `evaluate` took it.
    """
    given = "ckpt=model.ckpt", "dataset.not_heard=[100]", "dataset.columns.lat=B"
    found = compose(*given, config=name).dataset
    assert found == {
        "name": None,
        "root": None,
        "file": None,
        "not_heard": [100],
        "columns": {"lat": "B"},
    }
