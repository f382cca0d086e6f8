"""Two runs in one folder: the second is refused before it writes, whatever became of the first."""

from __future__ import annotations

import subprocess
import sys

import pytest
from doors import assert_refused, knock

from gsparc.commands.listing import COMMANDS
from gsparc.commands.run_lock import HOLDER, InUse, hold, release

HOLDS = "import sys, time; from gsparc.commands.run_lock import hold; from pathlib import Path; "
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


def test_a_released_folder_is_free(tmp_path):
    hold(tmp_path)
    release()
    hold(tmp_path)
    with pytest.raises(InUse, match=r"another run writes here \(process \d+ on "):
        hold(tmp_path)
    release()
