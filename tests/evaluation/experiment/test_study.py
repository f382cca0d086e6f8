"""Each variant's accuracy, seconds and milliseconds, under every condition of the data."""

from typing import ClassVar

import pytest
from clocks import WoundClock
from invented import divide, invent

from gsparc.data.query import Batch
from gsparc.evaluation.experiment import study
from gsparc.evaluation.experiment.study import DataChanges, Study
from gsparc.evaluation.ledger import State
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.models.baselines.nearest import Nearest
from gsparc.prediction import timing
from gsparc.prediction.timing import ClockSettings
from gsparc.training.context import FitContext, FitReport

STATE = State({}, {}, "d", "s")
CLOCK = ClockSettings(rounds=10, rounds_s=2)
WATCH = WoundClock()


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Run a study in a folder; models are kept in memory, of classes that no file may name."""
    kept = {}
    monkeypatch.setattr(
        study.checkpoint, "save", lambda path, method, *more: kept.update({str(path): method})
    )
    monkeypatch.setattr(study.checkpoint, "read", kept.get)
    monkeypatch.setattr(study.loading, "rebuild_method", lambda factory, stored: stored)
    context = FitContext(tmp_path, seed=5, effort=7.0)
    return lambda of, data, split: of.run(data, split, context, STATE)


class Slow(Nearest):
    """Answers as the nearest does, after a while; says that it took three times as long to train."""

    effects = "sleep+wake"
    seconds, query_s = 3.0, 0.004
    contexts: ClassVar[list] = []

    def fit(self, data, fold, context):
        super().fit(data, fold, context)
        self.contexts.append(context)
        return FitReport(self.seconds)

    def predict(self, query):
        WATCH.wind(self.query_s)
        return super().predict(query)


class Quick(Slow):
    effects = None
    seconds, query_s = 1.0, 0.001


class Impossible(Mean):
    def fit(self, data, fold, context):
        raise ValueError("model.effects.array=true is not possible: no array")


class NeedsUplink(Quick):
    def predict(self, query):
        assert isinstance(query, Batch)  # whole rows are asked, as an uplink is one of theirs
        return super().predict(query)


def test_variants_are_timed_in_turns_and_what_cannot_be_is_left_out(monkeypatch, run, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(timing.time, "perf_counter", WATCH)
    made = dict(plain=Quick, slow=Slow, impossible=Impossible, needs=NeedsUplink)
    rows = run(Study(made, rounds=2, clock=CLOCK), invent("csi"), divide(48))
    found = {row.variant: row for row in rows.itertuples()}
    assert list(found) == ["plain", "slow", "needs"]
    assert found["slow"].train_s == 3 * found["plain"].train_s and found["slow"].effects == "sleep, wake"
    assert "plain, round 1 of 2" in caplog.text, "it said plain, none, round 1"
    assert 3 < found["slow"].query_ms / found["plain"].query_ms < 4  # 4.1 ms to 1.1
    assert found["slow"].value == found["needs"].value == pytest.approx(found["plain"].value)
    assert found["plain"].spread == 0 and found["plain"].rows == 36


def test_a_study_without_a_variant_that_can_be_is_refused(run):
    with pytest.raises(ValueError, match="not possible"):
        run(Study(dict(plain=Impossible)), invent("csi"), divide(48))


def test_every_fit_gets_the_context_and_every_round_another_seed_once(run):
    Quick.contexts.clear()
    for _ in range(2):  # the second time every round is done
        run(Study(dict(quick=Quick), rounds=2, seed=3, clock=CLOCK), invent(), divide(48, 2))
    assert [one.seed for one in Quick.contexts] == [3, 3, 4, 4]
    assert {one.effort for one in Quick.contexts} == {7.0}
    assert len({one.run_dir for one in Quick.contexts}) == 4


def test_errors_cost_an_interpolator_and_not_the_mean(run):
    data, split = invent(), divide(48)
    conditions = DataChanges("", errors_m=[0.001, 0.3]).conditions()
    rows = run(Study(dict(gp=GaussianProcess, mean=Mean), conditions, clock=CLOCK), data, split)
    value = {(r.variant, r.what, r.amount): r.value for r in rows.itertuples()}
    assert len(value) == 14
    for what in ("query", "train"):
        assert value["gp", what, 0.3] < value["gp", "none", 0.0] - 1
        assert abs(value["mean", what, 0.3] - value["mean", "none", 0.0]) < 1e-6
    clean, asked = (next(r for r in rows.itertuples() if r.what == what) for what in ("none", "query"))
    assert (clean.train_s, clean.query_ms) == (asked.train_s, asked.query_ms)  # trained and timed once


def test_more_measurements_are_better_and_are_counted(run):
    conditions = DataChanges("", keep=[1, 0.5, 9]).conditions()
    rows = run(Study(dict(gp=GaussianProcess), conditions, clock=CLOCK), invent(), divide(48))
    assert list(rows.rows) == [36, 18, 9]
    values = list(rows.value)
    assert values == sorted(values, reverse=True) and values[0] > values[-1] + 1
    with pytest.raises(ValueError, match="keep="):
        DataChanges("", keep=[0.0])
