import csv
from types import SimpleNamespace

import pytest

from gsparc.callbacks import CostLedger, ledger


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
        state=SimpleNamespace(fn="fit"),
    )


@pytest.fixture
def module(tmp_path):
    return SimpleNamespace(run_dir=tmp_path / "new", train_seconds=0.0, prepared_seconds=0.0)


def test_validation_and_pictures_are_not_billed(clock, module):
    bill = CostLedger()
    run = trainer([bill])
    bill.on_train_start(run, module)
    clock.value += 3
    bill.on_validation_start(run, module)
    clock.value += 100
    bill.on_validation_end(run, module)
    clock.value += 2
    with CostLedger.paused_in(run):
        clock.value += 1000
    clock.value += 1
    bill.on_train_end(run, module)
    assert module.train_seconds == bill.seconds == 6


def test_a_pause_of_a_stopped_watch_or_of_none_starts_nothing(clock):
    bill = CostLedger()
    with bill.paused():
        clock.value += 5
    clock.value += 5
    assert bill.elapsed() == 0
    with CostLedger.paused_in(trainer()) as nothing:
        assert nothing is None
    assert CostLedger.seconds_in(trainer()) is None


def test_the_curve_has_accuracy_beside_seconds(clock, module):
    bill = CostLedger()
    run = trainer([bill], **{"val/psnr_db": 21.5, "model/num_gaussians": 40.0, "other": 1.0})
    bill.on_train_start(run, module)
    for _ in range(2):
        clock.value += 2
        bill.on_validation_start(run, module)
        bill.on_validation_end(run, module)
    with (module.run_dir / "learning_curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["train_s"] for row in rows] == ["2.0", "4.0"]
    assert rows[0]["val/psnr_db"] == "21.5" and rows[0]["num_gaussians"] == "40" and "other" not in rows[0]


def test_a_resumed_run_keeps_counting_and_an_exception_stops_the_watch(clock):
    bill = CostLedger()
    bill.on_train_start(trainer(), SimpleNamespace())
    clock.value += 4
    again = CostLedger()
    again.load_state_dict(bill.state_dict())
    again.on_train_start(trainer(), SimpleNamespace())
    clock.value += 1
    assert again.elapsed() == 5
    again.on_exception(trainer(), SimpleNamespace(), RuntimeError())
    clock.value += 4
    assert again.elapsed() == 5
