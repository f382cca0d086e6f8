"""Workers that share the cells of a comparison: each cell is filled once, also when one worker is killed."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
from invented import invent

from gsparc.data import files
from gsparc.evaluation.experiment import fitting
from gsparc.evaluation.experiment.cells import Cell
from gsparc.evaluation.experiment.fitting import Filled, Prepared
from gsparc.evaluation.experiment.problem import Problem

FORK = multiprocessing.get_context("fork")
BROKEN = {5: ValueError, 7: AttributeError}  # the latter, a bug of a plugin, ended the comparison of all
COUNT = 10


def worker(folder: Path, killed_at: int | None = None) -> None:
    problem = Problem("toy", "random", "spectrum", ("d", "s"), data=invent("spectrum", 12))
    cells = [Cell("toy", "random", f"m{number}", None, None) for number in range(COUNT)]
    prepared = [Prepared(cell, problem, None, folder / f"toy-random-{cell.method}-k") for cell in cells]

    def fill(one: Prepared) -> Filled:
        number = int(one.cell.method[1:])
        with (folder / "begun").open("a") as file:
            file.write(f"{number}\n")
        if number == killed_at:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.02)
        if number in BROKEN:
            raise BROKEN[number]("this method does not serve these data")
        facts = {"dataset/kind": "spectrum", "time/train_s": 0.0}
        (one.folder / "cell.json").write_text(json.dumps(facts))
        return Filled(one.cell, one.folder, facts)

    fitting.fill, files.POLL_S = fill, 0.02
    filled = fitting.fill_all(prepared, failed=fitting.Failed(folder))
    assert [one.cell.method for one in filled] == [f"m{n}" for n in range(COUNT) if n not in BROKEN]


@pytest.mark.parametrize("killed_at", [None, 2])
def test_every_cell_is_filled_once(tmp_path, killed_at):
    workers = [FORK.Process(target=worker, args=(tmp_path, at)) for at in (killed_at, None)]
    workers[0].start()
    while killed_at is not None and workers[0].is_alive():
        time.sleep(0.01)  # the other must not pass by its cell before
    workers[1].start()
    for one in workers:
        one.join(120)
    assert workers[0].exitcode == (0 if killed_at is None else -signal.SIGKILL) and workers[1].exitcode == 0
    begun = sorted(map(int, (tmp_path / "begun").read_text().split()))
    assert begun == sorted([*range(COUNT), *([] if killed_at is None else [killed_at])])
    for number in BROKEN:
        assert "does not serve" in (tmp_path / "failed" / f"toy-random-m{number}-k").read_text()


def test_what_failed_in_an_earlier_multirun_is_tried_again(tmp_path):
    """Its folder was never emptied: said again, the command left out what it had been mended for."""
    failed = fitting.Failed(tmp_path)
    failed.add("cell", "no room")
    assert failed.has("cell") and not failed.has("other")
    written = (tmp_path / "failed" / "cell").stat().st_mtime_ns
    start = tmp_path / "multirun.yaml"
    start.write_text("")
    for earlier, known in ((1, True), (-1, False)):
        os.utime(start, ns=(written - earlier, written - earlier))
        assert failed.has("cell") is known
