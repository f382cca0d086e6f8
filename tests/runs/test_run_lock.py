"""Two runs in one folder: the second is refused before it writes, whatever became of the first."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from campaigns import compose, powers
from doors import assert_refused, knock
from omegaconf import OmegaConf
from refusals import refused

from gsparc.commands.listing import COMMANDS
from gsparc.commands.train import train
from gsparc.evaluation.results import read_run
from gsparc.models import checkpoint
from gsparc.runs import run_lock
from gsparc.runs.ledger import LEFT
from gsparc.runs.open_runs import open_run
from gsparc.runs.run_lock import LOCK, RunLock, hold_folder, locked, release_folders

HOLDS = "import sys, time; from gsparc.runs.run_lock import hold_folder; from pathlib import Path; "
HOLDS += "hold_folder(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"


@pytest.fixture
def other(tmp_path):
    """Another process that holds the folder."""
    run = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None and run.stdout.readline() == "held\n"
    yield run
    run.kill()
    run.wait()


def test_two_runs_in_one_directory(other, tmp_path):
    """`summary.json` was of one and `model.ckpt` of the other, and both exited with 0."""
    given = ["ckpt=none.ckpt", f"hydra.run.dir={tmp_path}"]
    answer = knock(COMMANDS["evaluate"].run, "evaluate", given)
    assert_refused(answer, rf"another run writes here \(process {other.pid} on .* since .*: -c")
    assert not (tmp_path / ".hydra").exists()
    other.kill()  # without a chance to clean up
    other.wait()
    assert_refused(knock(COMMANDS["evaluate"].run, "evaluate", given), "no such checkpoint")


def test_training_from_python_took_no_lock(other, tmp_path):
    refused(f"another run writes here .process {other.pid}", train, OmegaConf.create({}), tmp_path)
    other.kill()
    other.wait()
    with locked(tmp_path), ThreadPoolExecutor(1) as thread:
        assert "another run writes here" in str(thread.submit(locked, tmp_path).exception())
    hold_folder(tmp_path)  # as a command does before it trains
    with locked(tmp_path):
        pass
    release_folders()


@pytest.mark.parametrize(
    "words",
    [
        ["hydra.run.dir={0}/0_seed-0"],
        ["-m", "eval_on=val,test", "hydra.sweep.dir={0}"],
        ["-m", "eval_on=val", "hydra.sweep.dir={1}", "hydra.sweep.subdir={2}"],
    ],
)
def test_folders_of_a_multirun_and_of_its_jobs_are_held(words, other, tmp_path):
    """A run into one of them passed, and a multirun wrote into the folder of a run that held it."""
    given = [
        word.format(tmp_path, tmp_path.parent, tmp_path.name) for word in (*words, "ckpt=none.ckpt")
    ]
    assert_refused(
        knock(COMMANDS["evaluate"].run, "evaluate", given), f"{tmp_path}: another run writes here"
    )
    assert not (tmp_path / ".hydra").exists()


@pytest.mark.parametrize("taken", [LOCK, "."])
def test_a_folder_that_cannot_be_locked_is_not_written_to(taken, tmp_path, recwarn):
    """Hydra made a warning of it, and the run went on without a lock."""
    folder = tmp_path / "run"
    if taken == ".":
        folder.write_text("a file")
    else:
        (folder / taken).mkdir(parents=True)
    given = ["ckpt=none.ckpt", f"hydra.run.dir={folder}"]
    assert_refused(
        knock(COMMANDS["evaluate"].run, "evaluate", given),
        r"run: cannot be locked \(.*give another",
    )
    assert not [w for w in recwarn if "RunLock" in str(w.message)]
    assert not (folder / ".hydra").exists()


def test_a_failed_run_left_its_split_beside_the_summary_of_the_one_before(tmp_path, monkeypatch):
    """Split and settings were of the new run, summary and model of the old one,
    and all readers took them.
    """
    file = powers(tmp_path / "own.npz")
    given = (
        "dataset=own",
        f"dataset.file={file}",
        "model=idw",
        "baselines=[]",
        "logger=none",
        "threads=1",
    )
    train(compose(*given), tmp_path / "run")
    first = json.loads((tmp_path / "run" / "summary.json").read_text())["run_id"]
    assert json.loads((tmp_path / "run" / "split.json").read_text())["run_id"] == first
    assert checkpoint.read(tmp_path / "run" / "model.ckpt").extra["run_id"] == first
    assert read_run(tmp_path / "run").facts["run_id"] == first
    with monkeypatch.context() as broken, pytest.raises(RuntimeError):
        broken.setattr(
            "gsparc.commands.train.evaluate", lambda *a, **b: (_ for _ in ()).throw(RuntimeError)
        )
        train(compose(*given, "split.seed=5", "model=gp"), tmp_path / "run")
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert not {"summary.json", "per_sample.csv", "test.png"} & left
    assert {"summary.json.earlier", "model.ckpt.earlier", "split.json.earlier"} <= left
    train(compose(*given, "split.seed=5"), tmp_path / "run")
    assert read_run(tmp_path / "run").facts["run_id"] != first

    for name in ("split.json", "per_sample.csv"):  # as a kill, or a copy by hand, may leave it
        train(compose(*given), tmp_path / "other")
        mixed = tmp_path / "other" / name
        mixed.write_bytes((tmp_path / "run" / name).read_bytes())
        refused("its summary, samples and split are of two runs", read_run, tmp_path / "other")
    models = [tmp_path / folder / checkpoint.MODEL for folder in ("run", "other")]
    refused("of different runs; give the folds of one", open_run, models, {})


@pytest.mark.parametrize(("goes_on", "kept"), [(None, False), ("run", True)])
def test_a_new_run_went_on_in_the_log_of_the_one_before(goes_on, kept, tmp_path, monkeypatch):
    (tmp_path / "train.log").write_text("of the first run")
    monkeypatch.setattr(run_lock, "_folder", lambda config, key: tmp_path)
    config = OmegaConf.create({"ckpt_path": goes_on, "hydra": {"output_subdir": ".hydra"}})
    try:
        RunLock().on_run_start(config)
    finally:
        release_folders()
    assert (tmp_path / "train.log").exists() == kept


def test_what_a_run_goes_on_from_is_not_set_aside(tmp_path):
    for name in LEFT[:3]:
        (tmp_path / name).write_text("{}")
    with pytest.raises(ValueError):
        train(compose(f"ckpt_path={tmp_path / 'model.ckpt'}"), tmp_path)
    assert {path.name for path in tmp_path.glob("*.json*")} == {
        "summary.json.earlier",
        "split.json",
    }


def test_half_written_files_of_killed_runs_stayed_for_ever(tmp_path):
    """`.NAME.PID.partial` of a process that is gone is deleted, of one that runs it is not."""
    here = tmp_path / "run"
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for name in (
        f".model.ckpt.{gone.pid}.partial",
        f"fold0/refit/.a.csv.{gone.pid}.partial",
        ".b.999999999999.partial",
    ):
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_text("half")
    (here / f"fold0/.map.{gone.pid}.partial").mkdir()
    kept = [here / f".c.json.{os.getppid()}.partial", here / ".mine.partial", here / ".d.e.partial"]
    for path in kept:
        path.write_text("half")
    hold_folder(here)
    release_folders()
    assert sorted(here.rglob("*.partial")) == sorted(kept)
