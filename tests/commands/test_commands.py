"""`gsparc COMMAND key=value ...`: the list, a typo, the help of every command, an interrupt."""

import contextlib
import logging
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest
from campaigns import compose
from doors import Answer, knock

from gsparc.__main__ import READER_LEFT, main
from gsparc.commands.listing import COMMANDS
from gsparc.commands.shared.cli import _began_as_interrupt


def gsparc(*words: str) -> Answer:
    return knock(main, "gsparc", words)


def test_without_a_command_all_are_listed():
    done = gsparc()
    assert done.status == 0
    assert [line.split()[0] for line in done.out if line.startswith("  ")] == list(COMMANDS)


@pytest.mark.parametrize(
    "words", [("--version",), ("train", "--help"), ("study", "-h"), ("check", "--help")]
)
def test_help_waited_seconds_for_torch(words):
    """`gsparc train --help` took up to 13 s on a busy machine;
    `gsparc --version` was no command.
    """
    code = (
        "import atexit, sys; atexit.register(lambda: print('torch' in sys.modules, "
        "file=sys.stderr));"
    )
    code += "from gsparc.__main__ import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "False\n")
    said = {
        "--version": r"^gsparc \d+\.\d+",
        "train": r"model=.*\|gsparc\|",
        "study": r"kind=effects\|",
    }
    assert re.search(said.get(words[0], "usage: gsparc check"), done.stdout)


@pytest.mark.slow
def test_composing_waited_seconds_for_torch():
    """The classes of all methods, or of the one chosen, were imported for their settings."""
    code = """
import sys
from hydra import compose, initialize_config_module
from gsparc.commands.listing import COMMANDS
from gsparc.commands.shared import cli
names = [command.name for command in COMMANDS.values() if command.configured]
with initialize_config_module("gsparc.conf", version_base="1.3"):
    for name in names:
        cli.help_text("", name), compose(name)
    compose("train", ["model=splat", "model.field.count=3", "paper=gsrf"])
sys.exit("torch" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_a_typo_gets_the_nearest_command():
    line = "error: no command is called 'tardeoff'; did you mean 'tradeoff'?"
    assert gsparc("tardeoff", "ckpt=x") == Answer(1, [], [line])


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_what_a_command_does_and_what_its_settings_mean(command):
    answer = gsparc(command, "--help")
    text = "\n".join(answer.out)
    assert answer.status == 0 and f"gsparc {command}" in text
    if COMMANDS[command].configured:
        assert "hydra.run.dir" not in text and "  # " in text
    kinds = {"positions": "directions_deg", "measurements": "shares of the training rows"}
    for kind, setting in kinds.items() if command == "study" else ():
        assert any(setting in line for line in gsparc("study", f"kind={kind}", "-h").out)


@pytest.mark.parametrize("words", [[], pytest.param(["train"], marks=pytest.mark.slow)])
def test_a_reader_that_leaves_early_is_no_error(words):
    """`gsparc train --help | head -1` once ended in a traceback."""
    command = [sys.executable, "-m", "gsparc", *words, "--help"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        running.stdout.close()
        err = running.stderr.read()
    assert (err, running.returncode) == ("", READER_LEFT)


def test_files_need_no_name_where_a_command_is_about_files(tmp_path):
    given = ["a b", "c", "title=x", "-m"]
    assert COMMANDS["report"].arguments(given) == ["title=x", "-m", "runs=['a b','c']"]
    assert compose(*COMMANDS["report"].arguments(["it's, here"]), config="report").runs == [
        "it's, here"
    ]
    assert COMMANDS["evaluate"].arguments(["a b"]) == ["a b"]
    answer = gsparc("check", str(tmp_path / "absent.npz"))
    assert answer.status == 1 and "no such file" in answer.out[0]


def while_a_library_cleans_up(config):
    """An interrupt inside OmegaConf left a list half changed:
    its clean-up's error hid the interrupt.
    """
    try:
        raise KeyboardInterrupt
    finally:
        config.dataset.there_is_no_such_key.at_all  # noqa: B018


def in_compiled_code(config):
    """Of matplotlib came "Invalid bounding box", with nothing left of the interrupt."""
    with contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    raise ValueError("Invalid bounding box")


def while_it_logs(config):
    """The lock of `logging` stayed taken for good: every other thread that logged, as a server's,
    hung.
    """
    lock = logging._lock

    class Interrupted:
        def acquire(self):
            lock.acquire()
            logging._lock = lock
            signal.raise_signal(signal.SIGINT)

    logging._lock = Interrupted()
    logging.getLogger("gsparc.never.asked").isEnabledFor(logging.INFO)
    time.sleep(60)


def while_a_log_waits_for_its_reader(config):
    class Waiting(logging.Handler):
        def emit(self, record):
            signal.raise_signal(signal.SIGINT)
            time.sleep(60)

    waiting, log = Waiting(), logging.getLogger("gsparc")
    log.addHandler(waiting)
    try:
        log.warning("to a pipe that nobody reads")
    finally:
        log.removeHandler(waiting)


def with_advice(config):
    raise KeyboardInterrupt("go on with ckpt_path=last.ckpt")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "line"),
    [
        (while_a_library_cleans_up, "error: interrupted"),
        (in_compiled_code, "error: interrupted: Invalid bounding box"),
        (while_it_logs, "error: interrupted"),
        (while_a_log_waits_for_its_reader, "error: interrupted"),
        (with_advice, "error: go on with ckpt_path=last.ckpt"),
    ],
)
def test_ctrl_c_while_a_command_runs_is_said_with_status_130(task, line, monkeypatch, tmp_path):
    monkeypatch.setattr("gsparc.commands.train.task", task)
    before = signal.getsignal(signal.SIGINT)
    answer = gsparc("train", "dataset=rfid", "model=gsparc", f"hydra.run.dir={tmp_path}")
    assert answer.status == 130 and answer.err[-1] == line
    assert signal.getsignal(signal.SIGINT) is before
    with ThreadPoolExecutor() as other:
        other.submit(logging.getLogger("gsparc.never.asked.either").isEnabledFor, 20).result(
            timeout=5
        )


def test_ctrl_c_in_a_multirun_was_told_to_go_on_with_one_of_its_jobs(monkeypatch, tmp_path):
    monkeypatch.setattr("gsparc.commands.train.task", with_advice)
    words = "-m", "dataset=rfid", "model=gsparc", "seed=0,1", f"hydra.sweep.dir={tmp_path}"
    answer = gsparc("train", *words)
    kept = "error: interrupted; finished jobs are kept: the same command goes on; "
    kept += "unfinished ones resume from last.ckpt, or start again"
    assert (answer.status, answer.err[-1]) == (130, kept)


def test_ctrl_c_while_plugins_are_looked_for_was_a_traceback(monkeypatch):
    monkeypatch.setattr(
        "gsparc.commands.shared.cli.offer_plugins", Mock(side_effect=KeyboardInterrupt)
    )
    answer = gsparc("train", "dataset=rfid", "model=gsparc")
    assert (answer.status, answer.err) == (130, ["error: interrupted"])


def test_an_error_that_is_its_own_context_was_followed_without_end():
    """`raise error.__cause__` within its handler makes such a circle; a command then hung."""
    first, second = ValueError("batch_size"), RuntimeError("of a library")
    first.__context__, second.__cause__ = second, first
    assert not _began_as_interrupt(second)
    second.__cause__ = KeyboardInterrupt()
    assert _began_as_interrupt(first)
