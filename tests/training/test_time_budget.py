"""A budget of seconds is kept, and every schedule ends with it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from campaigns import brief, compose, spectra
from torch import nn

from gsparc.commands.train import train
from gsparc.methods.method import FitContext
from gsparc.training import time_budget
from gsparc.training.optimizer import OptimizerSettings, optimizer_for, scheduler_for
from gsparc.training.time_budget import Budget, Pace, Stretched


def test_a_schedule_of_steps_is_stretched_over_the_seconds():
    pace = Pace(400, 10.0)
    for seconds, step in ((0.0, 0), (2.5, 100), (9.99, 399), (10.0, 400), (70.0, 400)):
        pace.spend(seconds)
        assert pace.step == step and pace.over == (step == 400)


def test_a_step_that_jumps_over_a_multiple_still_acts_there():
    pace = Pace(400, 10.0)
    acted = []
    for tenths in range(0, 101, 7):
        pace.spend(tenths / 10)
        if (multiple := pace.passed(100)) is not None:
            acted.append(multiple)
    pace.spend(10.0)
    acted.append(pace.passed(100))
    assert acted == [100, 200, 300, 400]


def test_rates_follow_the_seconds():
    model = nn.Module()
    model.emission = nn.Linear(2, 2)
    pace = Pace(100, 4.0)
    optimizer = optimizer_for(model, OptimizerSettings(decay=0.5))
    scheduler = scheduler_for(optimizer, OptimizerSettings(decay=0.5), 100, pace)
    first = optimizer.param_groups[0]["lr"]
    pace.spend(4.0)
    optimizer.step()
    scheduler.step()  # one step, all of the schedule
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.5 * first)


def test_callbacks_see_the_step_of_the_schedule():
    seen = []
    inner = SimpleNamespace(
        interval=100, state_key="inner", state_dict=dict,
        on_train_batch_end=lambda trainer, module: seen.append((trainer.global_step, trainer.other)),
    )  # fmt: skip
    pace = Pace(400, 10.0)
    stretched = Stretched(inner, pace)
    trainer = SimpleNamespace(global_step=3, other="kept")
    for seconds in (1.0, 2.6, 2.7, 5.1):
        pace.spend(seconds)
        stretched.on_train_batch_end(trainer, None)
    assert seen == [(100, "kept"), (200, "kept")] and stretched.state_key == "inner"


def test_validation_is_not_billed_and_a_resumed_run_has_the_rest(monkeypatch):
    now = SimpleNamespace(value=50.0)
    monkeypatch.setattr(time_budget.time, "perf_counter", lambda: now.value)
    trainer = SimpleNamespace(should_stop=False, state=SimpleNamespace(fn="fit"))
    watch = Budget(Pace(100, 10.0))
    watch.on_train_start(trainer, None)
    now.value += 4
    watch.on_train_batch_end(trainer, None)
    watch.on_validation_start(trainer, None)
    now.value += 1000
    watch.on_validation_end(trainer, None)
    now.value += 2
    assert watch.state_dict() == {"seconds": 6.0} and not trainer.should_stop
    again = Budget(Pace(100, 10.0))
    again.load_state_dict(watch.state_dict())
    again.on_train_start(trainer, None)
    assert again.pace.step == 60
    now.value += 4
    again.on_train_batch_end(trainer, None)
    assert trainer.should_stop


@pytest.mark.parametrize("wrong", [0, -3, float("inf")])
def test_a_budget_that_is_none_is_refused(wrong):
    with pytest.raises(ValueError, match=r"budget_s.*positive number of seconds"):
        FitContext(budget_s=wrong)


def test_a_run_ends_with_its_budget_in_both_stages(tmp_path):
    file = spectra(tmp_path / "own.npz")
    config = compose(*brief(file, "budget_s=2.0", "trainer.max_steps=100000"))
    facts, objects = train(config, tmp_path / "run")
    assert 1.9 < facts["time/train_s"] < 3.5  # the step in progress is finished
    last = (tmp_path / "run" / "learning_curve.csv").read_text().splitlines()[-1].split(",")
    assert 0.5 < float(last[1]) < 1.6  # half of it; the rest is the second stage
    assert objects.checkpoints[0].exists()
