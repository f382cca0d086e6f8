"""Intervals, thresholds and areas from errors, against scipy and draws."""

import numpy as np
import pytest
from scipy.stats import binom, binomtest, chi2, norm, spearmanr, t

from gsparc.processes.uncertainty import (
    SURE_OF_EFFECT,
    Threshold,
    binomial_interval,
    censored_distribution,
    choose_threshold,
    conformal_quantile,
    coverage_and_width,
    design_effect,
    half_width,
    is_surely_above,
    mean_and_error,
    most_failures,
    rank_correlation,
    risk_coverage,
    standard_error,
    threshold_levels,
    variance_factor,
)

TENTHS = 0.1, 0.1  # at most a tenth is bad, but for a tenth of all sets
LAX = 0.3, 0.2


def test_what_others_compute_is_the_same():
    rng = np.random.default_rng(0)
    assert half_width(0.9) == pytest.approx(norm.ppf(0.95)) and half_width(0.9, 4) == pytest.approx(
        t.ppf(0.95, 4)
    )
    for wrong, count in ((5, 50), (0, 10), (10, 10)):
        known = binomtest(wrong, count).proportion_ci(0.9)
        assert binomial_interval(wrong, count, 0.9) == pytest.approx((known.low, known.high))
    assert binomial_interval(0, 0) == (0.0, 1.0)
    count, share, risk = (
        rng.integers(0, 500, 300),
        rng.uniform(0.01, 0.6, 300),
        rng.uniform(0.01, 0.5, 300),
    )
    for case in zip(count, share, risk, strict=True):
        most, of = int(most_failures(*case)), case[:2]
        assert most == -1 or binom.cdf(most, *of) <= case[2]
        assert binom.cdf(most + 1, *of) > case[2]
    one, other = rng.integers(0, 9, (2, 50))  # with ties
    assert rank_correlation(one, other) == pytest.approx(spearmanr(one, other).statistic)
    assert rank_correlation(np.zeros(3), np.arange(3.0)) is None


def test_rows_of_one_group_count_as_one():
    values = np.repeat(np.random.default_rng(0).normal(size=20), 10)
    assert standard_error(values) == pytest.approx(values.std(ddof=1) / np.sqrt(200))
    alone = mean_and_error(values, np.arange(200))[1]
    together = mean_and_error(values, np.repeat(np.arange(20), 10))[1]
    assert together == pytest.approx(values[::10].std(ddof=1) / np.sqrt(20), rel=0.03)
    assert together > 3 * alone
    assert mean_and_error(values, np.zeros(200)) == (pytest.approx(values.mean()), np.inf)


def test_one_gain_alone_is_no_sure_one():
    assert not is_surely_above(np.array([9.0]), 1.0) and is_surely_above(np.array([9.0, 8.0]), 1.0)
    assert not is_surely_above(np.array([9.0, 8.0]), 1.0, least=8.5)


def test_neighbours_that_err_together_are_as_few():
    """By Kish's ratio estimator, with its bound of few groups."""
    rng = np.random.default_rng(0)
    group = rng.integers(0, 12, 200)
    bad = rng.random(200) < rng.random(12)[group]
    counts, wrong, share = np.bincount(group), np.bincount(group, bad), bad.mean()
    between = 12 / 11 * ((wrong - share * counts) ** 2).sum() / 200 / (share * (1 - share))
    assert design_effect(bad, group) == pytest.approx(
        between * 11 / chi2.ppf(1 - SURE_OF_EFFECT, 11)
    )
    assert design_effect(bad, 0 * group) == design_effect(bad | True, group) == 1.0


def test_a_quantile_of_exchangeable_values_holds_its_share():
    rng = np.random.default_rng(0)
    drawn = rng.exponential(size=(4000, 20))
    held = np.mean([one[-1] <= conformal_quantile(one[:-1], 0.8) for one in drawn])
    assert held == pytest.approx(0.8, abs=0.02)
    assert conformal_quantile(drawn[0, :5], 0.9) == np.inf


def test_rows_out_of_reach_are_in_no_coverage():
    held, width = coverage_and_width(np.array([-1.0, 3, 0]), np.array([2.0, 1, np.nan]))
    assert (held, width) == (0.5, 3.0)


def test_a_censored_row_is_one_of_the_errors_it_allows():
    error, mass = censored_distribution(np.array([0.0, 1, 2, 1.5]), np.array([0, 0, 0, 1]))
    assert error.tolist() == [0, 1, 2] and mass == pytest.approx([3 / 8, 3 / 8, 1 / 4])


@pytest.mark.parametrize(
    ("score", "risk"),
    [([3.0, 1, 2], [0, 0.15, 0.4]), ([0.0, 0, 0], [0.4, 0.4, 0.4])],
    ids=["by hand", "equal"],
)
def test_risk_of_the_surest(score, risk):
    """Equal scores have no order: theirs is the mean."""
    assert np.allclose(risk_coverage(np.array(score), np.array([0.0, 0.9, 0.3])), risk)


def test_threshold_counts_the_bad_and_bounds_their_share():
    score = np.linspace(1, 0, 400)
    bad = np.arange(400) >= 200
    levels = threshold_levels(score, bad, 400, *TENTHS)
    found = choose_threshold(score, bad, levels, *TENTHS)
    assert 180 <= found.accepted < 230 and found.bad == max(0, found.accepted - 200)
    assert found.bound(0.1) <= 0.1 + 1e-9
    assert choose_threshold(score, np.ones(400, bool), levels, *TENTHS).value == float("inf")
    assert Threshold(0.0, 0, 0).bound(0.1) == 1.0


def test_too_few_to_test_promise_nothing():
    score, good = np.linspace(1, 0, 15), np.zeros(15, bool)
    found = choose_threshold(score, good, threshold_levels(score, good, 15, *TENTHS), *TENTHS)
    assert found.accepted == 0  # 0.9^15 = 0.2 > delta


def accepting(share, aside, risks, least=-np.inf, sets=300):
    """Of sets of rows that are bad with `share` (n,), surest first,
    how many accept scores below `least`.
    """
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(sets):
        row = rng.permutation(len(share))
        score, bad = -row / len(share), rng.random(len(share)) < share[row]
        levels = threshold_levels(score[:aside], bad[:aside], len(share) - aside, *risks)
        threshold = choose_threshold(score[aside:], bad[aside:], levels, *risks)
        found += threshold.accepted > 0 and (least == -np.inf or threshold.value < least)
    return found / sets


@pytest.mark.parametrize("share", [0.08, 0.22])
def test_one_bad_row_of_the_surest_ended_the_search(share):
    """Of 60 rows the first test was one of five:
    sets that promised something were .67 and .24 of all.
    """
    assert accepting(np.full(60, share), 12, LAX, sets=200) > (0.95 if share == 0.08 else 0.42)


def test_where_the_search_begins_misleads_no_more_sets_than_promised():
    """With `alpha` bad at every threshold, and with errors that grow beyond half of the rows."""
    assert accepting(np.full(60, 0.3), 12, LAX) < 0.2
    growing = np.where(np.arange(60) < 30, 0.3, 0.6)
    assert accepting(growing, 12, LAX) < 0.2 and accepting(growing, 12, LAX, -0.5) < 0.1
    # Whatever the score, of six that choose levels and thirteen that calibrate.
    assert 0.02 < accepting(0.2 * np.ones(19), 6, (0.2, 0.1)) < 0.1


def test_variances_are_mended_as_surely_as_rows_tell():
    """Variances four times too large were halved alone: rows as stated were added to the mean."""
    rng = np.random.default_rng(0)
    alike = rng.chisquare(400, 32) / 400
    for right in (0.22, 1.0, 4.0):
        assert variance_factor(right * alike) == pytest.approx(right, rel=0.07)
        inverse = 1 / variance_factor(right / alike)
        assert variance_factor(alike / right) == pytest.approx(inverse, rel=0.02)
    single = [variance_factor(4 * rng.exponential(size=5)) for _ in range(200)]
    assert 1.5 < np.exp(np.mean(np.log(single))) < 3.5  # shrunk: five entries tell little
    assert 0 < variance_factor(np.zeros(9)) < 1e-6
