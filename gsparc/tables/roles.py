"""What columns are taken for, how surely, and what is asked where several readings fit."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gsparc.base.errors import DataError, Question
from gsparc.tables.raw import Raw

# By a setting, a head, a documented default, values alone, or by nothing that decides
Sure = Literal["said", "named", "usual", "seen", "open"]
Said = Mapping[str, object]  # as `dataset.columns`
NONE = "none"  # in place of a head: no column is it


@dataclass(frozen=True)
class Answer:
    """A reading of a column.

    Attributes:
        said: what `dataset.columns` says then, by quantity.
        means: what it makes of the first row.
    """

    said: Said
    means: str = ""

    def __str__(self) -> str:
        settings = " ".join(say_column(role, value) for role, value in self.said.items())
        return f"{settings} ({self.means})" if self.means else settings


@dataclass(frozen=True)
class Role:
    """What columns are taken for.

    Attributes:
        heads: of the columns, as many as are read alike.
        role: quantity; empty: not used.
        sure: how it is known.
        unit: of the values as they are written.
        readings: that fit, the likeliest first; none where it is decided.
        why: what is open, for a question.
        column: the columns, as `dataset.columns` takes them.
        values: the first ones, as they are written.
    """

    heads: tuple[str, ...]
    role: str
    sure: Sure = "named"
    unit: str = ""
    readings: tuple[Answer, ...] = ()
    why: str = ""
    column: object = ""
    values: tuple[str, ...] = ()

    def question(self) -> Question:
        """Return one line: what is open, and the settings that answer it."""
        return Question(f"{self.why}? say {', or '.join(map(str, self.readings))}")


def say_quantity(role: str) -> str:
    """Return what settings call a quantity."""
    return role.replace("latitude", "lat").replace("longitude", "lon")


def say_column(role: str, text: object) -> str:
    """Return the setting that says what a column is, as a shell takes it.

    >>> print(say_column("rssi_db", "RSRP*-1"), say_column("station", "Cell id"))
    dataset.columns.rssi_db=RSRP*-1 'dataset.columns.station="Cell id"'
    >>> print(say_column("rssi_db", ["A", "B"]))
    'dataset.columns.rssi_db=["A","B"]'
    """
    name = say_quantity(role)
    if isinstance(text, list | tuple):
        listed = ",".join(f'"{head}"' for head in text)
        return f"'dataset.columns.{name}=[{listed}]'"
    plain = re.fullmatch(r"[\w.*+-]+", str(text))
    return f"dataset.columns.{name}={text}" if plain else f"'dataset.columns.{name}=\"{text}\"'"


@dataclass(frozen=True)
class Settled:
    """A table read with one answer to each question.

    Attributes:
        raw: its arrays.
        said: settings, answers included.
        asked: roles whose readings build different arrays, or that somebody has to confirm.
    """

    raw: Raw
    said: Said
    asked: tuple[Role, ...] = field(default=())


Build = Callable[[Said], tuple[Raw | None, list[Role], tuple[str, ...]]]


def settle(build: Build, said: Said, source: str, compare: bool = True) -> Settled:
    """Read a table with the likeliest reading of each open role that builds arrays.

    Args:
        build: its arrays, roles that are open, and what is wrong, where settings say so much.
        said: settings.
        source: for messages.
        compare: whether the other readings are tried, too; those that change nothing are not asked.

    Raises:
        DataError: what is wrong, after the questions that are open.
    """
    raw, asked, problems = build(said)
    if not asked:
        if raw is None:
            raise DataError(problems)
        return Settled(raw, said)
    role, read, faults = asked[0], list[tuple[Answer, Settled]](), list[str]()
    for answer in role.readings if compare else role.readings[:1]:
        try:
            more = {**said, **answer.said}
            read.append((answer, settle(build, more, source, compare and not read)))
        except DataError as error:
            faults = faults or [*error.problems]
    if not read:
        raise DataError([f"{source}: {role.question()}", *faults])
    first = read[0][1]
    unlike = [read[0][0]]
    for answer, settled in read[1:]:
        unlike += [] if are_alike(settled.raw, first.raw) else [answer]
    confirm = role.sure == "open" and len(role.readings) == 1
    own = (replace(role, readings=tuple(unlike)),) if confirm or len(unlike) > 1 else ()
    return replace(first, asked=own + first.asked)


def are_alike(first: Raw, other: Raw) -> bool:
    """Tell whether two readings have the same arrays."""
    return first.arrays.keys() == other.arrays.keys() and all(
        np.array_equal(array, other.arrays[name], equal_nan=array.dtype.kind in "fc")
        for name, array in first.arrays.items()
    )
