"""Kills: SIGKILL at random moments of training; tests/simulate/test_campaign.py cuts simulations.

Remedy: every file appears by renaming (gsparc/models/checkpoint.py, gsparc/simulate/assembly.py);
all that a run needs to go on is in its last checkpoint, or in its finished shards. Shown: after
any kill what is there is whole; going on always works; the end is bit-identical to an
uninterrupted run's. Tolerance: none.
"""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from crashes import assert_same, killed, last_checkpoint, moments, run, training

from gsparc.models import checkpoint


def assert_whole(folder: Path) -> None:
    """Whatever a kill left under its own name is complete; partial files have other names."""
    for path in folder.rglob("*"):
        if path.name.startswith(".") or path.name.endswith(".partial"):
            continue
        if path.suffix == ".ckpt":
            checkpoint.read(path)
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".npz":
            assert zipfile.is_zipfile(path) and np.load(path).files


def sooner(folder: Path):
    """Folders and shares of the seconds: kills come sooner
    where a run ended before the first of them.

    The machine may have been busy while the run that nobody disturbed was timed.
    """
    for attempt in range(4):
        here = folder / str(attempt)
        here.mkdir()
        yield here, 0.4**attempt


# At once: tests/commands/test_resumed.py, tests/simulate/test_campaign.py
pytestmark = pytest.mark.slow
CHAINS = pytest.mark.parametrize(
    "chain", [1, *(pytest.param(one, marks=pytest.mark.rare) for one in (0, 2))]
)


@CHAINS
def test_training_killed_again_and_again(undisturbed, tmp_path, chain):
    """Kills in a row, each of a run that goes on from what the one before it left."""
    whole, settings, seconds = undisturbed
    for folder, share in sooner(tmp_path):
        kills = 0
        for moment in moments(5 if chain else 3, share * seconds, seed=chain):
            if not killed(
                training, str(folder), [*settings, *last_checkpoint(folder)], after_s=moment
            ):
                break
            kills += 1
            assert_whole(folder)
        if kills:
            break
    assert kills, "every run had ended before it was killed"
    code, _ = run(training, str(folder), [*settings, *last_checkpoint(folder)])
    assert code == 0, (folder / "error.txt").read_text()
    assert_same(whole, folder)
