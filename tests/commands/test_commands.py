"""`gsparc COMMAND key=value ...`: the list, a typo, the help of every command."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys

import pytest

from gsparc.__main__ import READER_LEFT, main
from gsparc.commands.cli import _began_as_interrupt
from gsparc.commands.listing import COMMANDS


def gsparc(monkeypatch, capsys, *words: str) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a command line, in this process."""
    monkeypatch.setattr(sys, "argv", ["gsparc", *words])
    status = 0
    try:
        main()
    except SystemExit as ended:
        status = int(ended.code or 0)
    said = capsys.readouterr()
    return status, said.out, said.err


def test_without_a_command_all_are_listed_at_once():
    code = "import sys; from gsparc.__main__ import main; main(); sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0
    listed = [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ")]
    assert listed == list(COMMANDS)


def test_a_typo_gets_the_nearest_command(monkeypatch, capsys):
    status, out, err = gsparc(monkeypatch, capsys, "tardeoff", "ckpt=x")
    assert (status, out, err) == (1, "", "error: no command is called 'tardeoff'; did you mean 'tradeoff'?\n")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_what_a_command_does_and_what_its_settings_mean(command, monkeypatch, capsys):
    status, out, _ = gsparc(monkeypatch, capsys, command, "--help")
    assert status == 0 and f"gsparc {command}" in out
    if COMMANDS[command].configured:
        assert "hydra.run.dir" not in out.partition("powered by Hydra")[0] and "  # " in out


@pytest.mark.parametrize("words", [[], pytest.param(["train"], marks=pytest.mark.slow)])
def test_a_reader_that_leaves_early_is_no_error(words):
    """`gsparc train --help | head -1` once ended in a traceback."""
    command = [sys.executable, "-m", "gsparc", *words, "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        running.stdout.close()
        said = running.stderr.read()
    assert (said, running.returncode) == ("", READER_LEFT)


def test_help_of_a_kind_of_study_has_its_settings(monkeypatch, capsys):
    assert "errors_deg" in gsparc(monkeypatch, capsys, "study", "kind=positions", "--help")[1]
    assert "shares of the training rows" in gsparc(monkeypatch, capsys, "study", "kind=measurements", "-h")[1]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["study", "kind=efects"], "error: kind=efects: no such choice; did you mean 'effects'?"),
        (["report"], "error: runs is not set; give runs=..."),
        (
            ["study", "baselines=[gpp]"],
            "error: baselines=['gpp']: a list of methods is needed, 'gpp' is none",
        ),
        (["study", "model.field.count=-1"], "error: model.field.count=-1: a whole number of at least 0"),
    ],
)
def test_an_error_is_one_line(words, says, monkeypatch, capsys, tmp_path):
    status, _, err = gsparc(monkeypatch, capsys, *words, f"hydra.run.dir={tmp_path}")
    assert status == 1 and err.startswith(says) and err.count("\n") == 1


def test_files_need_no_name_where_a_command_is_about_files(monkeypatch, capsys, tmp_path):
    assert COMMANDS["report"].arguments(["a b", "c", "title=x", "-m"]) == [
        "title=x",
        "-m",
        "runs=['a b','c']",
    ]
    assert COMMANDS["evaluate"].arguments(["a b"]) == ["a b"]
    status, out, _ = gsparc(monkeypatch, capsys, "check", str(tmp_path / "absent.npz"))
    assert status == 1 and "no such file" in out


def test_ctrl_c_while_a_library_cleans_up_was_its_error_and_status_1(monkeypatch, capsys, tmp_path):
    """An interrupt inside OmegaConf left a list half changed: its clean-up's error hid the interrupt."""

    def task(config):
        try:
            raise KeyboardInterrupt
        finally:
            config.dataset.there_is_no_such_key.at_all  # noqa: B018

    monkeypatch.setattr("gsparc.commands.train.task", task)
    words = ("train", "dataset=rfid", "model=gsparc", f"hydra.run.dir={tmp_path}")
    status, _, err = gsparc(monkeypatch, capsys, *words)
    assert status == 130 and err.splitlines()[-1] == "error: interrupted"


def test_ctrl_c_in_compiled_code_came_out_as_an_error_of_its_own(monkeypatch, capsys, tmp_path):
    """Of matplotlib: "Invalid bounding box", with nothing left of the interrupt."""

    def task(config):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ValueError("Invalid bounding box")

    monkeypatch.setattr("gsparc.commands.train.task", task)
    words = ("train", "dataset=rfid", "model=gsparc", f"hydra.run.dir={tmp_path}")
    before = signal.getsignal(signal.SIGINT)
    status, _, err = gsparc(monkeypatch, capsys, *words)
    assert status == 130 and err.splitlines()[-1] == "error: interrupted: Invalid bounding box"
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_while_plugins_are_looked_for_was_a_traceback(monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr("gsparc.commands.cli.offer", interrupted)
    status, _, err = gsparc(monkeypatch, capsys, "train", "dataset=rfid", "model=gsparc")
    assert (status, err) == (130, "error: interrupted\n")


def test_an_error_that_is_its_own_context_was_followed_without_end():
    """`raise error.__cause__` within its handler makes such a circle; a command then hung."""
    first, second = ValueError("batch_size"), RuntimeError("of a library")
    first.__context__, second.__cause__ = second, first
    assert not _began_as_interrupt(second)
    second.__cause__ = KeyboardInterrupt()
    assert _began_as_interrupt(first)
