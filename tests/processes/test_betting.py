"""Bets against a claim: seldom wrong whatever is drawn, read where they may be read."""

import numpy as np
import pytest
from audit_table import area, audits, levels

from gsparc.processes.betting import ENOUGH, betting_capital, claim_capital, detectable_shares


def test_capital_does_not_depend_on_the_order_of_a_tour():
    value = np.random.default_rng(0).random((1, 40)) < 0.9
    ends = [betting_capital(v * 1.0, 0.95)[:, -1] for v in (value, np.sort(value, axis=1))]
    assert ends[0] == pytest.approx(ends[1])


def test_a_true_claim_at_its_very_share_is_seldom_settled():
    verdicts, _ = audits(area(0.95), 300)
    assert (verdicts == "stands").mean() <= 0.07 and (verdicts == "falls").mean() <= 0.07


def test_read_row_by_row_in_driving_order_a_true_claim_falls():
    value = np.sort((np.random.default_rng(0).random((50, 300)) < 0.95) * 1.0, axis=1)
    capital = claim_capital(value, value, (0.95, 1.0))[1]
    assert (capital >= ENOUGH).any(1).mean() > 0.9 and (capital[:, -1] >= ENOUGH).mean() < 0.1


@pytest.mark.parametrize(("true", "word", "most"), [(0.99, "stands", 350), (0.9, "falls", 250)])
def test_rows_that_a_verdict_takes(true, word, most):
    verdicts, rows = audits(area(true), 60)
    assert (verdicts == word).mean() > 0.95 and np.median(rows) <= most


def test_a_model_that_marks_what_is_bad_saves_rows_and_one_that_errs_costs_few():
    even, good, bad = (
        np.median(audits(area(0.9, 0.2, recall), 150, most=900)[1]) for recall in (None, 0.7, 0.0)
    )
    assert good <= 0.75 * even and bad <= 1.3 * even


@pytest.mark.parametrize("fails", [True, False])
def test_what_nobody_reached_never_settles_a_claim_wrongly(fails):
    verdicts, _ = audits(area(0.95, corner=0.04, corner_fails=fails), 150, most=600)
    assert (verdicts != "open").mean() <= 0.07


def test_a_claim_of_levels():
    within = (-3.0, 3.0)
    words = [levels(bias, within, 100)[0] for bias in (0, 6, 3)]
    assert (words[0] == "stands").mean() > 0.95 and (words[1] == "falls").mean() > 0.95
    assert (words[2] == "open").mean() > 0.9


def test_few_rows_show_little():
    below, above = detectable_shares(60, 0.95, 0.8)
    assert 0.79 < below < 0.81 and np.isnan(above)
    assert detectable_shares(400, 0.95)[1] < 0.99
