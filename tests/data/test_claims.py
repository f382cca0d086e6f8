"""Pieces of work shared by processes: each is done once, also when a process is killed amid one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from gsparc.data import files

FORK = multiprocessing.get_context("fork")


def share(folder: Path, dies_at: int | None = None) -> None:
    """Twelve pieces, each a line in its file; `begun` remembers who began what."""

    def work(piece: int) -> None:
        with (folder / "begun").open("a") as file:
            file.write(f"{piece} {os.getpid()}\n")
        if piece == dies_at:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.01)
        (folder / f"{piece}.done").write_text("x")

    files.POLL_S = 0.02
    done = lambda piece: (folder / f"{piece}.done").exists()  # noqa: E731
    files.each_once(range(12), lambda piece: folder / f"{piece}.lock", done, work)


def begun(folder: Path) -> list[tuple[int, int]]:
    rows = [line.split() for line in (folder / "begun").read_text().splitlines()]
    return [(int(piece), int(process)) for piece, process in rows]


@pytest.mark.parametrize("dies_at", [None, 3])
def test_every_piece_is_done_once_and_that_of_a_killed_process_is_taken_over(tmp_path, dies_at):
    first = FORK.Process(target=share, args=(tmp_path, dies_at))
    first.start()
    while dies_at is not None and first.is_alive():
        time.sleep(0.01)
    second = FORK.Process(target=share, args=(tmp_path,))
    second.start()
    first.join(60)
    second.join(60)
    assert first.exitcode == (0 if dies_at is None else -signal.SIGKILL) and second.exitcode == 0
    pieces = [piece for piece, _ in begun(tmp_path)]
    again = [] if dies_at is None else [dies_at]
    assert sorted(pieces) == sorted([*range(12), *again])


def test_a_claim_is_one_process_s_and_ends_with_its_block(tmp_path):
    lock = tmp_path / "new" / "piece.lock"
    with files.claimed(lock) as mine, files.claimed(lock) as other:
        assert mine and not other
    with files.claimed(lock) as again:
        assert again


def test_a_failure_ends_the_claim_and_is_not_swallowed(tmp_path):
    def fails(piece: int) -> None:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        files.each_once([1], lambda piece: tmp_path / "lock", lambda piece: False, fails)
    with files.claimed(tmp_path / "lock") as mine:
        assert mine
