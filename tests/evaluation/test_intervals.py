"""Intervals and outages of predicted normal distributions, against draws from them."""

from dataclasses import replace

import numpy as np
import pytest

from gsparc.evaluation.intervals import reduced_chi_squared, rmse_with_silent, score_power_intervals
from gsparc.evaluation.scores import Scores, errors_with_silent
from gsparc.models.baselines.kriging import Kriging
from gsparc.prediction.hearing import Hearing
from gsparc.tables.own import from_arrays

COUNT, LEVEL = 4000, -80.0


@pytest.fixture(scope="module")
def drawn():
    """Powers about -80 dB with 6 dB of shadowing, half of them too weak;
    what is predicted is their law.
    """
    rng = np.random.default_rng(0)
    mean_db = rng.normal(LEVEL, 8, COUNT)
    truth = mean_db + rng.normal(0, 6, COUNT)
    data = from_arrays(
        {
            "rx_position": rng.uniform(0, 9, (COUNT, 3)),
            "tx_position": np.zeros(3),
            "sensitivity_db": LEVEL,
            "rssi_db": np.where(truth < LEVEL, np.nan, truth),
        }
    )
    return data, mean_db


def given_heard(learned, asked, mean_db, spread_db):
    hearing, spread = (
        Hearing.from_learned(learned, np.arange(len(learned))),
        np.full(len(asked), spread_db),
    )
    return hearing.given_heard(Kriging(), asked.moving, asked.stations_of(), mean_db, spread)


def scored(data, mean_db, spread_db):
    mean = 10 ** (mean_db / 10)
    linear = (np.log(10) / 10 * mean * spread_db / data.site.target_scale) ** 2
    samples = {"prediction": mean} | given_heard(data, data, mean_db, spread_db)
    return Scores(
        "rssi", np.zeros(COUNT, int), np.arange(COUNT), samples, np.full(COUNT, np.nan), linear
    )


def test_a_true_law_is_calibrated(drawn):
    data, mean_db = drawn
    found = score_power_intervals(scored(data, mean_db, 6.0), data)
    assert found["outage/rate"] == pytest.approx(0.5, abs=0.03)
    assert found["outage/brier"] < 0.8 * found["outage/brier_rate"]
    # Heard rows are the upper part of their laws, by whose moments they are judged.
    assert 0.7 < found["interval/width_db"] / (2 * 1.645 * 6) < 0.8
    assert 0.88 < found["interval/coverage_90"] < 0.93
    assert found["reduced_chi2"] == pytest.approx(1, abs=0.05) and found["heard_above_db"] > 2.5


def test_whether_std_is_right_was_in_no_table():
    """Deviations half as large as the errors, or twice, read the same in every table."""
    rng = np.random.default_rng(0)
    data = from_arrays(
        {
            "rx_position": rng.uniform(0, 9, (COUNT, 3)),
            "tx_position": np.zeros(3),
            "csi": np.ones((COUNT, 1, 1), complex),
            "frequency_hz": 1e9,
        }
    )
    samples = {"mse": rng.exponential(2.0, COUNT)}  # |e|^2 of complex normal errors
    variance = np.where(np.arange(COUNT) % 100, 2.0, np.nan) / data.site.target_scale**2
    own = Scores(
        "csi", np.zeros(COUNT, int), np.arange(COUNT), samples, np.full(COUNT, np.nan), variance
    )
    assert reduced_chi_squared(own, data)["reduced_chi2"] == pytest.approx(1, abs=0.05)
    small = replace(own, variance=variance / 4)
    assert reduced_chi_squared(small, data)["reduced_chi2"] == pytest.approx(4, abs=0.2)
    assert reduced_chi_squared(replace(own, variance=np.full(COUNT, np.nan)), data) == {}


def test_silent_rows_counted_nowhere(drawn):
    """Beside lists of the strongest methods that predict what was heard everywhere had the better
    rmse.
    """
    data, mean_db = drawn
    heard = data.censored_side(np.arange(COUNT)) == 0
    level = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    lifted = np.maximum(mean_db, LEVEL + 6)  # as if every place heard
    honest, other = (
        {"error_db": said - level, **scored(data, said, 6.0).samples} for said in (mean_db, lifted)
    )
    honest, other = (
        one | errors_with_silent(one, np.arange(COUNT), data) for one in (honest, other)
    )
    squares = [float(np.square(one["error_db"][heard]).mean()) for one in (honest, other)]
    both = [replace(scored(data, mean_db, 6.0), samples=one) for one in (honest, other)]
    found = [rmse_with_silent(one, data)["rmse_db_with_silent"] for one in both]
    # silent_samples was 0 where they count.
    assert rmse_with_silent(both[0], data)["silent_samples"] == (~heard).sum() > 0
    assert squares[1] < squares[0] and found[0] < 0.9 * found[1]


def test_levels_of_lists_are_none_of_a_station(drawn):
    """The last list's level was taken for the sensitivity of a station."""
    data, _ = drawn
    silent = data.subset(np.flatnonzero(data.censored_side(np.arange(COUNT)) > 0))
    west = silent.moving[:, 0] < np.median(data.moving[:, 0])
    silent = replace(
        silent, target=np.where(west, 0.1, 10)[:, None].astype(np.float32) * silent.target
    )
    found = given_heard(silent, data, np.full(COUNT, LEVEL), 3.0)
    share = found["heard_share"][np.argsort(data.moving[:, 0])]
    assert share[: COUNT // 4].min() > 0.9 and share[-COUNT // 4 :].max() < 0.1
    # Far above what it must exceed a level is what it was.
    assert found["heard_db"].min() == pytest.approx(LEVEL, abs=0.1)


def test_rows_of_stations_without_a_level_had_an_outage_of_nan():
    """The summary of the whole run was refused for it, after the training."""
    walk = np.random.default_rng(0).uniform(0, 9, (40, 3))
    levels_db = np.stack([-80 - walk[:, 0], -80 - walk[:, 1]], axis=1)
    levels_db[levels_db[:, 0] < -85, 0] = np.nan
    posts = {
        "station_position": np.array([[0.0, 0, 5], [9, 9, 5]]),
        "sensitivity_db": np.array([-85.0, -200]),
    }
    data = from_arrays({"rx_position": walk, "rssi_db": levels_db, **posts})
    row = np.flatnonzero(data.station == 1)
    mean = data.target[row, 0].astype(float) * data.site.target_scale
    spread = np.full(len(row), 1e-2) * data.target[row, 0] ** 2
    given = given_heard(data, data.subset(row), 10 * np.log10(mean), 3.0)
    scores = Scores(
        "rssi", 0 * row, row, {"prediction": mean} | given, np.full(len(row), np.nan), spread
    )
    figures = {"interval/coverage_90", "interval/width_db", "reduced_chi2", "heard_above_db"} | {
        "levels_rmse_db"
    }
    assert set(score_power_intervals(scores, data)) == figures


def test_a_prediction_of_zero_at_a_row_in_saturation_missed_it_by_thousands_of_decibels(drawn):
    data = drawn[0]
    side = np.where(np.arange(COUNT) == 0, -1, data.censored_side(np.arange(COUNT))).astype(np.int8)
    silent = replace(data, censored=side)
    one = scored(silent, np.full(COUNT, LEVEL), 6.0)
    samples = {**one.samples, "prediction": np.zeros(COUNT), "error_db": np.zeros(COUNT)}
    one = replace(one, samples=samples | errors_with_silent(samples, one.row, silent))
    assert rmse_with_silent(one, silent)["rmse_db_with_silent"] < 200
