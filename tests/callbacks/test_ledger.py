from types import SimpleNamespace

import pytest

from gsparc.callbacks import CostLedger, ledger
from gsparc.training import curve


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test winds."""
    now = SimpleNamespace(value=100.0)
    monkeypatch.setattr(ledger.time, "perf_counter", lambda: now.value)
    return now


def trainer(callbacks=(), **figures) -> SimpleNamespace:
    return SimpleNamespace(
        callbacks=list(callbacks),
        callback_metrics=figures,
        sanity_checking=False,
        is_global_zero=True,
        global_step=7,
        loggers=[],
        state=SimpleNamespace(fn="fit"),
    )


@pytest.fixture
def module(tmp_path):
    figures = {"val/error": 0.25, "val/psnr_db": 21.5}
    return SimpleNamespace(
        run_dir=tmp_path / "new",
        train_seconds=0.0,
        prepared_seconds=0.0,
        figures=figures,
        count=40,
        start="start",
    )


def test_validation_and_pictures_are_not_billed(clock, module):
    bill = CostLedger()
    run = trainer([bill])
    bill.on_train_start(run, module)
    clock.value += 3
    bill.on_validation_start(run, module)
    clock.value += 100
    bill.on_validation_end(run, module)
    clock.value += 2
    with bill.paused():
        clock.value += 1000
    clock.value += 1
    bill.on_train_end(run, module)
    assert module.train_seconds == bill.seconds == 6


def test_a_pause_of_a_stopped_watch_starts_nothing(clock):
    bill = CostLedger()
    with bill.paused():
        clock.value += 5
    clock.value += 5
    assert bill.elapsed() == 0


def test_the_curve_has_accuracy_beside_seconds(clock, module):
    bill, run = CostLedger(), trainer(**{"train/task_loss": 0.5})
    run.sanity_checking, run.global_step = True, 0
    bill.on_validation_end(run, module)  # before the first step
    run.sanity_checking = False
    bill.on_train_start(run, module)
    for run.global_step in (7, 14):
        clock.value += 2
        bill.on_validation_start(run, module)
        bill.on_validation_end(run, module)
    rows = curve.read_curve(module.run_dir)
    assert [row["seconds"] for row in rows] == ["0.0", "2.0", "4.0"]
    assert [row["what"] for row in rows] == ["start", "step 7", "step 14"]
    assert rows[0]["val/psnr_db"] == "21.5" and rows[0]["error"] == "0.25"
    assert rows[0]["num_gaussians"] == "40"


def test_the_curve_of_a_resumed_run_ends_with_its_checkpoint(clock, module):
    """Rows after the checkpoint stood twice."""
    bill, run = CostLedger(), trainer()
    bill.on_train_start(run, module)
    bill.on_validation_end(run, module)
    state = bill.state_dict()
    run.global_step = 14
    bill.on_validation_end(run, module)
    again, run.global_step = CostLedger(), 7
    again.load_state_dict(state)
    again.on_train_start(run, module)
    assert [row["step"] for row in curve.read_curve(module.run_dir)] == ["7"]
