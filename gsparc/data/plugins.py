"""Methods and datasets of other packages, found by their entry points; see docs/own-method.md."""

from __future__ import annotations

import inspect
from importlib.metadata import entry_points
from typing import Any

GROUPS = {"model": "gsparc.models", "dataset": "gsparc.datasets"}
PLAIN = (bool, int, float, str, list, dict, type(None))


def plugins(group: str) -> dict[str, str]:
    """Import path `module.Class` of every plugin for a config group (`model` or `dataset`), by its name."""
    return {point.name: f"{point.module}.{point.attr}" for point in entry_points(group=GROUPS[group])}


def settings_of(kind: type) -> dict[str, Any]:
    """What `kind.__init__` takes, with its defaults; `???` where there is none, classes left out."""
    taken = inspect.signature(kind).parameters.values()
    named = [p for p in taken if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    found = {p.name: "???" if p.default is p.empty else p.default for p in named}
    return {
        name: list(v) if isinstance(v, tuple) else v
        for name, v in found.items()
        if isinstance(v, (*PLAIN, tuple))
    }
