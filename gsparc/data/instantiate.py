"""Classes named in configurations: the nearest right name, and what text out of files may name."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, TypeVar

from gsparc.data.errors import DataError, nearest
from gsparc.data.limits import SettingError

_Kind = TypeVar("_Kind")


def suggest(name: str, known: Iterable[str]) -> str:
    """`; did you mean 'gp'?`, or what there is when nothing is close."""
    known = list(known)
    return nearest(name, known) or f"; there are {', '.join(sorted(known))}"


def from_settings(kind: type[_Kind], config: Mapping[str, Any], group: str, noun: str = "setting") -> _Kind:
    """The dataclass `kind` with the values of a config group.

    Raises:
        DataError: a key that is no field (a `noun`), or, a `SettingError`, a value that cannot be.
    """
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    for key in config:
        if key not in known:
            raise DataError(f"{group}.{key}: no such {noun}; there are {', '.join(sorted(known))}")
    try:
        return kind(**config)
    except SettingError as error:
        raise SettingError(f"{group}.{error}") from None


def targets(node: Any) -> Iterator[Any]:
    """Every `_target_` in a config (plain containers), at any depth."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "_target_":
                yield value
            else:
                yield from targets(value)
    elif isinstance(node, list):
        for value in node:
            yield from targets(value)


def find(path: str) -> Any:
    """What an import path names; None when there is no such thing."""
    module, _, attribute = path.rpartition(".")
    try:
        return getattr(import_module(module), attribute, None) if module else None
    except ImportError:
        return None


def refuse_foreign(path: Any) -> None:
    """Refuse a `_target_` that is not a class of gsparc or of an installed plugin, for text out of a file.

    `gsparc.x.os.system` starts with gsparc too: what counts is where the class was defined.

    Raises:
        ValueError: it is none.
    """
    ours = isinstance(path, str) and path.startswith("gsparc.")
    target = find(path) if ours else None
    if isinstance(target, type) and target.__module__.startswith("gsparc."):
        return  # before plugins are looked for: that reads the notes of all installed packages
    if not any(path in plugins(group).values() for group in GROUPS):
        raise ValueError(f"the file asks to run {path!r}, which is not a class of gsparc; refused")


GROUPS = {"model": "gsparc.models", "dataset": "gsparc.datasets"}
PLAIN = (bool, int, float, str, list, dict, type(None))


def plugins(group: str) -> dict[str, str]:
    """Import path `module.Class` of every plugin for a config group (`model` or `dataset`), by its name."""
    return {point.name: f"{point.module}.{point.attr}" for point in entry_points(group=GROUPS[group])}


def settings_of(kind: type) -> dict[str, Any]:
    """What `kind.__init__` takes, with its defaults; `???` where there is none, classes left out."""
    parameters = inspect.signature(kind).parameters.values()
    named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    settings = {p.name: "???" if p.default is p.empty else p.default for p in named}
    return {
        name: list(v) if isinstance(v, tuple) else v
        for name, v in settings.items()
        if isinstance(v, (*PLAIN, tuple))
    }
