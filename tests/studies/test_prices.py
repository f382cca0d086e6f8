"""Each variant's time and accuracy beside the plain one's, in one run."""

from __future__ import annotations

import numpy as np
import pytest
from clocks import WoundClock
from invented import invent

from gsparc.auto.decide import decide_array
from gsparc.data.splits import Fold
from gsparc.methods import timing
from gsparc.methods.mean import Mean
from gsparc.methods.method import FitContext, FitReport
from gsparc.methods.nearest import Nearest
from gsparc.methods.timing import ClockSettings
from gsparc.studies.study.prices import measure

FOLD = Fold(np.arange(30), np.arange(30, 32), np.arange(32, 48))


WATCH = WoundClock()


class Slow(Nearest):
    """Answers as the nearest does, after a while; says that it took three times as long to train."""

    effects = "sleep"

    def fit(self, data, fold, context):
        super().fit(data, fold, context)
        return FitReport(3.0)

    def predict(self, tx, rx):
        WATCH.wind(0.004)
        return super().predict(tx, rx)


class Quick(Nearest):
    def fit(self, data, fold, context):
        super().fit(data, fold, context)
        return FitReport(1.0)

    def predict(self, tx, rx):
        WATCH.wind(0.001)
        return super().predict(tx, rx)


class Impossible(Mean):
    def fit(self, data, fold, context):
        decide_array(True, data.site, None)
        raise AssertionError


def priced(makers, data, folder):
    settings = ClockSettings(rounds=10, budget_s=2)
    found = measure(makers, data, FOLD, FitContext(folder), plain="plain", rounds=2, clock=settings)
    return {price.name: price for price in found}


def test_prices_are_ratios_to_the_plain_variant(tmp_path, monkeypatch):
    monkeypatch.setattr(timing.time, "perf_counter", WATCH)
    found = priced({"plain": Quick, "slow": Slow, "impossible": Impossible}, invent("csi"), tmp_path)
    assert set(found) == {"plain", "slow"}
    assert found["plain"].query_ratio == found["plain"].train_ratio == 1
    assert found["slow"].train_ratio == pytest.approx(3) and found["slow"].query_ms >= 4
    assert 3 < found["slow"].query_ratio < 4 and found["slow"].effects == "sleep"  # 4.1 ms to 1.1
    assert found["slow"].value == pytest.approx(found["plain"].value)


def test_methods_that_hear_an_uplink_are_asked_with_it(tmp_path):
    """They were asked for positions alone, which they refuse, after everything had been trained."""

    class Hears(Quick):
        def predict(self, tx, rx):
            raise ValueError("answers snapshots with their uplink")

        def answer(self, batch):
            return Quick.predict(self, batch.tx, batch.rx)

    found = priced({"plain": Quick, "hears": Hears}, invent("csi"), tmp_path)
    assert found["hears"].value == pytest.approx(found["plain"].value)


def test_the_plain_variant_must_be_there(tmp_path):
    with pytest.raises(ValueError, match="no such variant; there are mean"):
        measure({"mean": Mean}, invent("csi"), FOLD, FitContext(tmp_path), plain="plain", rounds=1)
    with pytest.raises(ValueError, match="not possible"):
        measure({"plain": Impossible}, invent("csi"), FOLD, FitContext(tmp_path), plain="plain", rounds=1)
