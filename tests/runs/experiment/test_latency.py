"""Slow methods do not stretch the rounds of the fast ones, and the slowest are timed once."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from clocks import WoundClock

from gsparc.data.splits import Fold
from gsparc.evaluation.results import frame_of_runs, read_run
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


def test_a_sweep_of_a_method_that_reads_an_uplink_ended_without_its_table(
    tmp_path, monkeypatch, caplog
):
    """It answers at no places, so that it cannot be timed again;
    the sweep's report was lost for that.
    """

    def refuse(number):
        raise ValueError("uplink: reads a fresh uplink, and positions alone are none")

    opened = SimpleNamespace(
        stored=[SimpleNamespace(extra={})],
        predictor=SimpleNamespace(cycle_places=lambda places: refuse),
        split=SimpleNamespace(folds=[Fold(*[np.arange(3)] * 3)]),
        data=SimpleNamespace(moving=np.zeros((3, 3))),
    )
    monkeypatch.setattr(runner, "open_run", lambda *_: SimpleNamespace(read=lambda: opened))
    facts = {"model/name": "uplink", "test/nmse": 0.1, "dataset/kind": "csi", "split/sha256": "s"}
    (tmp_path / "summary.json").write_text(json.dumps(facts | {"time/train_s": 1.0}))
    assert len(runner.time_again(frame_of_runs([read_run(tmp_path)]), rounds=1)) == 1
    assert "not timed again: uplink: reads a fresh uplink" in caplog.text
