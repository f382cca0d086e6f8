"""Which settings a run heeds: classes of settings note what is read of them while a method fits and predicts.

What is read where nothing follows from it does not count: checks of values, copies, stored states. What only
a part reads counts when the part has weight (`apart`, `count`); what decides between parts, when another
value would have decided otherwise (`compare`).
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from gsparc.data import limits

# Functions from whose reads nothing follows.
UNUSED = ("__post_init__", "__repr__", "state", "made", "label", "facts")
COPIES = (dataclasses.__file__, limits.__file__)


@dataclass(frozen=True)
class Option:
    """A setting whose reads are noted.

    Attributes:
        path: dotted name in the configuration.
        value: as configured; another one that is read was put in its place.
        default: of its class.
    """

    path: str
    value: Any
    default: Any


@dataclass
class Reads:
    """What is noted.

    Attributes:
        options: by class and attribute.
        variant: makes the method with another value of an option, by its path.
        noted: paths that were read; `group.*` for all in a group, `group` for what of it is not in `options`.
    """

    options: dict[type, dict[str, list[Option]]]
    variant: Callable[[str, Any], Any]
    noted: set[str] = field(default_factory=set)

    def heeds(self, path: str) -> bool:
        """Whether a setting, or a group that was chosen, was read."""
        above = [path.rsplit(".", count)[0] for count in range(1, path.count(".") + 1)]
        watched = any(o.path == path for own in self.options.values() for each in own.values() for o in each)
        every = any(f"{name}.*" in self.noted for name in (path, *above)) or "*" in self.noted
        return every or path in self.noted or (not watched and any(name in self.noted for name in above))


_reads: Reads | None = None


@contextmanager
def recording(reads: Reads) -> Iterator[None]:
    """Note in `reads` what is read meanwhile, in this process and in those that `executor.each` starts."""
    global _reads
    before, _reads = _reads, reads
    for kind, own in reads.options.items():
        kind.__getattribute__ = _noting(kind.__getattribute__, own)  # type: ignore[method-assign]
    try:
        yield
    finally:
        _reads = before
        for kind in reads.options:
            del kind.__getattribute__


def _noting(get: Callable[[Any, str], Any], own: Mapping[str, list[Option]]) -> Callable[[Any, str], Any]:
    def noted(self: Any, name: str) -> Any:
        value = get(self, name)
        if name in own and _reads is not None:
            code = sys._getframe(1).f_code  # of who reads
            if code.co_filename not in COPIES and code.co_name not in UNUSED:
                _reads.noted.update(o.path for o in own[name] if _same(value, o.value))
        return value

    return noted


def _same(value: Any, configured: Any) -> bool:
    plain = isinstance(value, bool | int | float | str | None)
    return bool(value == configured) if plain else value is not None


@contextmanager
def apart() -> Iterator[set[str]]:
    """Note what is read within in a set of its own, which counts when it is given to `count`."""
    if _reads is None:
        yield set()
        return
    outer, _reads.noted = _reads.noted, set()
    try:
        yield _reads.noted
    finally:
        _reads.noted = outer


def count(*paths: str) -> None:
    """These were heeded: paths, `group.*`, or `group` for settings of no class that notes its reads."""
    if _reads is not None:
        _reads.noted.update(paths)


def compare(asked: set[str], decide: Callable[[Any], str]) -> None:
    """Count those of the paths `asked` with which `decide`, told the method, says something else."""
    if _reads is None:
        return
    reads, every = _reads, [o for own in _reads.options.values() for each in own.values() for o in each]
    for option in (one for one in every if one.path in asked):
        switch = (True, False) if isinstance(option.value, bool) else ()
        others = {option.default, *switch} - {option.value}
        with apart():
            said = [_said(decide, reads, option.path, other) for other in (option.value, *others)]
        named = isinstance(option.value, str) and repr(option.value) in said[0]
        if named or not others or len({one for one in said if one}) > 1:
            count(option.path)


def _said(decide: Callable[[Any], str], reads: Reads, path: str, value: Any) -> str:
    """What is decided; "" where this value is refused."""
    try:
        return decide(reads.variant(path, value))
    except ValueError:
        return ""


def carried(work: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Work for other processes that brings along what is read there; see `brought`."""
    reads = _reads
    if reads is None:
        return work

    def there(piece: Any) -> tuple[Any, set[str]]:
        own = dataclasses.replace(reads, noted=set())
        with recording(own):
            return work(piece), own.noted

    return there


def brought(result: Any) -> Any:
    """The result of work that was `carried`."""
    if _reads is None:
        return result
    value, noted = result
    count(*noted)
    return value
