"""The clock: turns, warm-up, seconds, machine facts."""

import torch
from clocks import WoundClock

from gsparc.prediction import timing
from gsparc.prediction.timing import (
    ClockSettings,
    machine_facts,
    peak_memory,
    reference_copy,
    time_interleaved,
)


def test_contenders_take_turns_after_warming_up():
    calls: list[tuple[str, int]] = []
    contenders = {name: (lambda turn, name=name: calls.append((name, turn))) for name in "ab"}
    times = time_interleaved(contenders, ClockSettings(rounds=3, warmup=1))
    assert calls[2:] == [("a", 0), ("b", 0), ("a", 1), ("b", 1), ("a", 2), ("b", 2)]
    assert {name: len(values) for name, values in times.items()} == {"a": 3, "b": 3}


def test_seconds_stop_rounds_but_not_below_the_least(monkeypatch):
    watch = WoundClock()
    monkeypatch.setattr(timing.time, "perf_counter", watch)
    slow = {"slow": lambda turn: watch.wind(0.02)}
    times = time_interleaved(slow, ClockSettings(rounds=1000, least=4, warmup=0, rounds_s=0.01))
    assert len(times["slow"]) == 4 and (abs(times["slow"] - 20) < 1).all()
    assert (
        len(
            time_interleaved(slow, ClockSettings(rounds=1000, least=4, warmup=0, rounds_s=0.5))[
                "slow"
            ]
        )
        == 25
    )


def test_facts_are_numbers_and_words():
    facts = {**machine_facts(), **peak_memory()}
    assert facts["machine/threads"] >= 1 and facts["machine/load"] >= 0 and facts["machine/cpu"]
    assert 10 < facts["memory/peak_mb"] < 1e6


def test_reference_work_takes_time(monkeypatch):
    monkeypatch.setattr("gsparc.prediction.timing.COPY_BYTES", 2**24)  # as it is outside of tests
    times = time_interleaved({"copy": reference_copy()}, ClockSettings(rounds=5))["copy"]
    assert (times > 0.05).all()


def test_contenders_are_timed_with_their_own_threads():
    seen: list[tuple[str, int, int]] = []
    before = torch.get_num_threads()

    def call(name):
        return lambda number: seen.append((name, number, torch.get_num_threads()))

    clock = ClockSettings(rounds=3, least=3, warmup=0, calls=2, untimed=1)
    times = time_interleaved(
        {"a": call("a"), "b": call("b"), "c": call("c")}, clock, {"a": 1, "b": 2, "c": 1}
    )
    assert {len(ms) for ms in times.values()} == {6} and torch.get_num_threads() == before
    assert {(name, threads) for name, _, threads in seen} == {("a", 1), ("b", 2), ("c", 1)}
    first = [name for name, _, _ in seen[:9]]
    assert len(set(first[:3])) == 1 and set(first) == {"a", "b", "c"}
