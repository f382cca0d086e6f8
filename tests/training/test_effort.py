"""What a fit counts, its seconds, and that none of these end it."""

import pickle

import pytest
import yaml
from campaigns import compose
from clocks import WoundClock, wound
from doors import knock
from refusals import refused

import gsparc
from gsparc.commands.listing import COMMANDS
from gsparc.runs.continued import add_settings_of_run
from gsparc.runs.settings import RunSettings
from gsparc.training.context import FitContext
from gsparc.training.effort import INSTEAD, Effort
from gsparc.training.stopwatch import Stopwatch


def test_an_effort_multiplies_every_count_and_rows_by_its_cube_root():
    usual, more = Effort(), Effort().scale_by(8.0)
    assert Effort().scale_by(1.0) == usual and more.evaluations == 8 * usual.evaluations
    assert more.chosen_on == 2 * usual.chosen_on and Effort().scale_by(1e-6).chosen_on == 150
    assert more.factor == 8.0 and Effort().scale_by(0.3).factor == 0.3
    refused("effort=0: a number above 0 is needed", FitContext, effort=0)


def test_what_was_spent_before_and_elsewhere_counts(monkeypatch):
    """Processes of several devices are given a watch of theirs, by pickling."""
    clocks, watch = wound(monkeypatch), Stopwatch(before=70.0, cpu_before=5.0)
    clocks.monotonic.wind(2.0)
    clocks.process_time.wind(1.0)
    watch.charge(8.0, cpu=2.0)
    sent = pickle.dumps(watch)
    clocks.process_time = WoundClock()  # another process has used none yet
    there = pickle.loads(sent)
    clocks.process_time.wind(0.5)
    assert watch.seconds == pytest.approx(80.0, abs=0.01) == there.seconds
    assert there.cpu_seconds == pytest.approx(8.5, abs=0.01) and watch.cpu_elsewhere == 7.0


@pytest.mark.parametrize(
    ("command", "word"),
    [
        ("train", "budget_s=60"),
        ("train", "+budget_clock=wall"),
        ("train", "model.budget_s=3"),
        ("compare", "budgets=[{seconds: 5, seeds: [0]}]"),
        ("map", "promise.budget_s=1"),
    ],
)
def test_seconds_on_the_command_line_are_refused_with_what_to_say_instead(command, word):
    answer = knock(COMMANDS[command].run, command, [word])
    assert answer.status == 1 and answer.err == [f"error: {word.lstrip('+')}: {INSTEAD}"]
    assert "effort=" in INSTEAD and "efforts=" in INSTEAD and "trainer.max_time=" in INSTEAD


def test_seconds_of_a_file_or_in_python_are_refused():
    with pytest.raises(ValueError, match="budget_s=60: no seconds end a fit"):
        RunSettings.from_config(compose("+budget_s=60", "logger=none"))
    refused(
        "budget_s=1: no seconds end a fit", gsparc.fit, rx=[[0.0, 0, 0]], rssi=[1.0], budget_s=1
    )


def test_a_run_that_seconds_ended_goes_on_without_them(tmp_path):
    notes = {
        "overrides.yaml": ["budget_s=9", "seed=3"],
        "hydra.yaml": {"hydra": {"runtime": {"cwd": "/"}}},
    }
    (tmp_path / ".hydra").mkdir()
    for name, told in notes.items():
        (tmp_path / ".hydra" / name).write_text(yaml.safe_dump(told))
    words = [f"ckpt_path={tmp_path}", "hydra.run.dir=x"]
    assert add_settings_of_run(words) == ["seed=3", "hydra.mode=RUN", *words]
