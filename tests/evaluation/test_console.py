"""Errors in one line."""

from __future__ import annotations

import pytest

from gsparc.evaluation.console import one_line


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (KeyError("x"), "KeyError: 'x' (HYDRA_FULL_ERROR=1 shows where)"),  # a bug is named by its type
        (ValueError("first line\nsecond"), "first line"),
        (ValueError(), "ValueError:  (HYDRA_FULL_ERROR=1 shows where)"),
        # It was `[Errno 2] No such file or directory: '/proc/x'`.
        (FileNotFoundError(2, "No such file or directory", "/proc/x"), "/proc/x: No such file or directory"),
    ],
)
def test_an_error_is_one_line(error, line):
    assert one_line(error) == line
