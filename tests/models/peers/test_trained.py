"""What every peer trained by gradient keeps to: its steps, its kinds, its checkpoint,
the test rows.
"""

import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import lightning.pytorch as L
import numpy as np
import pytest
import torch
from campaigns import compose
from lightning.pytorch.loggers import CSVLogger
from refusals import refused
from scenes import lobes, room

from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.field.gradient_stage import DEFAULTS
from gsparc.field.optimizer import rate_factor
from gsparc.models import checkpoint
from gsparc.models.abilities import HasGaussians
from gsparc.models.fitting import fit_or_resume
from gsparc.models.registry import method_class
from gsparc.ops import Pose
from gsparc.runs.experiment.folds import build_callbacks
from gsparc.training.context import FitContext
from gsparc.training.effort import Effort

SMALL = {
    "gsrf": {"count": 40},
    "wrfgs": {"count": 40},
    "swiftwrf": {"count": 40},
    "ngrf": {"count": 20},
    "wideband": {"count": 20},
    "newrf": {"width": 16, "samples": 8},
    "nerf2": {"width": 16, "samples": 8, "rays": 64},
}


def brief(name: str, **more):
    return method_class(name)(**{**SMALL[name], "max_steps": 3, **more})


def test_a_peer_takes_counted_steps_times_the_effort(tmp_path, monkeypatch):
    """Seconds stretched the schedule, so that a busy machine took other steps."""
    data, fold = lobes(tmp_path)
    seen = []

    def noted(kind, settings, step, total):
        seen.append((step, total, rate_factor(kind, settings, step, total)))
        return seen[-1][2]

    monkeypatch.setattr("gsparc.field.optimizer.rate_factor", noted)
    monkeypatch.setattr(method_class("swiftwrf"), "usual_steps", {"spectrum": 20})
    for effort, batch, steps in ((0.5, 8, 10), (1.0, 16, 10), (0.25, 8, 5)):
        method = brief("swiftwrf", max_steps=None, batch_size=batch)
        said = method.describe_fit(data, Effort().scale_by(effort))
        assert said == f"{steps} steps of {batch} samples"
        seen.clear()
        method.fit(data, fold, FitContext(tmp_path, effort=effort))
        assert method.steps == steps and {step for step, *_ in seen} == set(range(steps + 1))
        assert {total for _, total, _ in seen} == {steps}
        assert seen[0][2] > 0.9 and seen[-1][2] == pytest.approx(0.02), "rates fall to a fiftieth"


class Cut(L.Callback):
    """Presses Ctrl-C in a step, and counts the steps that were taken."""

    def __init__(self, step: int | None = None) -> None:
        self.step, self.seen = step, 0

    def on_train_batch_start(self, trainer, *unused):
        self.seen += 1
        if trainer.global_step == self.step:
            signal.raise_signal(signal.SIGINT)


def test_peers_had_loops_of_their_own(tmp_path):
    """Options of the Trainer, callbacks and loggers did nothing,
    and an interrupted one could not go on.
    """
    torch.set_num_threads(1)
    data, fold = lobes(tmp_path)

    def taught(folder, *more, **given):
        method, trainer = (
            brief("nerf2", max_steps=99),
            partial(DEFAULTS, max_steps=30, log_every_n_steps=10),
        )
        callbacks = [*build_callbacks(compose("model=nerf2").callbacks), *more]
        context = FitContext(
            tmp_path / folder, trainer=trainer, callbacks=lambda: callbacks, **given
        )
        return method, method.fit(data, fold, context)

    counted, logger = Cut(), CSVLogger(tmp_path, "log")
    whole, _ = taught("whole", counted, loggers=[logger])
    assert whole.steps == counted.seen == 30, "steps of the Trainer win"
    logger.save()
    text = (Path(logger.log_dir) / "metrics.csv").read_text()
    assert "train/task_loss" in text and "rate/other" in text and "gaussians" not in text
    last = tmp_path / "cut" / "last.ckpt"
    with pytest.raises(KeyboardInterrupt, match=f"go on with ckpt_path={last}"):
        taught("cut", Cut(7))
    assert checkpoint.read(last).extra["trainer"]["global_step"] == 8
    goes_on, _ = taught("again", resume=last)
    for name, value in whole.fitted().state_dict().items():
        assert torch.equal(value, goes_on.fitted().state_dict()[name]), name
    other = Fold(fold.train[1:], fold.val, fold.test)
    refused(
        "was trained with other rows",
        brief("nerf2").fit,
        data,
        other,
        FitContext(tmp_path, resume=last),
    )


def test_a_station_that_an_interrupted_run_had_not_begun_was_refused(tmp_path):
    """Of ten carriers eight were trained before a kill: the ninth had no folder,
    `no such checkpoint`.
    """
    data, fold = lobes(tmp_path)
    context = FitContext(
        tmp_path / "station8", resume=tmp_path / "station8", trainer=partial(DEFAULTS, max_steps=2)
    )
    method, _ = fit_or_resume(brief("nerf2"), data, fold, context)
    assert method.steps == 2


def test_a_published_method_may_watch_validation_rows(tmp_path):
    """It learned from them all, and no curve of its training showed what it does on others."""
    data, fold = lobes(tmp_path)
    logger, method = CSVLogger(tmp_path, "log"), brief("nerf2", max_steps=4, learn_val=False)
    method.fit(data, fold, FitContext(tmp_path / "run", loggers=[logger]))
    logger.save()
    assert "val/psnr_db" in (Path(logger.log_dir) / "metrics.csv").read_text()
    poisoned = replace(data, target=data.target.copy())
    poisoned.target[fold.val] = 0
    again = brief("nerf2", max_steps=4, learn_val=False)
    again.fit(poisoned, fold, FitContext(tmp_path / "again"))
    for name, value in method.fitted().state_dict().items():
        assert torch.equal(value, again.fitted().state_dict()[name]), name


def test_a_fit_that_may_write_nowhere_left_a_checkpoint_in_the_working_directory(
    tmp_path, monkeypatch
):
    data, fold = lobes(tmp_path)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    brief("swiftwrf").fit(data, fold, FitContext())
    assert list(Path().iterdir()) == []


def test_a_peer_trains_on_the_cpu_whatever_the_trainer_says(tmp_path, caplog):
    """Under the Trainer it would have been moved to a device, and its own tensors not."""
    data, fold = lobes(tmp_path)
    trainer = partial(DEFAULTS, accelerator="gpu", devices=1, strategy="ddp")
    brief("nerf2", max_steps=2).fit(data, fold, FitContext(tmp_path, trainer=trainer))
    assert "in one process on the CPU" in caplog.text


def test_no_batch_is_refused():
    refused("gsrf: batch_size >= 1 is needed, got 0", brief, "gsrf", batch_size=0)


def test_a_loss_that_is_not_finite_stops_training(tmp_path):
    data, fold, _ = room(40)
    data.target[fold.train] = np.nan
    with pytest.raises(RuntimeError, match="NaN or infinite at step 0"):
        brief("ngrf").fit(data, fold, FitContext(tmp_path))


@pytest.mark.parametrize(
    ("name", "kind"), [("gsrf", "spectrum"), ("gsrf", "csi"), ("wrfgs", "spectrum")]
)
def test_a_peer_shows_its_gaussians_and_what_they_emit(tmp_path, name, kind):
    data, fold = lobes(tmp_path) if kind == "spectrum" else room(40, directions=True)[:2]
    method = brief(name)
    assert isinstance(method, HasGaussians)
    refused("not fitted", method.gaussians, Query(torch.zeros(1, 3), Pose.identity(torch.zeros(3))))
    method.fit(data, fold, FitContext(tmp_path))
    one, other = (data.batch(fold.test[i : i + 1]) for i in (0, 1))
    cloud, elsewhere = (method.gaussians(batch) for batch in (one, other))
    np.testing.assert_allclose(cloud.means, method.network.field.means.detach(), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(cloud.quats, axis=1), 1)
    assert len(cloud) == method.count_components() and (cloud.strengths >= 0).all()
    assert np.ptp(cloud.strengths) > 0
    assert (cloud.strengths != elsewhere.strengths).any()
    both = data.batch(fold.test[:2])
    square = (cloud.strengths**2 + elsewhere.strengths**2) / 2
    np.testing.assert_allclose(method.gaussians(both).strengths ** 2, square, rtol=1e-5)
