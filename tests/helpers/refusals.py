"""How bad input is refused: one short line a problem."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest


def refused_as(
    error: type[ValueError], says: str, call: Callable[..., Any], *given: Any, **more: Any
) -> Any:
    """The error of `call(...)`: one short line a problem, in which stands what a pattern says."""
    with pytest.raises(error) as caught:
        call(*given, **more)
    problems = getattr(caught.value, "problems", [str(caught.value)])
    assert all(
        "\n" not in line and "Traceback" not in line and len(line) < 700 for line in problems
    )
    found = [
        line for line in [*problems, str(caught.value)] if says in line or re.search(says, line)
    ]
    assert found, problems
    return caught.value


refused = partial(refused_as, ValueError)
