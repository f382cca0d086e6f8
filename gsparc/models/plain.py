"""Dataclasses as plain containers, as checkpoints hold them, and back."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_type_hints

T = TypeVar("T")


def plain(part: Any) -> Any:
    """Return a dict of a dataclass by its fields' names, lists of tuples, and all else as it is.

    >>> from gsparc.training.time_budget import Spent
    >>> plain(Spent(wall=2.0))
    {'wall': 2.0, 'processor': 0.0}
    """
    if is_dataclass(part):
        return {each.name: plain(getattr(part, each.name)) for each in fields(part)}
    return [plain(each) for each in part] if isinstance(part, tuple) else part


def made(kind: type[T], stored: dict[str, Any]) -> T:
    """Return the dataclass of this kind whose `plain` was stored; lists become tuples.

    >>> from gsparc.training.time_budget import Spent
    >>> made(Spent, {"wall": 2.0, "processor": 0.5})
    Spent(wall=2.0, processor=0.5)

    Raises:
        TypeError: a field without a default is missing, or there is one that the kind does not have.
    """
    hints = get_type_hints(kind)
    return kind(**{name: _made(hints.get(name), value) for name, value in stored.items()})


def _made(hint: Any, value: Any) -> Any:
    if isinstance(hint, type) and is_dataclass(hint):
        return made(hint, value)
    return tuple(_made(None, each) for each in value) if isinstance(value, list) else value
