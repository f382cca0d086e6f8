"""Only the newest of what is asked is done, and nothing waits for a long job."""

import threading
import time

import pytest

from gsparc.apps.view.latest_job import LatestJobQueue


@pytest.fixture
def work():
    running = LatestJobQueue()
    yield running
    running.close()


def settle(work, seconds=5.0):
    end = time.monotonic() + seconds
    while work._jobs and time.monotonic() < end:
        time.sleep(0.005)
    assert not work._jobs


def job(done, *said, begun=None, go=None):
    """Appends each of `said` in a step of its own; with events,
    begins and waits until it may go on.
    """

    def steps():
        if begun is not None:
            begun.set()
            go.wait(5)
        for one in said:
            done.append(one)
            yield

    return steps


@pytest.mark.parametrize(
    ("first", "then", "order"),
    [
        (("drag", ["first"]), [("drag", [number], False) for number in range(100)], ["first", 99]),
        (("plane", [0, 1, 2]), [("answer", ["answer"], True)], [0, "answer", 1, 2]),
        (("a", ["a"] * 3), [("b", ["b"] * 3, False)], ["a", "b"] * 3),
    ],
    ids=[
        "of many drags the first and last",
        "urgent between steps of a long one",
        "two clients by turns",
    ],
)
def test_order(work, first, then, order):
    done, begun, go = [], threading.Event(), threading.Event()
    key, said = first
    work.put(key, job(done, *said, begun=begun, go=go))
    assert begun.wait(5)
    for key, said, urgent in then:
        work.put(key, job(done, *said), urgent=urgent)
    go.set()
    settle(work)
    assert done == order


def test_a_job_that_fails_does_not_end_the_others(work, caplog):
    done = []

    def wrong():
        raise ZeroDivisionError("a plane without cells")
        yield

    work.put("a", wrong)
    settle(work)
    work.put("a", job(done, 1))
    settle(work)
    assert done == [1] and "a step of a failed" in caplog.text
