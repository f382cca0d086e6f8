"""Commands in a notebook: `%load_ext gsparc`, then `%gsparc train ...`, or a cell of settings."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from typing import Any

WIDE = "110"  # columns of a table that fit a notebook


def run(line: str, cell: str = "") -> None:
    """Run `gsparc LINE CELL` with this interpreter and show what it says.

    Raises:
        RuntimeError: the command failed; its last line says why.
    """
    words = [*shlex.split(line), *shlex.split(cell, comments=True)]
    plain = {k: v for k, v in os.environ.items() if k not in ("FORCE_COLOR", "CLICOLOR_FORCE")}
    command = subprocess.Popen(
        [sys.executable, "-m", "gsparc", *words],
        env={**plain, "COLUMNS": WIDE, "PYTHONIOENCODING": "utf-8"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8",
    )  # fmt: skip
    assert command.stdout is not None
    last = ""
    try:
        for text in command.stdout:
            last = text.strip() or last
            sys.stdout.write(text)
    finally:
        if command.poll() is None and sys.exc_info()[0] is not None:  # the cell was interrupted
            command.terminate()
    if command.wait():
        raise RuntimeError(last)


def load_ipython_extension(shell: Any) -> None:
    """Add the magic `gsparc` to a line and to a cell."""
    shell.register_magic_function(run, "line_cell", "gsparc")
