"""What a computation asks of who waits for it: whether to end, and whether it is late."""

import threading

import pytest

from gsparc.processes.worker import (
    Cancelled,
    after_steps,
    cancelled_by,
    ending_when,
    out_of_time,
    raise_if_cancelled,
    stop_when_late,
)


def test_work_ends_when_anyone_around_it_says_so_and_not_afterwards():
    asked = []
    with cancelled_by(lambda: asked.append("outer") or len(asked) > 2), cancelled_by(lambda: False):
        raise_if_cancelled()
        raise_if_cancelled()
        with pytest.raises(Cancelled):
            raise_if_cancelled()
    raise_if_cancelled()
    assert asked == ["outer"] * 3


def test_it_is_late_after_so_many_steps_of_this_thread_alone():
    seen = []

    def work():
        with ending_when(after_steps(2)):
            for _ in range(3):
                seen.append(out_of_time())
                raise_if_cancelled()

    thread = threading.Thread(target=work)
    with ending_when(lambda: True):
        thread.start()
        thread.join()
        assert out_of_time()
        with pytest.raises(StopIteration):
            stop_when_late()
    assert seen == [False, False, True] and not out_of_time()
