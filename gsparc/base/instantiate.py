"""Classes named in configurations: the nearest right name, and what text out of files may name."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, TypeVar

from hydra.errors import InstantiationException

from gsparc.base.errors import DataError, suggest_name
from gsparc.base.limits import SettingError

_Kind = TypeVar("_Kind")


def suggest_or_list(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean 'gp'?`, or what there is when nothing is close."""
    known = list(known)
    return suggest_name(name, known) or f"; there are {', '.join(sorted(known))}"


def from_settings(
    kind: type[_Kind], config: Mapping[str, Any], group: str, noun: str = "setting"
) -> _Kind:
    """Build the dataclass `kind` with the values of a config group.

    Raises:
        DataError: a key that is no field (a `noun`), or, a `SettingError`, a value that cannot be.
    """
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    for key in config:
        if key not in names:
            raise DataError(f"{group}.{key}: no such {noun}; there are {', '.join(sorted(names))}")
    try:
        return kind(**config)
    except SettingError as error:
        raise SettingError(f"{group}.{error}") from None


def cause_of(error: InstantiationException) -> BaseException:
    """Return what an instantiation failed by, a bad setting under its full key."""
    cause, key = error.__cause__ or error, re.search(r"full_key: (\S+)", str(error))
    return SettingError(f"{key[1]}.{cause}") if isinstance(cause, SettingError) and key else cause


def iterate_targets(node: Any) -> Iterator[Any]:
    """Yield every `_target_` in a config (plain containers), at any depth."""
    if isinstance(node, dict) and "_target_" in node:
        yield node["_target_"]
    for value in (
        node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    ):
        yield from iterate_targets(value)


def import_target(path: str) -> Any:
    """Return what an import path names; None when there is no such thing."""
    module, _, attribute = path.rpartition(".")
    try:
        return getattr(import_module(module), attribute, None) if module else None
    except ImportError:
        return None


def refuse_foreign(path: Any) -> None:
    """Refuse a `_target_` that is not a class of gsparc or of an installed plugin,
    for text out of a file.

    `gsparc.x.os.system` starts with gsparc too: what counts is where the class was defined.

    Raises:
        ValueError: it is none.
    """
    ours = isinstance(path, str) and path.startswith("gsparc.")
    target = import_target(path) if ours else None
    if isinstance(target, type) and target.__module__.startswith("gsparc."):
        return  # before plugins are looked for: that reads the notes of all installed packages
    if not any(path in plugins(group).values() for group in OF_FILES):
        instead = "refused; where it is a plugin's, install that package here"
        raise ValueError(
            f"the file asks to run {path!r}, which is not a class of gsparc; {instead}"
        )


GROUPS = {"model": "gsparc.models", "dataset": "gsparc.datasets"}
OF_FILES = {**GROUPS, "terms": "gsparc.terms"}  # whose classes a stored configuration may name
PLAIN = (bool, int, float, str, list, dict, type(None))


def plugins(group: str) -> dict[str, str]:
    """Return the import path `module.Class` of every plugin: of `model`, `dataset` or `terms`."""
    return {
        point.name: f"{point.module}.{point.attr}" for point in entry_points(group=OF_FILES[group])
    }


def plugin_node(group: str, name: str) -> dict[str, Any]:
    """Return `config_node` of the class of a plugin.

    Raises:
        DataError: it cannot be imported; the message is what went wrong in it, on one line.
    """
    points = {point.name: point for point in entry_points(group=OF_FILES[group])}
    try:
        return config_node(points[name].load())
    except Exception as error:  # whatever another package does when it is imported
        reason = (str(error).strip() or "without a word").splitlines()[0]
        raise DataError(f"{type(error).__name__}: {reason}") from error


def config_node(kind: type) -> dict[str, Any]:
    """Return the configuration that builds a class: what it takes with defaults; `???` without one.

    Dataclasses of settings are nodes of their own.
    Left out are defaults that no configuration can hold.
    """
    plain = {name: _plain(default) for name, default in accepted_arguments(kind).items()}
    defaults = {name: default for name, default in plain.items() if default is not _OTHER}
    return {"_target_": f"{kind.__module__}.{kind.__qualname__}", **defaults}


_OTHER = object()


def accepted_arguments(kind: Any) -> dict[str, Any]:
    """Return what a class or function takes, with defaults; of a class `**names` is what its base
    class, or `hands_on`, takes.
    """
    if kind is object:
        return {}
    of_class = isinstance(kind, type)
    args, base = (
        [*inspect.signature(kind.__init__ if of_class else kind).parameters.values()][of_class:],
        {},
    )
    if of_class and any(p.kind is p.VAR_KEYWORD for p in args):
        base = accepted_arguments(vars(kind).get("hands_on", kind.__mro__[1]))
    named = {p.name: p.default for p in args if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    return {**named, **{name: default for name, default in base.items() if name not in named}}


def _plain(value: Any) -> Any:
    if value is inspect.Parameter.empty:
        return "???"
    if is_dataclass(value) and not isinstance(value, type):
        names = [f.name for f in fields(value) if not f.metadata.get("internal")]
        path = f"{type(value).__module__}.{type(value).__qualname__}"
        return {"_target_": path, **{name: _plain(getattr(value, name)) for name in names}}
    value = list(value) if isinstance(value, tuple) else value
    return value if isinstance(value, PLAIN) else _OTHER
