"""Errors of input: where, what was found, what was expected."""

from __future__ import annotations

import difflib
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

_Found = TypeVar("_Found")

MOST = 300  # characters of a message: what was found may be a whole file in one line


def shorten(text: str) -> str:
    """Return a text without its middle when it is long."""
    return text if len(text) <= MOST else f"{text[: MOST // 2]} ... {text[-MOST // 3 :]}"


def list_first(names: Sequence[Any], count: int = 5) -> str:
    """Return the first of several names, and how many more there are."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(map(str, names[:count])) + more


MOST_OF_A_KIND = 3
# What differs between warnings of a kind: quotes, names of stations and rows, paths, numbers.
NAMES = r"'[^']*'|\b(?:stations?|line|row) [^:, ]+(?:, )?|\S*[/\d]\S*|[^a-z ]"


def warning_kind(warning: str) -> str:
    """Return what warnings of one kind share: their first words, without names and numbers."""
    return " ".join(re.sub(NAMES, " ", warning).split())[:30]


def group_warnings(warnings: Sequence[str]) -> list[str]:
    """Return warnings, more than a few of one kind counted as one."""
    kinds: dict[str, list[str]] = defaultdict(list)
    for text in warnings:
        kinds[warning_kind(text)].append(text)
    gathered: list[str] = []
    for texts in kinds.values():
        more = f"{texts[0]} (and {len(texts) - 1} more warnings of this kind)"
        gathered += texts if len(texts) <= MOST_OF_A_KIND else [more]
    return gathered


def name_row_ranges(rows: Sequence[str], count: int = 5) -> str:
    """Name rows (`line 2`, `row 7`), neighbours as `lines 2 to 20`, in at most `count` pieces."""
    numbers = [int(last) if (last := name.rpartition(" ")[2]).isdigit() else -9 for name in rows]
    starts = [
        i for i in range(len(rows)) if i == 0 or numbers[i] != numbers[i - 1] + 1 or numbers[i] < 0
    ]
    pieces = []
    for first, after in zip(starts, [*starts[1:], len(rows)], strict=True):
        noun, number = rows[first].rpartition(" ")[::2]
        alone = after - first == 1
        pieces.append(
            rows[first] if alone else f"{noun}s {number} to {rows[after - 1].rpartition(' ')[2]}"
        )
    return list_first(pieces, count)


def suggest_name(name: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """Return `; did you mean 'gp'?`, or nothing when no known name is close."""
    close = difflib.get_close_matches(name, known, 1, cutoff)
    return f"; did you mean {close[0]!r}?" if close else ""


def absent(path: Path) -> str:
    """Say that there is no such file; of a folder what reads it.

    >>> absent(Path("nothing.npz"))
    'nothing.npz: no such file'
    """
    if path.is_dir():
        return (
            f"{path}: a folder, which dataset=rfid (argos, ...) dataset.root={path} reads; no file"
        )
    return f"{path}: no such file"


def explain_error(error: BaseException) -> str:
    """Say what another library calls wrong, on one line,
    without what only a programmer could do about it.
    """
    if isinstance(error, RecursionError):
        return "brackets within brackets, too many"
    text = " ".join(str(error).split()).partition("; use sys.set_int_max_str_digits")[0]
    return text or type(error).__name__


class Caution(str):
    """A remark of a reader that something may be wrong:
    `gsparc check` and runs print it as a warning.
    """


class Severe(Caution):
    """A caution about what may change all figures, a unit or a convention:
    runs say it again at their end.
    """


class Question(Severe):
    """What may be read in several ways, with the setting of each:
    training stops on it, unless it is answered or `dataset.guess=true`.
    """


class DataError(ValueError):
    """Input that was refused at load; nothing half-loaded exists when it is raised.

    Attributes:
        problems: everything that was found wrong, one line each; `str(error)` is the first of them.
    """

    def __init__(self, problems: str | Iterable[str], source: str | Path | None = None) -> None:
        listed = (problems,) if isinstance(problems, str) else tuple(problems)
        self.problems = tuple(" ".join(problem.splitlines()) for problem in listed)
        more = len(self.problems) - 1
        hint = f" (and {more} more: gsparc check {source or 'FILE'} lists them)" if more > 0 else ""
        super().__init__(self.problems[0] + hint)


@contextmanager
def readable(
    where: str | Path,
    fault: str,
    errors: type[Exception] | tuple[type[Exception], ...],
    if_absent: str = "",
) -> Iterator[None]:
    """Raise `DataError` in place of what other libraries raise in the block: WHERE:
    FAULT (what they say).

    Args:
        where: file, and part of it.
        fault: in words.
        errors: that are so turned; a `DataError` is left as it is.
        if_absent: said of a file that is not there, alone; empty: nothing else than of other
            errors.
    """
    try:
        yield
    except DataError:
        raise
    except errors as error:
        lacking = if_absent and isinstance(error, FileNotFoundError)
        raise DataError(
            f"{where}: {if_absent if lacking else f'{fault} ({explain_error(error)})'}"
        ) from None


class Problems(list[str]):
    """Collects what is wrong with one file or folder, so that a user sees all of it at once."""

    LIMIT = 5  # lines per sort of problem

    def __init__(self, source: str | Path) -> None:
        super().__init__()
        self.source = source

    def add(self, where: str | Path, what: str) -> Any:
        """Note that at `where` (file, array, row) something is wrong: `what`,
        and what was expected.

        Returns None, so that a reader that has nothing to return can end with it;
        so does `add_rows`.
        """
        self.append(f"{where}: {shorten(what)}")

    def add_rows(self, where: str | Path, rows: Iterable[str], what: str) -> Any:
        """Note `what` for each of `rows` (as a user names them), at most `LIMIT` of them."""
        names = list(rows)
        for name in names[: self.LIMIT]:
            self.add(f"{where}, {name}", what)
        if len(names) > self.LIMIT:
            self.append(f"{where}: {what}; the same in {len(names) - self.LIMIT} more rows")

    def add_values(
        self, where: str | Path, rows: Sequence[str], values: Any, good: Any, what: str
    ) -> bool:
        """Note `what` for rows whose values (S, ...) are not `good` (S,);
        returns whether there are any.
        """
        bad = np.flatnonzero(~good).tolist()
        self.add_rows(
            where, (f"{rows[i]} = {np.array2string(values[i], separator=', ')}" for i in bad), what
        )
        return len(bad) > 0

    def attempt(self, read: Callable[[], _Found]) -> _Found | None:
        """Return what `read` does; None, and noted, where it raises `DataError`."""
        try:
            return read()
        except DataError as error:
            self.extend(error.problems)
            return None

    def raise_if_any(self) -> None:
        """Raise `DataError` when anything was noted, each of it once."""
        if self:
            raise DataError([*dict.fromkeys(self)], self.source)
