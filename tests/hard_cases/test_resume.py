"""Resume: killed anywhere, also between two densifications or in the refit.

Remedy: everything per Gaussian is in the checkpoint (moments, gathered statistics, ids); data order and the
draws of densification are pure functions of (seed, step). Tolerance: none; figures and tensors are identical,
and so are the statistics of the last interval. Seconds, machine and memory differ.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from campaigns import brief, compose, spectra

from gsparc.commands.train import train
from gsparc.models import checkpoint

ROOT = Path(__file__).parents[2]
STEPS = 63  # a multiple of 7: the last checkpoint of a stage is its end
SETTINGS = (
    f"trainer.max_steps={STEPS}",
    "callbacks.checkpoint.every_n_train_steps=7",  # in the middle of an interval
    "trainer.val_check_interval=20",
    "callbacks=densify",
    "callbacks.densify.start=10",
    "callbacks.densify.interval=10",
    "callbacks.densify.stop=55",
    "callbacks.densify.grad_threshold=1e-5",
    "callbacks.densify.max_gaussians=400",
    "callbacks.reset.interval=25",
)
VARYING = ("time/", "machine/", "memory/", "git")


def start(file: Path, folder: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "train.py", *brief(file, *SETTINGS, *more), f"hydra.run.dir={folder}"]
    return subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(run: subprocess.Popen) -> str:
    said, _ = run.communicate(timeout=300)
    assert run.returncode == 0, said
    return said


def kill_at(run: subprocess.Popen, file: Path, saves: int, after_s: float = 0.0) -> int:
    """SIGKILL once `file` has been written `saves` times and `after_s` more; returns the step it holds."""
    seen: set[int] = set()
    while len(seen) < saves:
        assert run.poll() is None, run.communicate()[0]
        with contextlib.suppress(FileNotFoundError):
            seen.add(file.stat().st_mtime_ns)
        time.sleep(0.001)
    time.sleep(after_s)
    run.send_signal(signal.SIGKILL)
    run.communicate()
    assert run.returncode == -signal.SIGKILL, "it had finished before the kill"
    return checkpoint.read(file).extra["trainer"]["global_step"]


def facts(folder: Path) -> dict:
    found = json.loads((folder / "summary.json").read_text())
    timed = ("train_s", "render_ms", "ratio_to_copy")
    return {
        key: value
        for key, value in found.items()
        if not key.startswith(VARYING) and not any(word in key for word in timed)
    }


def different(a, b, where: str = "state") -> list[str]:
    """Places at which two nested states are not bit-identical."""
    if isinstance(a, torch.Tensor):
        return [] if a.dtype == b.dtype and torch.equal(a, b) else [where]
    if isinstance(a, dict):
        if a.keys() != b.keys():
            return [f"{where}: keys"]
        return [found for key in a for found in different(a[key], b[key], f"{where}.{key}")]
    if isinstance(a, (list, tuple)):
        if len(a) != len(b):
            return [f"{where}: length"]
        return [
            f for i, (x, y) in enumerate(zip(a, b, strict=True)) for f in different(x, y, f"{where}[{i}]")
        ]
    return [] if a == b else [where]


def assert_same(whole: Path, resumed: Path) -> None:
    assert facts(whole) == facts(resumed)
    one, two = checkpoint.read(whole / "model.ckpt"), checkpoint.read(resumed / "model.ckpt")
    assert different(one.state, two.state) == []
    last = [checkpoint.read(folder / "refit" / "last.ckpt").extra["trainer"] for folder in (whole, resumed)]
    assert different(last[0]["optimizer_states"], last[1]["optimizer_states"], "optimizer") == []
    gathered = [state["callbacks"]["Densify"] for state in last]
    assert different(*gathered, "statistics") == [] and gathered[0]["statistics"]["seen"].any()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run nobody disturbed."""
    folder = tmp_path_factory.mktemp("resume")
    file = spectra(folder / "own.npz")
    finish(start(file, folder / "whole"))
    sizes = checkpoint.read(folder / "whole" / "last.ckpt").state["inner"]["model"]["gaussians.ids"]
    assert len(sizes) > 40, "nothing was split: the test would show little"
    return folder / "whole", file


@pytest.fixture(scope="module")
def killed(whole, tmp_path_factory):
    """A run killed between two densifications."""
    cut = tmp_path_factory.mktemp("killed")
    step = kill_at(start(whole[1], cut), cut / "last.ckpt", saves=4)
    assert step % 10 and step < STEPS
    return cut


@pytest.mark.slow
def test_killed_between_two_densifications(whole, killed, tmp_path):
    folder, file = whole
    finish(start(file, tmp_path, f"ckpt_path={killed / 'last.ckpt'}"))
    assert_same(folder, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("forgetful", [False, True])
def test_a_checkpoint_of_parameters_and_moments_alone_breaks(whole, killed, tmp_path, forgetful):
    """Naive: what was gathered since the last densification is forgotten."""
    folder, file = whole
    content = torch.load(killed / "last.ckpt", weights_only=True)
    if forgetful:
        content["extra"]["trainer"]["callbacks"]["Densify"]["statistics"] = {}
    torch.save(content, tmp_path / "cut.ckpt")
    settings = brief(file, *SETTINGS, f"ckpt_path={tmp_path / 'cut.ckpt'}", "model.refit=false")
    _, objects = train(compose(*settings), tmp_path)
    undisturbed = checkpoint.read(folder / "last.ckpt").state["inner"]["model"]
    resumed = objects.methods[0].fitted().state_dict()
    resumed = {k: v for k, v in resumed.items() if not k.endswith((".low", ".high"))}  # calibrated after
    undisturbed = {k: v for k, v in undisturbed.items() if not k.endswith((".low", ".high"))}
    if forgetful and not different(undisturbed, resumed):
        pytest.skip("with this machine's instruction set what was forgotten decides alike")
    assert bool(different(undisturbed, resumed)) == forgetful


@pytest.mark.slow
@pytest.mark.parametrize("saves", [3, *(pytest.param(n, marks=pytest.mark.rare) for n in (1, 8))])
def test_killed_in_the_first_stage(whole, tmp_path, saves):
    folder, file = whole
    cut = tmp_path / "cut"
    kill_at(start(file, cut), cut / "last.ckpt", saves, after_s=0.01 * saves)
    finish(start(file, cut, f"ckpt_path={cut / 'last.ckpt'}"))
    assert_same(folder, cut)


@pytest.mark.slow
@pytest.mark.parametrize("saves", [4, *(pytest.param(n, marks=pytest.mark.rare) for n in (1, 7))])
def test_killed_in_the_refit(whole, tmp_path, saves):
    folder, file = whole
    cut = tmp_path / "cut"
    kill_at(start(file, cut), cut / "refit" / "last.ckpt", saves)
    finish(start(file, cut, f"ckpt_path={cut / 'refit' / 'last.ckpt'}"))
    assert_same(folder, cut)


@pytest.mark.slow
def test_killed_again_and_again(whole, tmp_path):
    folder, file = whole
    cut = tmp_path / "cut"
    more: list[str] = []
    for _ in range(3):
        kill_at(start(file, cut, *more), cut / "last.ckpt", saves=2)
        more = [f"ckpt_path={cut / 'last.ckpt'}"]
    finish(start(file, cut, *more))
    assert_same(folder, cut)
