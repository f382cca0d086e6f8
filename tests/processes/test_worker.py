"""What a computation asks of who waits for it: whether to end, and whether it is late."""

import threading

import pytest

from gsparc.processes.worker import (
    Cancelled,
    cancel_when,
    end_when,
    out_of_steps,
    raise_if_cancelled,
    step_limit,
)


def test_work_ends_when_anyone_around_it_says_so_and_not_afterwards():
    asked = []
    with cancel_when(lambda: asked.append("outer") or len(asked) > 2), cancel_when(lambda: False):
        raise_if_cancelled()
        raise_if_cancelled()
        with pytest.raises(Cancelled):
            raise_if_cancelled()
    raise_if_cancelled()
    assert asked == ["outer"] * 3


def test_it_is_late_after_so_many_steps_of_this_thread_alone():
    seen = []

    def work():
        with end_when(step_limit(2)):
            for _ in range(3):
                seen.append(out_of_steps())
                raise_if_cancelled()

    thread = threading.Thread(target=work)
    with end_when(lambda: True):
        thread.start()
        thread.join()
        assert out_of_steps()
    assert seen == [False, False, True] and not out_of_steps()
