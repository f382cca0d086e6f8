"""A budget of seconds ends a training; its schedules are of steps."""

from types import SimpleNamespace

import lightning.pytorch as L
import pytest
from campaigns import brief, compose, spectra
from clocks import wound
from contexts import loaded, short

from gsparc.field.stage_budget import StageBudget
from gsparc.models import checkpoint, loading
from gsparc.models.registry import build
from gsparc.models.splat import method as splatting
from gsparc.training.context import FitContext
from gsparc.training.time_budget import Spent, TimeBudget


def test_validations_were_not_counted_and_a_resumed_run_has_the_rest(monkeypatch):
    """Of 3,900 powers "within 60 s" took 156 s on the clock."""
    clocks = wound(monkeypatch)
    trainer = SimpleNamespace(should_stop=False, state=SimpleNamespace(fn="fit"))

    def watching() -> StageBudget:
        return StageBudget(TimeBudget(40.0, before=Spent(wall=30.0)))  # 30 s went into what came before

    watch = watching()
    watch.on_train_start(trainer, None)
    clocks.monotonic.wind(4)  # steps and validations
    watch.on_train_batch_end(trainer, None)
    assert not trainer.should_stop
    state = watch.state_dict()
    assert state["seconds"] == pytest.approx(4.0, abs=0.01)
    again = watching()
    again.load_state_dict(state)
    again.on_train_start(trainer, None)
    assert not trainer.should_stop
    clocks.monotonic.wind(7)
    again.on_train_batch_end(trainer, None)
    assert trainer.should_stop


def fitted(tmp_path, monkeypatch, wall_s: float, processor_s: float, **context):
    """Fit where preparing a stage takes so long [s], and every step a second by both clocks."""
    clocks, prepare = wound(monkeypatch), splatting.start_in_closed_form

    def slow(task):
        clocks.monotonic.wind(wall_s)
        clocks.process_time.wind(processor_s)
        return prepare(task)

    class Ticking(L.Callback):
        def on_before_optimizer_step(self, *unused):
            clocks.monotonic.wind(1.0)
            clocks.process_time.wind(1.0)

    monkeypatch.setattr(splatting, "start_in_closed_form", slow)
    file = spectra(tmp_path / "own.npz")
    data, fold = loaded(file)
    method = build(compose(*brief(file)).model).create_for(data)
    callbacks = context.pop("callbacks", lambda: [Ticking()])
    report = method.fit(data, fold, short(tmp_path, 30, callbacks=callbacks, every=2, **context))
    checkpoint.save(tmp_path / "model.ckpt", method)
    return report


def test_what_others_take_of_the_processor_ends_no_stage(tmp_path, monkeypatch):
    """Seconds of the wall were billed: on a busy machine the refit had one step."""
    report = fitted(tmp_path, monkeypatch, 500.0, 2.0, budget_s=200.0, budget_clock="processor")
    assert report.limited_by is None


def test_a_field_whose_second_stage_was_cut_could_not_be_read_back(tmp_path, monkeypatch):
    """The anchors of its encoding were those of the second stage, which learned from more rows."""
    report = fitted(tmp_path, monkeypatch, 0.0, 0.0, budget_s=40.0, budget_clock="processor")
    assert report.limited_by == "processor"
    method, _ = loading.load(tmp_path / "model.ckpt")
    assert len(method.fitted_model().gaussians) == 40


def test_a_run_that_seconds_ended_goes_on_without_them_to_its_end(tmp_path, monkeypatch):
    assert fitted(tmp_path, monkeypatch, 0.0, 0.0, budget_s=10.0).limited_by == "wall"
    assert fitted(tmp_path, monkeypatch, 0.0, 0.0, resume=tmp_path / "last.ckpt").limited_by is None


@pytest.mark.parametrize("wrong", [0, -3, float("inf")])
def test_a_budget_that_is_none_is_refused(wrong):
    with pytest.raises(ValueError, match=r"budget_s=.*: a number above 0, or null"):
        FitContext(budget_s=wrong)
