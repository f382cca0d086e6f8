"""Two runs in one folder: the second is refused before it writes, whatever became of the first."""

from __future__ import annotations

import subprocess
import sys

import pytest
from doors import assert_refused, knock
from omegaconf import OmegaConf

from gsparc.commands.listing import COMMANDS
from gsparc.commands.shared.run_lock import HOLDER, LOCK, InUse, hold, locked, release
from gsparc.commands.train import train

HOLDS = "import sys, time; from gsparc.commands.shared.run_lock import hold; from pathlib import Path; "
HOLDS += "hold(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"


@pytest.fixture
def other(tmp_path):
    """Another process that holds the folder."""
    run = subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE, text=True)
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
    assert not (tmp_path / HOLDER).exists()


def test_a_folder_of_a_multirun_is_held_too(other, tmp_path):
    given = ["-m", "ckpt=none.ckpt", "eval_on=val,test", f"hydra.sweep.dir={tmp_path}"]
    assert_refused(knock(COMMANDS["evaluate"].run, "evaluate", given), "another run writes here")


def test_training_from_python_took_no_lock(other, tmp_path):
    with pytest.raises(ValueError, match=f"another run writes here .process {other.pid}"):
        train(OmegaConf.create({}), tmp_path)
    other.kill()
    other.wait()
    with locked(tmp_path), pytest.raises(ValueError, match="another run writes here"), locked(tmp_path):
        pass
    hold(tmp_path)  # as a command does before it trains
    with locked(tmp_path):
        pass
    release()


def test_a_released_folder_is_free(tmp_path):
    hold(tmp_path)
    release()
    hold(tmp_path)
    with pytest.raises(InUse, match=r"another run writes here \(process \d+ on "):
        hold(tmp_path)
    release()


def test_folders_of_a_multiruns_jobs_are_held_with_it(other, tmp_path):
    """A run into one of them passed, and a multirun wrote into the folder of a run that held it."""
    given = ["ckpt=none.ckpt", f"hydra.run.dir={tmp_path / '0_seed-0'}"]
    assert_refused(knock(COMMANDS["evaluate"].run, "evaluate", given), f"{tmp_path}: another run writes here")
    given = ["-m", "ckpt=none.ckpt", "eval_on=val", f"hydra.sweep.dir={tmp_path.parent}"]
    given += [f"hydra.sweep.subdir={tmp_path.name}"]
    assert_refused(knock(COMMANDS["evaluate"].run, "evaluate", given), f"{tmp_path}: another run writes here")
    assert not (tmp_path / ".hydra").exists()


@pytest.mark.parametrize("taken", [LOCK, HOLDER, "."])
def test_a_folder_that_cannot_be_locked_is_not_written_to(taken, tmp_path, recwarn):
    """Hydra made a warning of it, and the run went on without a lock."""
    folder = tmp_path / "run"
    if taken == ".":
        folder.write_text("a file")
    else:
        (folder / taken).mkdir(parents=True)
    given = ["ckpt=none.ckpt", f"hydra.run.dir={folder}"]
    assert_refused(
        knock(COMMANDS["evaluate"].run, "evaluate", given), r"run: cannot be locked \(.*give another"
    )
    assert not [w for w in recwarn if "RunLock" in str(w.message)]
    assert not (folder / ".hydra").exists()
    if taken == HOLDER:
        (folder / taken).rmdir()
        hold(folder)  # the lock was not left behind
        release()
