"""Which options a run heeds: classes of settings note what is read of them while a method fits and predicts.

What is read where nothing follows from it does not count: checks of values, copies, stored states. What only
a part reads counts when the part has weight (`set_apart`, `count`).
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from gsparc.data import limits

# Functions from whose reads nothing follows, and files of copies and checks.
UNUSED = ("__post_init__", "__repr__", "state", "made", "label", "facts")
COPIES = (dataclasses.__file__, limits.__file__)


@dataclass(frozen=True)
class Option:
    """A setting whose reads are noted.

    Attributes:
        path: dotted name in the configuration.
        value: as configured; another one that is read was put in its place.
        kind, attribute: where it is held.
    """

    path: str
    value: Any
    kind: type
    attribute: str


@dataclass
class Reads:
    """What is noted.

    Attributes:
        options: whose reads are.
        noted: paths that were read; a group stands for what of it is not in `options`, `*` for everything.
    """

    options: Sequence[Option]
    noted: set[str] = field(default_factory=set)

    def heeds(self, path: str) -> bool:
        """Tell whether a setting, or a group that was chosen, was read."""
        within = path not in {option.path for option in self.options}
        groups = [path.rsplit(".", count)[0] for count in range(1, path.count(".") + 1)] if within else []
        return not self.noted.isdisjoint({"*", path, *groups})


_reads: Reads | None = None


@contextmanager
def record_reads(reads: Reads) -> Iterator[None]:
    """Note in `reads` what is read meanwhile, here and in processes that `executor.run_each` starts."""
    global _reads
    before, _reads = _reads, reads
    classes: Any = {option.kind for option in reads.options}
    for owner in classes:
        owner.__getattribute__ = _noting(owner, [one for one in reads.options if one.kind is owner])
    try:
        yield
    finally:
        _reads = before
        for owner in classes:
            del owner.__getattribute__


def _noting(kind: type, options: Sequence[Option]) -> Callable[[Any, str], Any]:
    get: Any = kind.__getattribute__
    names = {option.attribute for option in options}

    def noted(self: Any, name: str) -> Any:
        value = get(self, name)
        if name in names and _reads is not None:
            code = sys._getframe(1).f_code  # of who reads
            if code.co_filename not in COPIES and code.co_name not in UNUSED:
                _reads.noted.update(o.path for o in options if o.attribute == name and _same(value, o.value))
        return value

    return noted


def _same(value: Any, configured: Any) -> bool:
    return value == configured if isinstance(value, bool | int | float | str | None) else value is not None


@contextmanager
def set_apart() -> Iterator[set[str]]:
    """Note what is read within in a set of its own, which counts when it is given to `count`."""
    reads = _reads or Reads(())
    outer, reads.noted = reads.noted, set()
    try:
        yield reads.noted
    finally:
        reads.noted = outer


def count_reads(*paths: str) -> None:
    """Count these as heeded, as in `Reads.noted`."""
    if _reads is not None:
        _reads.noted.update(paths)


def return_with_reads(work: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, set[str]]]:
    """Return work for other processes, with what is read there; see `take_result`."""
    options = () if _reads is None else _reads.options

    def there(piece: Any) -> tuple[Any, set[str]]:
        with record_reads(reads := Reads(options)):
            return work(piece), reads.noted

    return there


def take_result(result: tuple[Any, set[str]]) -> Any:
    """Return the result of work that was `return_with_reads`."""
    count_reads(*result[1])
    return result[0]
