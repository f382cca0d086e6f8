"""A file that several write: one at a time, in turn, whatever becomes of them."""

import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from gsparc.base.locks import hold_file

HOLDS = """
import sys, time
from gsparc.base.locks import hold_file
while True:
    with hold_file(sys.argv[1], 60):
        print("held", flush=True)
        time.sleep(float(sys.argv[2]))
"""


@contextmanager
def another(file, seconds):
    """A process that holds a file for so long, again and again."""
    words = [sys.executable, "-c", HOLDS, str(file), str(seconds)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        try:
            yield
        finally:
            process.kill()


def test_a_process_that_was_killed_holds_nothing(tmp_path):
    file = tmp_path / "a.ckpt"
    with another(file, 60), pytest.raises(TimeoutError), hold_file(file, 0.1):
        pass
    with hold_file(file, 0):
        pass
    assert not list(tmp_path.iterdir())  # nothing is left beside models


def test_who_writes_again_and_again_lets_others_in(tmp_path):
    """A server under load took the lock back before `gsparc update` looked: 5 s were not enough."""
    file = tmp_path / "a.ckpt"
    with another(file, 0.05):
        for _ in range(3):
            with hold_file(file, 2):
                time.sleep(0.05)
