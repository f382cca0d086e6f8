"""Pieces of work: the same results wherever they are done,
each stored once though its process dies.
"""

import logging
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from threading import Barrier

import cloudpickle
import numpy as np
import pytest

from gsparc.base import executor
from gsparc.base.executor import Engine, run_each
from gsparc.base.limits import SettingError

cloudpickle.register_pickle_by_value(sys.modules[__name__])
COUNT = 12
ELSEWHERE = [
    "joblib",
    pytest.param("ray", marks=pytest.mark.rare),
]  # half a minute each, alike


class Stored:
    """Stores the square of a piece and who began it; the `killed` one ends its process,
    once or always.
    """

    def __init__(self, folder: Path, killed: int | None = None, always: bool = False) -> None:
        self.folder, self.killed, self.always = folder, killed, always

    def __call__(self, piece: int) -> int:
        file = self.folder / f"{piece}.npy"
        if not file.exists():
            begun = self.folder / f"{piece}.begun"
            before = begun.exists()
            with begun.open("a") as lines:
                lines.write(f"{os.getpid()}\n")
            if piece == self.killed and (self.always or not before):
                os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(0.02)
            half = self.folder / f"{piece}.{os.getpid()}.half.npy"
            np.save(half, piece * piece)
            half.rename(file)  # joblib kills the other process at any moment
        return int(np.load(file))


def test_here_pieces_are_done_in_order_and_what_is_not_wanted_is_left_out(tmp_path):
    found = list(run_each(Stored(tmp_path), range(COUNT), wanted=lambda piece: piece % 3 > 0))
    assert found == [(n, n * n) for n in range(COUNT) if n % 3]
    assert {int(file.read_text()) for file in tmp_path.glob("*.begun")} == {os.getpid()}


def test_threads_of_this_process_do_pieces_side_by_side():
    three = Barrier(3, timeout=60)  # none ends before three have begun
    found = list(run_each(lambda piece: (three.wait(), piece)[1], range(6), threads=3))
    assert sorted(found) == [(n, n) for n in range(6)]


def test_one_line_says_how_many_are_left_and_how_long(caplog, monkeypatch):
    monkeypatch.setattr(executor, "SAY_S", 0.0)
    monkeypatch.setattr(executor, "LINES", 100)
    caplog.set_level(logging.INFO, "gsparc")
    list(run_each(lambda piece: time.sleep(piece / 10), [1, 3], "cells", cost=float))
    assert caplog.messages in (["1 of 2 cells, about 0 s left"], ["1 of 2 cells, about 1 s left"])


def test_the_time_left_of_long_cells_was_that_of_short_ones():
    """7 of 12 cells, about 67 s left; then 9 of 12, about 67 s left; 230 s followed."""
    spent = {7.0: [1.0, 1.0, 1.0], 14.0: [36.0]}  # methods without a budget are guessed at 7
    assert executor._time_left({7.0: 0, 14.0: 5}, spent) == 180
    assert executor._time_left({7.0: 2, 14.0: 2}, {7.0: [1.0]}) == pytest.approx(2 + 28 / 7)


def test_an_error_ends_the_work_here():
    seen = []
    with pytest.raises(ZeroDivisionError):
        list(run_each(lambda piece: seen.append(piece) or 1 // piece, [2, 1, 0, 5]))
    assert seen == [2, 1, 0]


def test_settings_that_cannot_be_are_refused(monkeypatch):
    with pytest.raises(SettingError, match="one of process, joblib, ray"):
        Engine("dask")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SettingError, match=r"pip install 'gsparc\[ray\]'"):
        executor.use_engine(Engine("ray"))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ELSEWHERE)
def test_a_piece_whose_process_dies_is_begun_again_and_no_stored_one(tmp_path, engine, elsewhere):
    elsewhere(engine)
    found = dict(run_each(Stored(tmp_path, killed=4), range(COUNT)))
    assert found == {n: n * n for n in range(COUNT)}
    begun = {int(file.stem): file.read_text().split() for file in tmp_path.glob("*.begun")}
    assert len(begun[4]) == 2 and len(set().union(*begun.values())) > 1
    assert sum(map(len, begun.values())) <= COUNT + 2  # joblib ends the other process, too
    assert str(os.getpid()) not in set().union(*begun.values())
    files = [tmp_path / f"{n}.npy" for n in range(COUNT)]
    before = [file.stat().st_mtime_ns for file in files]
    assert dict(run_each(Stored(tmp_path), range(COUNT))) == found
    assert before == [file.stat().st_mtime_ns for file in files]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ELSEWHERE)
def test_an_error_is_raised_as_it_is_and_the_others_are_cancelled(engine, elsewhere):
    elsewhere(engine)
    list(run_each(abs, [1, 2]))  # workers are there
    with pytest.raises(ZeroDivisionError, match=r"^integer division or modulo by zero$"):
        list(run_each(lambda piece: 1 // piece if piece < 2 else time.sleep(3600), [0, 2, 3, 4]))


INTERRUPTED = """
import sys, time
from gsparc.base import executor
if __name__ == "__main__":
    executor.use_engine(executor.Engine(sys.argv[1], 2))
    list(executor.run_each(abs, [1, 2]))
    print("begun", flush=True)
    try:
        list(executor.run_each(time.sleep, [3600] * 4))
    except KeyboardInterrupt:
        print("interrupted", flush=True)
        sys.exit(130)
"""


@pytest.mark.slow
@pytest.mark.parametrize("engine", ELSEWHERE)
def test_an_interrupt_ends_the_work(tmp_path, engine):
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    (tmp_path / "work.py").write_text(INTERRUPTED)
    heard = partial(
        signal.signal, signal.SIGINT, signal.default_int_handler
    )  # whoever runs tests may ignore it
    command = [sys.executable, tmp_path / "work.py", engine]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=heard
    ) as one:
        assert one.stdout.readline() == "begun\n"
        time.sleep(1)
        os.killpg(one.pid, signal.SIGINT)  # as a terminal does
        assert one.wait(500) == 130 and one.stdout.read() == "interrupted\n"


def test_threads_ended_in_compiled_code_at_an_interrupt():
    """`gsparc map` aborted (exit status -6) at Ctrl-C:
    what had begun was left to the end of the process.
    """
    ended = []

    def work(piece):
        time.sleep(0.05)
        ended.append(piece)

    with pytest.raises(KeyboardInterrupt):
        for _ in run_each(work, range(8), threads=2):
            raise KeyboardInterrupt
    assert len(ended) <= 4  # those begun, and no others
    before = list(ended)
    time.sleep(0.1)
    assert ended == before


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [2, pytest.param(4, marks=pytest.mark.rare)])
def test_a_node_of_ray_is_lost_half_way(tmp_path, nodes, elsewhere):
    cluster = elsewhere("ray", nodes=nodes)
    found, lost = {}, None
    for number, value in run_each(Stored(tmp_path), range(4 * COUNT)):
        found[number] = value
        if len(found) == COUNT:
            lost = cluster.list_all_nodes()[-1]
            cluster.remove_node(lost, allow_graceful=False)
    assert found == {n: n * n for n in range(4 * COUNT)} and lost is not None
    begun = [len(file.read_text().split()) for file in tmp_path.glob("*.begun")]
    assert sum(begun) <= 4 * COUNT + 1  # what the lost node was at
