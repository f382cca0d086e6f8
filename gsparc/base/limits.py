"""What a setting may be, said where the setting is defined and checked when it is given.

A dataclass of settings inherits `Checked` and gives limits beside defaults, such as
`count: int = setting(500, whole(0))`; a constructor calls `check_arguments`. The error names the
setting; the command line puts the group it stands in before that
(`gsparc.evaluation.console.error_in_one_line`).
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsparc.base.errors import DataError, list_first, suggest_name


class SettingError(DataError):
    """A setting that cannot be; the text begins with its name, an equals sign and the value."""


@dataclass(frozen=True)
class Limit:
    """What a setting may be.

    Attributes:
        words: the same for people.
        holds: whether a value is one.
        known: choices, for suggesting the nearest.
    """

    words: str
    holds: Callable[[Any], bool]
    known: tuple[str, ...] = ()

    def check(self, name: str, value: Any) -> None:
        """Raise `SettingError` unless `value` is allowed for the setting called `name`."""
        if self.holds(value):
            return
        hint = suggest_name(value, self.known) if isinstance(value, str) else ""
        raise SettingError(f"{name}={value!r}: {self.words} is needed{hint}")


def whole(least: int, most: int | None = None) -> Limit:
    """Allow a whole number from `least`.

    >>> whole(1, 8).words
    'a whole number of at least 1 and at most 8'
    >>> whole(1, 8).holds(3), whole(1, 8).holds(True)
    (True, False)
    """
    words = f"a whole number of at least {least}" + ("" if most is None else f" and at most {most}")
    return Limit(words, lambda v: type(v) is int and v >= least and (most is None or v <= most))


def number(
    low: float, high: float = math.inf, *, open_low: bool = False, open_high: bool = False
) -> Limit:
    """Allow a finite number between `low` and `high`.

    >>> number(0, 1, open_low=True).check("share", 0)
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: share=0: a number above 0 and at most 1 is needed
    """
    words = (
        (f"a number {'above' if open_low else 'of at least'} {low:g}")
        if low > -math.inf
        else "a number"
    )
    words += "" if high == math.inf else f" and {'below' if open_high else 'at most'} {high:g}"
    return Limit(
        words,
        lambda v: (
            _real(v)
            and (v > low if open_low else v >= low)
            and (v < high if open_high else v <= high)
        ),
    )


def choice(*values: str) -> Limit:
    """Allow one of a few words.

    >>> choice("auto", "each").check("k", "eech")
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: k='eech': one of auto, each is needed; did you mean 'each'?
    """
    return Limit(f"one of {list_first(values, MOST_NAMED)}", lambda v: v in values, values)


def switch(*more: str) -> Limit:
    """Allow true, false, or one of a few words."""
    words = ("true", "false", *more)
    return Limit(f"one of {', '.join(words)}", lambda v: isinstance(v, bool) or v in more, words)


def or_word(limit: Limit, word: str) -> Limit:
    """Allow the same, or a word.

    >>> or_word(whole(1), "auto").words
    'a whole number of at least 1, or auto'
    """
    return Limit(
        f"{limit.words}, or {word}", lambda v: v == word or limit.holds(v), (*limit.known, word)
    )


def or_null(limit: Limit) -> Limit:
    """Allow the same, or nothing.

    >>> or_null(number(0)).holds(None)
    True
    """
    return Limit(f"{limit.words}, or null", lambda v: v is None or limit.holds(v), limit.known)


# Of files, whoever wrote them.
LIFTED_BY = "GSPARC_MOST_BYTES"  # in the environment: another number of bytes than the following
MOST_BYTES = 2**27  # of a table of text, which takes twenty times as many in memory
# Times its packed bytes, rows of levels are 3 to 20; bytes of any
MOST_UNPACKED, LEAST_UNPACKED = 100, 2**24
MOST_COLUMNS = 10_000  # read in two seconds; a hundred thousand in a minute
MOST_CELLS = 3 * 10**7  # of 90 bytes each in memory
MOST_VALUES = 10_000  # of a cell
LEAST_CONTENT = 5  # characters for each line, tag or bracket of a large file
LONGEST_LINE = 2**20  # characters: of 200 MB of them cells took 10 GiB
LONGEST_HEAD = 1_000  # characters: words and units are sought in each
DEEPEST = 500  # brackets within brackets
# Times a YAML text, with its aliases written out: a few lines may be a billion values
MOST_GROWTH = 10
LEAST_NODES = 10_000  # of YAML that are not counted


def most_text_bytes(packed: int | None = None) -> int:
    """Return how many bytes of text are read from a file;
    from so many `packed` ones of a compressed file.

    Raises:
        SettingError: `GSPARC_MOST_BYTES` is no whole number.
    """
    lifted = os.environ.get(LIFTED_BY, "")
    if lifted:
        whole(1).check(LIFTED_BY, int(lifted) if lifted.isdecimal() else lifted)
        return int(lifted)
    return (
        MOST_BYTES
        if packed is None
        else min(MOST_BYTES, max(LEAST_UNPACKED, MOST_UNPACKED * packed))
    )


MOST_NAMED = 30  # of the words that may stand in a setting
POSITIVE = number(0, open_low=True)
SHARE = number(0, 1, open_low=True, open_high=True)


def _real(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def finite_array(numbers: Any) -> np.ndarray:
    """Return numbers as float64 in the shape in which they were given; (0,) where one is none,
    or not finite.

    >>> finite_array([[1, 2.5]]), finite_array([1.0, "2"])
    (array([[1. , 2.5]]), array([], dtype=float64))
    """
    try:
        boxed = np.array(numbers, dtype=object)
    except ValueError:  # rows of different lengths
        return np.zeros(0)
    return boxed.astype(np.float64) if all(map(_real, boxed.flat)) else np.zeros(0)


def parse_numbers(words: Sequence[str]) -> np.ndarray:
    """Return numbers (n,) that words write; (0,) where one is none, or not finite.

    >>> parse_numbers(["1", "2.5"]), parse_numbers(["1", "x"])
    (array([1. , 2.5]), array([], dtype=float64))
    """
    try:
        numbers = np.array(words, np.float64)
    except ValueError:
        return np.zeros(0)
    return numbers if np.isfinite(numbers).all() else np.zeros(0)


def setting(default: Any, limit: Limit) -> Any:
    """Define a field of a `Checked` dataclass."""
    return dataclasses.field(default=default, metadata={"limit": limit})


def internal(default: Any) -> Any:
    """Define a field of a dataclass of settings that configurations leave out."""
    return dataclasses.field(default=default, metadata={"internal": True})


class Checked:
    """A dataclass that refuses, with `SettingError`, what its fields' limits do not allow.

    >>> @dataclass
    ... class Search(Checked):
    ...     steps: int = setting(500, whole(1))
    >>> Search(steps=0)
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: steps=0: a whole number of at least 1 is needed
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if "limit" in field.metadata:
                field.metadata["limit"].check(field.name, getattr(self, field.name))


def check_arguments(arguments: Any, **limits: Limit) -> None:
    """Check arguments of a function by name, of its `locals()`, or settings of a configuration."""
    for name, limit in limits.items():
        limit.check(name, arguments[name])
