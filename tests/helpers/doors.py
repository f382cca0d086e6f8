"""Knocking at a command's door with bad input: what it says, how it ends, what it leaves behind."""

import contextlib
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

WHOLE = re.compile(
    r"\.hydra(/.*)?|(\.job/)?\.run\.lock|\.job|[\w.]+\.log|split\.json|job\.json"
)  # notes of a run before it computes anything


@dataclass(frozen=True)
class Answer:
    """Exit status, and what was said on stdout and stderr, line by line."""

    status: int
    out: list[str]
    err: list[str]


def knock(entry: Callable[[], object], name: str, arguments: Sequence[str]) -> Answer:
    """Call a command's `main` with a command line, in this process."""
    out, err = io.StringIO(), io.StringIO()
    status: object = 0
    with (
        mock.patch("sys.argv", [name, *arguments]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            status = entry()
        except SystemExit as ended:
            status = ended.code
    lines = [[line for line in text.getvalue().splitlines() if line.strip()] for text in (out, err)]
    return Answer(int(status) if isinstance(status, int) else 0, *lines)


def assert_refused(answer: Answer, says: str, folder: Path | None = None) -> None:
    """Status 1, one clear line, and nothing half-written in the run's folder."""
    said = [line for line in answer.err if not line.startswith("[")]  # not Hydra's log
    assert answer.status == 1, answer
    assert len(said) == 1 and said[0].startswith("error: ") and len(said[0]) < 700, said
    assert "Traceback" not in said[0] and "HYDRA_FULL_ERROR" not in said[0], said[0]
    assert re.search(says, said[0]), said[0]
    if folder is not None and folder.exists():
        left = {str(path.relative_to(folder)) for path in folder.rglob("*")}
        assert all(WHOLE.fullmatch(name) for name in left), left


def assert_found_bad(answer: Answer, says: str) -> None:
    """`gsparc check`: status 1, one line a problem, one of which says it."""
    assert answer.status == 1 and not answer.err, answer
    assert re.search(says, "\n".join(answer.out)), answer.out
    assert all(len(line) < 700 and "Traceback" not in line for line in answer.out), answer.out
    assert re.search(r": refused, \d+ problems?$", answer.out[-1]), answer.out


def said(path: Path, **settings: object) -> str:
    """What `gsparc check` says of a file."""
    from rich.console import Console

    from gsparc.commands.check import check

    check(str(path), Console(file=(out := io.StringIO()), width=2000), **settings)
    return out.getvalue()
