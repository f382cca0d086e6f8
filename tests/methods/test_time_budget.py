"""Seconds of a fit: which clock counts them, and whether they ended something."""

from __future__ import annotations

import time

import pytest
import torch
from rooms import shoebox

from gsparc.methods.method import FitContext
from gsparc.methods.time_budget import TimeBudget
from gsparc.multipath.image_source_gp import ImageSourceGP


def test_processor_time_does_not_count_what_others_do():
    torch.set_num_threads(1)
    wall, own = TimeBudget(0.05), TimeBudget(0.05, "processor")
    time.sleep(0.1)
    assert wall.over() and wall.limited and not own.over() and not own.limited
    until = time.process_time() + 0.1
    while time.process_time() < until:
        pass
    assert own.over() and own.limited


def test_what_was_spent_before_counts():
    budget = TimeBudget(100.0, spent_s=70.0)
    assert 70 <= budget.spent < 71 and budget.over(0.6) and not budget.over(0.8)


def test_another_clock_is_refused(tmp_path):
    with pytest.raises(ValueError, match="budget_clock='sun': one of wall, processor is needed"):
        FitContext(tmp_path, budget_clock="sun")


@pytest.mark.parametrize("seconds,limited", [(0.01, True), (1e4, False)])
def test_a_search_that_the_clock_ended_says_so(tmp_path, seconds, limited):
    """Under load a search found fewer sources, and nothing told that the result was the machine's."""
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    method = ImageSourceGP(searches=2, clutter=False)
    report = method.fit(data, fold, FitContext(tmp_path, budget_s=seconds))
    assert report.time_limited is limited
    assert any("ended by the time budget" in note for note in report.notes) is limited
