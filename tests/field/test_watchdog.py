"""No phase of any fit computes for a second without looking at interrupts."""

import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType

import pytest
import torch
from campaigns import channels, compose, fit_context, powers, spectra
from kinds import moving_array, static_array

from gsparc.datasets.load import load, split_for
from gsparc.models.registry import build
from gsparc.processes import worker

OFTEN_S = 0.02  # between signals, as Ctrl-C would come


@dataclass
class Looks:
    """The longest that any thread computed between two looks [s], and where the second look was."""

    longest: tuple[float, str] = (0.0, "")
    _last: dict[int, float] = field(default_factory=dict)

    def look(self, frame: FrameType | None = None) -> None:
        """This thread looks now."""
        key, now = threading.get_ident(), time.thread_time()
        gap = now - self._last.get(key, now)
        self._last[key] = now
        if gap > self.longest[0]:
            stack = traceback.extract_stack(frame or sys._getframe(2), limit=9)
            where = " < ".join(
                f"{one.filename.rpartition('/')[2]}:{one.lineno}" for one in stack[::-1]
            )
            self.longest = gap, where


@contextmanager
def watched() -> Iterator[Looks]:
    """Watch the block: workers that ask whether to end, signals in this, the main thread."""
    looks, ask = Looks(), worker.raise_if_cancelled

    def asks() -> None:
        if threading.current_thread() is not threading.main_thread():
            looks.look()
        ask()

    modules = [
        m for m in list(sys.modules.values()) if getattr(m, "raise_if_cancelled", None) is ask
    ]
    before = signal.signal(signal.SIGALRM, lambda signum, frame: looks.look(frame))
    signal.setitimer(signal.ITIMER_REAL, OFTEN_S, OFTEN_S)
    try:
        for module in modules:
            module.raise_if_cancelled = asks
        yield looks
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        for module in modules:
            module.raise_if_cancelled = ask


LONGEST_S = 1.0  # of the thread's own processor time: a busy machine does not lengthen it
KINDS = {  # what is measured, and overrides; as many rows as make the longest phase last
    "powers": (lambda folder: powers(folder / "own.npz", 1200), ("effort=0.1",)),
    "channels": (lambda folder: channels(folder / "own.npz", 300, shape="S"), ()),
    "channels of an array": (lambda folder: channels(folder / "own.npz", 150), ()),
    "images": (lambda folder: spectra(folder / "own.npz", 100), ()),
    "static array": (static_array, ()),
    "moving array": (moving_array, ()),
    "a search": (
        lambda folder: channels(folder / "own.npz", 300, shape="S"),
        ("model=image_source_gp",),
    ),
}
EVERY = [pytest.param(kind, marks=() if kind == "powers" else pytest.mark.slow) for kind in KINDS]


@pytest.mark.slow
@pytest.mark.parametrize("kind", EVERY)
def test_an_interrupt_ends_every_phase_within_a_second(kind, tmp_path):
    """Of powers 26 s, of a wide room ten minutes went by."""
    make, overrides = KINDS[kind]
    data = make(tmp_path)
    data = data if hasattr(data, "site") else load({"name": "own", "file": str(data)})
    config = compose("dataset=own", "dataset.file=x", "logger=none", *overrides)
    method = build(config.model).create_for(data)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with watched() as looks:
            method.fit(
                data,
                split_for({"name": "random"}, data).folds[0],
                fit_context(config, run_dir=tmp_path),
            )
    finally:
        torch.set_num_threads(threads)
    assert looks.longest[0] < LONGEST_S, looks.longest
