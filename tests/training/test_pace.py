"""A budget of seconds is kept, and every schedule ends with it."""

from types import SimpleNamespace

import lightning.pytorch as L
import pytest
from campaigns import brief, compose, spectra
from clocks import wound
from contexts import loaded, short
from torch import nn

from gsparc.commands.train import train
from gsparc.models.registry import build
from gsparc.models.splat import method as splatting
from gsparc.training import curve
from gsparc.training.context import FitContext
from gsparc.training.optimizer import OptimizerSettings, optimizer_for, scheduler_for
from gsparc.training.pace import Budget, Pace
from gsparc.training.time_budget import Spent, TimeBudget


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


def test_validations_were_not_counted_and_a_resumed_run_has_the_rest(monkeypatch):
    """Of 3,900 powers "within 60 s" took 156 s on the clock."""
    clocks = wound(monkeypatch)
    trainer = SimpleNamespace(should_stop=False, state=SimpleNamespace(fn="fit"))

    def watching() -> Budget:
        return Budget(Pace(100, 10.0), TimeBudget(before=Spent(wall=30.0)))  # preparation: not the pace's

    watch = watching()
    watch.on_train_start(trainer, None)
    clocks.monotonic.wind(2)
    watch.on_train_batch_end(trainer, None)
    watch.on_validation_start(trainer, None)
    clocks.monotonic.wind(2)
    watch.on_validation_end(trainer, None)
    watch.on_train_batch_end(trainer, None)
    assert watch.pace.step == 60 and not trainer.should_stop  # one more validation follows the last step
    state = watch.state_dict()
    assert state["seconds"] == pytest.approx(4.0, abs=0.01)
    again = watching()
    again.load_state_dict(state)
    again.on_train_start(trainer, None)
    assert again.pace.step == 40
    clocks.monotonic.wind(6)
    again.on_train_batch_end(trainer, None)
    assert trainer.should_stop


def test_making_the_trainer_shortens_the_schedule_and_is_no_part_of_it(monkeypatch):
    """Steps of which none was kept were one of the second stage: it had 9 dB less."""
    clocks = wound(monkeypatch)
    trainer = SimpleNamespace(should_stop=False)
    watch = Budget(Pace(100, 10.0), TimeBudget())
    clocks.monotonic.wind(2)
    watch.on_train_start(trainer, None)
    assert watch.pace.step == 0
    clocks.monotonic.wind(4)
    watch.on_train_batch_end(trainer, None)
    assert watch.pace.step == pytest.approx(50, abs=1)


@pytest.fixture()
def paces(monkeypatch):
    """Seconds [s] of every stage's pace."""
    found, make = [], splatting.Pace
    monkeypatch.setattr(splatting, "Pace", lambda steps, left: found.append(left) or make(steps, left))
    return found


def fitted(tmp_path, monkeypatch, wall_s: float, processor_s: float, **context):
    """Fit where preparing a stage takes so long [s], and every step a second by both clocks."""
    clocks, prepare = wound(monkeypatch), splatting.prepare

    def slow(task):
        clocks.monotonic.wind(wall_s)
        clocks.process_time.wind(processor_s)
        return prepare(task)

    class Ticking(L.Callback):
        def on_before_optimizer_step(self, *unused):
            clocks.monotonic.wind(1.0)
            clocks.process_time.wind(1.0)

    monkeypatch.setattr(splatting, "prepare", slow)
    file = spectra(tmp_path / "own.npz")
    data, fold = loaded(file)
    method = build(compose(*brief(file)).model)
    callbacks = context.pop("callbacks", lambda: [Ticking()])
    return method.fit(data, fold, short(tmp_path, 30, callbacks=callbacks, every=2, **context))


def test_preparation_and_earlier_stages_are_billed_by_the_clock_of_the_budget(tmp_path, monkeypatch, paces):
    """They were billed in seconds of the wall: on a busy machine the refit had one step."""
    report = fitted(tmp_path, monkeypatch, 500.0, 2.0, budget_s=20.0, budget_clock="processor")
    assert paces == pytest.approx([10 - 2, 20 - 10 - 2], abs=1.2)  # the step in progress is finished
    assert report.limited_by == "processor"


def test_a_budget_that_is_spent_before_the_first_step_says_so(tmp_path, monkeypatch, paces, caplog):
    fitted(tmp_path, monkeypatch, 6.0, 0.0, budget_s=11.0)
    assert max(paces) < 0
    assert "budget_s=11: 6.0 of 5.5 s went before the first step of stage train" in caplog.text
    assert "of 11 s went before the first step of stage refit" in caplog.text


def test_a_budgeted_run_that_goes_on_without_one_was_limited_all_the_same(tmp_path, monkeypatch):
    fitted(tmp_path, monkeypatch, 0.0, 0.0, budget_s=10.0)
    resumed = fitted(tmp_path, monkeypatch, 0.0, 0.0, resume=tmp_path / "last.ckpt")
    assert resumed.limited_by == "wall"


@pytest.mark.parametrize("wrong", [0, -3, float("inf")])
def test_a_budget_that_is_none_is_refused(wrong):
    with pytest.raises(ValueError, match=r"budget_s.*positive number of seconds"):
        FitContext(budget_s=wrong)


def test_a_run_ends_with_its_budget_in_both_stages(tmp_path):
    file = spectra(tmp_path / "own.npz")
    config = compose(*brief(file, "budget_s=2.0", "trainer.max_steps=100000"))
    facts, objects = train(config, tmp_path / "run")
    assert 1.0 < facts["time/train_s"] < 3.5  # less the reading; the step in progress is finished
    last = curve.read(tmp_path / "run")[-2]  # before `final`
    assert 0.2 < float(last["seconds"]) < 1.6  # half of it; the rest is the second stage
    assert objects.checkpoints[0].exists()
