"""Intervals and outages of predicted normal distributions, against draws from them."""

from __future__ import annotations

import numpy as np
import pytest

from gsparc.data.own import from_arrays
from gsparc.evaluation.intervals import levels, power_intervals
from gsparc.evaluation.scores import Scores

COUNT, LEVEL = 4000, -80.0


@pytest.fixture(scope="module")
def drawn():
    """Powers about -80 dB with 6 dB of shadowing, half of them too weak; what is predicted is their law."""
    rng = np.random.default_rng(0)
    mean_db = rng.normal(LEVEL, 8, COUNT)
    truth = mean_db + rng.normal(0, 6, COUNT)
    data = from_arrays(
        {
            "rx_position": rng.uniform(0, 9, (COUNT, 3)), "tx_position": np.zeros(3), "sensitivity_db": LEVEL,
            "rssi_db": np.where(truth < LEVEL, np.nan, truth),
        }
    )  # fmt: skip
    return data, mean_db


def scored(data, mean_db, spread_db):
    mean = 10 ** (mean_db / 10)
    linear = (np.log(10) / 10 * mean * spread_db / data.site.target_scale) ** 2
    samples = {"prediction": mean}
    return Scores("rssi", np.zeros(COUNT, int), np.arange(COUNT), samples, np.full(COUNT, np.nan), linear)


def test_the_level_is_that_of_the_file(drawn):
    assert levels(drawn[0]) == pytest.approx([LEVEL], abs=1e-3)


def test_a_true_law_is_calibrated(drawn):
    data, mean_db = drawn
    found = power_intervals(scored(data, mean_db, 6.0), data)
    assert found["outage/rate"] == pytest.approx(0.5, abs=0.03)
    assert found["outage/brier"] < 0.8 * found["outage/brier_rate"]
    assert found["interval/width_db"] == pytest.approx(2 * 1.645 * 6, rel=0.01)
    # Heard rows are the upper part of their laws: a little fewer than 90 % lie inside.
    assert 0.84 < found["interval/coverage_90"] < 0.93


def test_too_sure_and_too_unsure_are_told_apart(drawn):
    data, mean_db = drawn
    sure, right, unsure = (power_intervals(scored(data, mean_db, s), data) for s in (1.0, 6.0, 30.0))
    assert sure["interval/coverage_90"] < 0.4 < 0.99 < unsure["interval/coverage_90"]
    assert right["outage/brier"] < min(sure["outage/brier"], unsure["outage/brier"])


def test_no_variance_no_figures(drawn):
    data, mean_db = drawn
    scores = scored(data, mean_db, 6.0)
    assert power_intervals(Scores(**{**vars(scores), "variance": np.full(COUNT, np.nan)}), data) == {}
