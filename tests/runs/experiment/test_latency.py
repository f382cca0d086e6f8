"""Slow methods do not stretch the rounds of the fast ones, and the slowest are timed once."""

from dataclasses import replace

import pytest
import torch
from clocks import WoundClock

from gsparc.models.method import Prediction
from gsparc.prediction import timing
from gsparc.runs.experiment import runner

WAITS = {"quick": 0.0, "slow": 0.2, "endless": 0.7}  # [s]


class Waiting:
    """Reads whole batches, as methods that need an uplink do: positions alone are not enough."""

    threads_pay = False

    def __init__(self, name: str, watch: WoundClock) -> None:
        self.name, self.watch, self.asked = name, watch, []

    def predict(self, batch):
        self.asked.append(batch.tx)
        self.watch.wind(WAITS[self.name])
        return Prediction(torch.zeros(len(batch), 1))


def test_each_speed_has_rounds_of_its_own(campaign, folds, monkeypatch, tmp_path):
    made: dict[str, Waiting] = {}
    watch = WoundClock()
    monkeypatch.setattr(timing.time, "perf_counter", watch)
    monkeypatch.setattr(
        runner.loading,
        "load",
        lambda path: (made.setdefault(path.parent.name, Waiting(path.parent.name, watch)), None),
    )
    monkeypatch.setattr(runner, "SLOW_MS", 150.0)
    monkeypatch.setattr(runner, "ENDLESS_MS", 600.0)
    files = {name: tmp_path / name / "model.ckpt" for name in WAITS}
    fast = replace(runner.FAST, rounds=12)
    found = runner.time_queries(files, campaign("spectrum", 20), folds(20), fast)
    assert list(found) == list(WAITS)
    assert {name: one["rounds"] for name, one in found.items()} == {
        "quick": 12,
        "slow": 5,
        "endless": 1,
    }
    assert found["slow"]["query_ms"] == pytest.approx(200, abs=1) and found["quick"]["query_ms"] < 1
    assert all(len(tx) == 1 for tx in made["quick"].asked)
    assert len({tuple(tx[0].tolist()) for tx in made["quick"].asked}) == 5, (
        "another test position each time"
    )
