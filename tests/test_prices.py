"""Each variant's time and accuracy beside the plain one's, in one run."""

from __future__ import annotations

import time

import numpy as np
import pytest
from invented import invent

from gsparc.clock import ClockSettings
from gsparc.data.splits import Fold
from gsparc.effects import decide_array
from gsparc.method import FitReport
from gsparc.peers.mean import Mean
from gsparc.peers.nearest import Nearest
from gsparc.prices import measure

FOLD = Fold(np.arange(30), np.arange(30, 32), np.arange(32, 48))


class Slow(Nearest):
    """Answers as the nearest does, after a while; says that it took three times as long to train."""

    effects = "sleep"

    def fit(self, data, fold, run_dir):
        super().fit(data, fold, run_dir)
        return FitReport(3.0)

    def predict(self, tx, rx):
        time.sleep(0.004)
        return super().predict(tx, rx)


class Quick(Nearest):
    def fit(self, data, fold, run_dir):
        super().fit(data, fold, run_dir)
        return FitReport(1.0)


class Impossible(Mean):
    def fit(self, data, fold, run_dir):
        decide_array(True, data.site, None)
        raise AssertionError


def test_prices_are_ratios_to_the_plain_variant(tmp_path):
    data = invent("csi")
    makers = {"plain": Quick, "slow": Slow, "impossible": Impossible}
    clock = ClockSettings(rounds=10, budget_s=2)
    found = {p.name: p for p in measure(makers, data, FOLD, tmp_path, plain="plain", rounds=2, clock=clock)}
    assert set(found) == {"plain", "slow"}
    assert found["plain"].query_ratio == found["plain"].train_ratio == 1
    assert found["slow"].train_ratio == pytest.approx(3) and found["slow"].query_ms >= 4
    assert found["slow"].query_ratio > 2 and found["slow"].effects == "sleep"
    assert found["slow"].value == pytest.approx(found["plain"].value)


def test_the_plain_variant_must_be_there(tmp_path):
    with pytest.raises(ValueError, match="no such variant; there are mean"):
        measure({"mean": Mean}, invent("csi"), FOLD, tmp_path, plain="plain", rounds=1)
    with pytest.raises(ValueError, match="not possible"):
        measure({"plain": Impossible}, invent("csi"), FOLD, tmp_path, plain="plain", rounds=1)
