"""Seconds of a fit: which clock counts them, and whether they ended something."""

import pickle
import time
from dataclasses import replace

import pytest
import torch
from clocks import wound
from rooms import shoebox

from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.training.context import FitContext
from gsparc.training.time_budget import Effort, Spent, TimeBudget, worst_clock


def test_processor_time_does_not_count_what_others_do():
    torch.set_num_threads(1)
    wall, own = TimeBudget(0.05), TimeBudget(0.05, "processor")
    time.sleep(0.1)
    assert wall.is_spent() and wall.limited and not own.is_spent() and not own.limited
    until = time.process_time() + 0.1
    while time.process_time() < until:
        pass
    assert own.is_spent() and own.limited


def test_what_was_spent_before_counts():
    budget = TimeBudget(100.0, before=Spent(wall=70.0))
    assert 70 <= budget.spent < 71 and 29 < budget.left_s <= 30 and not budget.is_spent()


def test_what_is_charged_counts_by_both_clocks(monkeypatch):
    clocks = wound(monkeypatch)
    budget = TimeBudget(10.0, "processor")
    clocks.process_time.wind(2.0)
    clocks.monotonic.wind(50.0)
    budget.restart()
    assert budget.spent == pytest.approx(2.0, abs=0.01) and budget.by_clock.wall == pytest.approx(
        50, abs=0.01
    )
    budget.charge(Spent(wall=1.0, processor=7.0))
    assert not budget.is_spent() and budget.limited_by is None
    clocks.process_time.wind(1.1)
    assert budget.is_spent() and budget.limited_by == "processor"


def test_of_two_clocks_the_wall_is_less_repeatable():
    assert worst_clock("processor", None, "wall") == "wall"
    assert worst_clock(None, "processor") == "processor"
    assert worst_clock() is None is worst_clock(None, None)


def test_a_budget_survives_pickling():
    """Processes of several devices are given theirs."""
    budget = TimeBudget(10.0, "processor", Spent(1.0, 3.0))
    assert pickle.loads(pickle.dumps(budget)).spent >= 3


def test_another_clock_is_refused(tmp_path):
    with pytest.raises(ValueError, match="budget_clock='sun': one of wall, processor is needed"):
        FitContext(tmp_path, budget_clock="sun")


@pytest.mark.parametrize("seconds,limited", [(0.01, True), (1e4, False)])
def test_a_search_that_the_clock_ended_says_so(tmp_path, seconds, limited):
    """Under load a search found fewer sources, and nothing told that the result was the machine's."""
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    method = ImageSourceGP(searches=2, clutter=False)
    report = method.fit(data, fold, FitContext(tmp_path, budget_s=seconds))
    assert report.limited_by == ("wall" if limited else None)
    assert any("ended by the time budget" in note for note in report.notes) is limited


def test_searches_for_offsets_are_counted_by_the_same_clock_and_may_be_ended_by_it(tmp_path, monkeypatch):
    """They had 120 seconds of the wall each, and nothing told when these ended one."""
    budgets, search = [], ImageSourceGP._run_searches

    def ended(self, rows, settings, budget, *rest):
        found = search(self, rows, settings, budget, *rest)
        budget.limited |= not budgets
        budgets.append(budget)
        return found

    monkeypatch.setattr(ImageSourceGP, "_run_searches", ended)
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    method = ImageSourceGP(searches=1, search_rows=60, clutter=False, offsets="phase_timing")
    report = method.fit(data, fold, FitContext(tmp_path, budget_s=1e3, budget_clock="processor"))
    assert len(budgets) == 3 and {(b.clock, b.seconds) for b in budgets} == {("processor", 1e3)}
    assert report.limited_by == "processor"


def test_an_effort_multiplies_every_count_and_rows_by_its_cube_root():
    usual, more = Effort(), Effort().scale_by(8.0)
    assert Effort().scale_by(1.0) == usual and more.evaluations == 8 * usual.evaluations
    assert more.chosen_on == 2 * usual.chosen_on and Effort().scale_by(1e-6).chosen_on == 150
    with pytest.raises(ValueError, match="effort=0: a number above 0 is needed"):
        FitContext(effort=0)


def test_a_warning_named_what_reading_had_left_of_the_seconds():
    """`budget_s=6` was told as `budget_s=0.6: none is left`, which nobody had set."""
    part = replace(FitContext(budget_s=6.0), budget_s=0.6).for_part("fold0", budget_s=0.3)
    assert (part.budget_s, part.asked_s) == (0.3, 6.0)
