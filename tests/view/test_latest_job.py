"""Only the newest of what is asked is done, and nothing waits for a long job."""

from __future__ import annotations

import threading
import time

import pytest

from gsparc.view.latest_job import LatestJobQueue


@pytest.fixture
def work():
    running = LatestJobQueue()
    yield running
    running.close()


def settle(work, seconds=5.0):
    end = time.monotonic() + seconds
    while len(work) and time.monotonic() < end:
        time.sleep(0.005)
    assert not len(work)


def once(act):
    def job():
        act()
        yield

    return job


def test_of_many_drags_the_first_and_the_last_are_answered(work):
    done, begun, go = [], threading.Event(), threading.Event()

    def first():
        begun.set()
        go.wait(5)
        done.append("first")
        yield

    work.ask("drag", first)
    assert begun.wait(5)
    for number in range(100):
        work.ask("drag", once(lambda number=number: done.append(number)))
    go.set()
    settle(work)
    assert done == ["first", 99]


def test_an_urgent_job_comes_between_the_steps_of_a_long_one(work):
    order, begun, go = [], threading.Event(), threading.Event()

    def plane():
        begun.set()
        go.wait(5)
        for step in range(3):
            order.append(step)
            yield

    work.ask("plane", plane)
    assert begun.wait(5)
    work.ask("answer", once(lambda: order.append("answer")), urgent=True)
    go.set()
    settle(work)
    assert order == [0, "answer", 1, 2]


def test_two_clients_take_turns(work):
    order, begun, go = [], threading.Event(), threading.Event()

    def job(name):
        def steps():
            if name == "a":
                begun.set()
                go.wait(5)
            for _ in range(3):
                order.append(name)
                yield

        return steps

    work.ask("a", job("a"))
    assert begun.wait(5)
    work.ask("b", job("b"))
    go.set()
    settle(work)
    assert order == ["a", "b"] * 3


def test_a_forgotten_client_costs_nothing_more(work):
    steps, begun = [], threading.Event()

    def endless():
        while True:
            steps.append(1)
            begun.set()
            yield

    work.ask((7, "plane"), endless)
    assert begun.wait(5)
    work.forget(lambda key: key[0] == 7)
    settle(work)
    count = len(steps)
    time.sleep(0.05)
    assert len(steps) <= count + 1


def test_a_job_that_fails_does_not_end_the_others(work, caplog):
    done = []

    def wrong():
        raise ZeroDivisionError("a plane without cells")
        yield

    work.ask("a", wrong)
    settle(work)
    work.ask("a", once(lambda: done.append(1)))
    settle(work)
    assert done == [1] and "a step of a failed" in caplog.text
