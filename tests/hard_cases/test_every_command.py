"""Every command on a full disk, and under Ctrl-C in every stage: one line,
and the exit status that says it.

Remedy: files appear by renaming (gsparc/base/files.py), errors pass one door
(gsparc/commands/shared/cli.py), and a thread that computes asks whether to go on
(gsparc/processes/worker.py). The disk is a limit on the size of files,
failing like a full one in the middle of writing.
"""

import re
import signal
import time
from pathlib import Path

import pytest
from crashes import Limited
from doors import Answer, knock
from pages import Tiny

from gsparc.__main__ import main

LINES = {
    "a rendered field": "train dataset=rfid model=gsparc model.effects.array=false",
    "an array's field": "train dataset=rfid model=gsparc",
    "sources": "train dataset=newrf model=gsparc init=sources",
    "powers": "train dataset=own model=gsparc",
    "stations": "train dataset=ble model=gp",
    "study": "study kind=effects dataset=newrf",
    "compare": "compare datasets.rfid.root=DIR",
    "evaluate": "evaluate ckpt=FILE",
    "predict": "predict ckpt=FILE places=FILE",
    "map": "map ckpt=FILE",
    "plan": "plan ckpt=FILE",
    "place": "place ckpt=FILE",
    "view": "view ckpt=FILE save=page.html",
    "tradeoff": "tradeoff ckpt=FILE",
    "calibrate": "calibrate ckpt=FILE",
}
# Stop where another kind does, at the same door
ALIKE = ("an array's field", "evaluate", "place", "view")
STOPPED = [pytest.param(kind, marks=pytest.mark.rare if kind in ALIKE else ()) for kind in LINES]
SIZES = (0, 300, 6_000, 60_000)  # bytes: nothing, Hydra's notes, tables, pictures and models


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return Tiny(tmp_path_factory.mktemp("commands"))


def _said(tiny: Tiny, kind: str, run: Path) -> list[str]:
    name, *given = LINES[kind].split()
    return [name, *tiny.line(name, tuple(given), run)]


def _one_line(answer: Answer) -> str:
    said = [line for line in answer.err if line.startswith("error: ")]
    assert not [line for line in [*answer.err, *answer.out] if "Traceback" in line], answer
    assert len(said) == 1 and len(said[0]) < 700, answer
    return said[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", LINES)
def test_a_full_disk_is_said_in_one_line(kind, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tiny.folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    refused = 0
    for size in SIZES:
        words = _said(tiny, kind, tmp_path / f"run{size}")
        with Limited(size or 1):
            answer = knock(main, "gsparc", words)
        if answer.status:
            refused += 1
            assert answer.status == 1
            assert re.search(r"cannot be (written|locked)|[Ff]ile too large", _one_line(answer))
        left = [path.name for path in tmp_path.rglob("*.partial")]
        assert not left, left
    assert refused


@pytest.mark.slow
@pytest.mark.parametrize("kind", STOPPED)
def test_ctrl_c_ends_every_stage_in_one_line(kind, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tiny.folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    began = time.monotonic()
    assert knock(main, "gsparc", _said(tiny, kind, tmp_path / "whole")).status == 0
    whole, stopped = time.monotonic() - began, 0
    before = signal.signal(signal.SIGALRM, lambda *unused: signal.raise_signal(signal.SIGINT))
    # In the background it is ignored
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for part in range(18):
            if part % 6 == 0 and stopped:
                break
            words = _said(tiny, kind, tmp_path / f"run{part}")
            # The first run imports, on a machine that may have been busier:
            # later ones can be over sooner.
            signal.setitimer(signal.ITIMER_REAL, whole * (part % 6 + 1) / 7 / 5 ** (part // 6))
            answer = knock(main, "gsparc", words)
            signal.setitimer(signal.ITIMER_REAL, 0)
            if answer.status:
                stopped += 1
                assert answer.status == 130, answer
                _one_line(answer)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        signal.signal(signal.SIGINT, ignored)
    assert stopped
