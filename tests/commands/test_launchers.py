"""A sweep through a launcher loses a job: the same command goes on with it,
and nothing is done twice.
"""

import json
from collections import defaultdict
from pathlib import Path

import pytest
from campaigns import brief, spectra
from doors import Answer, knock

from gsparc.commands.train import main

ROOT = Path(__file__).parents[2]
STEPS, EVERY = 30, 10  # of each stage, and between checkpoints


def swept(folder: Path, launcher: str) -> Answer:
    """Two trainings; the first that comes to step 25 is killed, once."""
    kill = f"+callbacks.kill={{_target_: lost.KillOnce, step: 25, folder: '{folder}'}}"
    settings = brief(folder / "own.npz", "seed=0,1", f"callbacks.checkpoint.interval={EVERY}", kill)
    settings = [s for s in settings if not s.startswith("trainer.max_steps")]
    where = f"hydra.sweep.dir={folder / 'sweep'}", f"hydra/launcher={launcher}"
    return knock(main, "train.py", ["-m", *settings, f"trainer.max_steps={STEPS}", *where])


def ended(folder: Path) -> dict[Path, int]:
    """Records of jobs that have ended, and when they were written."""
    records = (folder / "sweep").glob("*/job.json")
    return {r: r.stat().st_mtime_ns for r in records if json.loads(r.read_text())["ended"]}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_killed_job_is_gone_on_with_and_nothing_is_done_twice(tmp_path, monkeypatch, launcher):
    package = f"hydra_{launcher.partition('_')[0]}_launcher"
    pytest.importorskip(f"hydra_plugins.{package}", reason=f"{package} is not installed")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests" / "helpers"))
    spectra(tmp_path / "own.npz")
    first = swept(tmp_path, launcher)
    assert first.status != 0 and (tmp_path / "killed").exists(), first
    assert "the same command goes on with the rest" in first.err[-1]
    assert not any("Traceback" in line for line in first.err)
    before = ended(tmp_path)
    assert len(before) <= 1
    again = swept(tmp_path, launcher)
    assert again.status == 0, again
    after = ended(tmp_path)
    assert len(after) == 2 and all(after[record] == written for record, written in before.items())
    taken = defaultdict(list)
    for line in (tmp_path / "steps").read_text().splitlines():
        step, stage = line.split(maxsplit=1)
        taken[Path(stage)].append(int(step))
    assert len(taken) == 4  # two stages of two jobs
    for stage, steps in taken.items():
        assert set(steps) == set(range(STEPS))
        if any(stage.is_relative_to(record.parent) for record in before):
            assert len(steps) == STEPS  # done in the first command, and then not again
        assert len(steps) - STEPS <= EVERY  # of one cut short, those after its last checkpoint
