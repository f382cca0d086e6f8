"""Classes named in configurations: the nearest right name, and what text out of files may name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from importlib import import_module
from typing import Any

from gsparc.data.errors import DataError
from gsparc.data.plugins import GROUPS, plugins


def suggest(name: str, known: Iterable[str]) -> str:
    """`; did you mean 'gp'?`, or what there is when nothing is close."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; there are {', '.join(sorted(known))}"


def known_keys(config: Mapping[str, Any], kind: type, group: str, noun: str) -> Mapping[str, Any]:
    """`config` when all its keys are fields of the dataclass `kind`; else a `DataError` names one `noun`."""
    known = {field.name for field in fields(kind)}
    for key in config:
        if key not in known:
            raise DataError(f"{group}.{key}: no such {noun}; there are {', '.join(sorted(known))}")
    return config


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
    found = find(path) if ours else None
    if isinstance(found, type) and found.__module__.startswith("gsparc."):
        return  # before plugins, whose entry points take milliseconds to read
    if not any(path in plugins(group).values() for group in GROUPS):
        raise ValueError(f"the file asks to run {path!r}, which is not a class of gsparc; refused")
