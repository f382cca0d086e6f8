"""Resume: killed anywhere, also between two densifications or in the refit.

Remedy: everything per Gaussian is in the checkpoint (moments, gathered statistics, ids); data order and the
draws of densification are pure functions of (seed, step). Tolerance: none; figures and tensors are identical,
and so are the statistics of the last interval. Seconds, machine and memory differ. Killed again and again:
test_kills.py.
"""

from pathlib import Path

import pytest
import torch
from campaigns import compose
from crashes import STEPS, assert_same, killed_at, run, training
from states import different

from gsparc.commands.train import train
from gsparc.models import checkpoint

pytestmark = pytest.mark.slow
RARE = pytest.mark.rare


@pytest.fixture(scope="module")
def cut(undisturbed, tmp_path_factory) -> Path:
    """`last.ckpt` of a run killed between two densifications."""
    folder, settings, _ = undisturbed
    sizes = checkpoint.read(folder / "last.ckpt").state["inner"]["model"]["gaussians.ids"]
    assert len(sizes) > 40, "nothing was split: the test would show little"
    left = tmp_path_factory.mktemp("killed") / "last.ckpt"
    step = killed_at(left, 4, training, str(left.parent), settings)
    assert step % 10 and step < STEPS
    return left


@pytest.mark.parametrize("forgetful", [False, True])
def test_a_checkpoint_of_parameters_and_moments_alone_breaks(undisturbed, cut, tmp_path, forgetful):
    """Naive: what was gathered since the last densification is forgotten."""
    folder, settings, _ = undisturbed
    content = torch.load(cut, weights_only=True)
    if forgetful:
        content["extra"]["trainer"]["callbacks"]["Densify"]["statistics"] = {}
    torch.save(content, tmp_path / "cut.ckpt")
    settings = [*settings, f"ckpt_path={tmp_path / 'cut.ckpt'}", "model.refit=false"]
    _, objects = train(compose(*settings), tmp_path)
    states = (
        checkpoint.read(folder / "last.ckpt").state["inner"]["model"],
        objects.methods[0].fitted().state_dict(),
    )
    calibrated = (".low", ".high")  # after training
    states = [{k: v for k, v in state.items() if not k.endswith(calibrated)} for state in states]
    if forgetful and not different(*states):
        pytest.skip("with this machine's instruction set what was forgotten decides alike")
    assert bool(different(*states)) == forgetful


@pytest.mark.parametrize(
    "stage,saves",
    [("", 3), ("refit", 4), *(pytest.param(*case, marks=RARE) for case in (("", 1), ("", 5), ("refit", 1)))],
)
def test_killed_in_each_stage(undisturbed, tmp_path, stage, saves):
    folder, settings, _ = undisturbed
    left = tmp_path / stage / "last.ckpt"
    killed_at(left, saves, training, str(tmp_path), settings, after_s=0 if stage else 0.01 * saves)
    assert run(training, str(tmp_path), [*settings, f"ckpt_path={left}"])[0] == 0
    assert_same(folder, tmp_path)
