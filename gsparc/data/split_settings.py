"""How rows are split, as settings say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsparc.base.errors import DataError
from gsparc.base.limits import (
    POSITIVE,
    SHARE,
    Checked,
    Limit,
    choice,
    number,
    or_null,
    setting,
    whole,
)

WHOLE = ("stations", "carriers", "runs")  # of which whole ones are held out
NAMES = ("random", "grouped", "corner", "blocks", "sparse", "later", *WHOLE, "none")
CORNERS = ("--", "-+", "+-", "++")
NAMED = ("outliers", "foreign")


def _are_rows(value: Any) -> bool:
    listed = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(listed, str) or not isinstance(listed, Sequence):
        return isinstance(listed, str) and listed in NAMED
    return all(
        isinstance(r, int | np.integer) and not isinstance(r, bool) and r >= 0 for r in listed
    )


LeaveOut = Sequence[int] | Literal["outliers", "foreign"]
ROWS = Limit("outliers, foreign, or a list of rows like [3, 17],", _are_rows)
KNOWN = Limit(f"one of {', '.join(NAMES)}, file", lambda name: name in NAMES, (*NAMES, "file"))


@dataclass(frozen=True)
class SplitSettings(Checked):
    """How to split; one instance of the config group `split`.

    >>> SplitSettings(test_fraction=1.5)
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: test_fraction=1.5: a number above 0 and below 1 is needed

    Attributes:
        name: `random`, `grouped`, `corner`, `blocks`, `sparse`, `later`, `stations`, `carriers` or
            `runs`; `none` tests no row.
        seed: of every random choice below.
        val_fraction: share of each fold's training rows kept for validation.
        test_fraction: share of the rows that `random` (without files), `corner` and, the last ones,
            `later` hold out, and of the runs that `runs` does, one at least.
        redraw: `random` ignores the release's own files and draws anew.
        folds: number of folds of `grouped`.
        stretches_per_fold: `grouped` cuts the path into folds x this many stretches.
        side_m: of the squares of floor that `blocks` holds out whole [m], or `stations` of both
            ends; None: a tenth of the longer side.
        share: of the places, that `blocks` holds out at least.
        buffer_m: `grouped` and `corner` drop training rows this close to a test row [m].
        corner: of `corner`, lower or upper end in x and y as `--`, `-+`, `+-` or `++`.
        train_fraction: share of the rows that `sparse` trains on; from 1 on how many.
        train_count: thin each fold's training rows to this many (validation included); None keeps
            all.
        thin: the same as a share in (0, 1]; smaller sets are subsets of larger ones.
        spacing_m: keep only training rows at least this far apart, before the other two [m]; None
            keeps all.
        leave_out: rows neither learned from nor tested on, `outliers` or `foreign`; of `stations`
            and `carriers`, how many are held out together, drawn by seed (0: each one in its turn).
        end: of `stations`, which end is new, `tx` or `rx`: whole stations, or squares of the end
            that moves; `both`: test rows have both ends new, training rows neither. None: stations.
    """

    name: str = setting("random", KNOWN)
    seed: int = setting(0, whole(0))
    val_fraction: float = setting(0.1, number(0, 1, open_high=True))
    test_fraction: float = setting(0.2, SHARE)
    redraw: bool = False
    folds: int = setting(5, whole(2))
    stretches_per_fold: int = setting(1, whole(1))
    side_m: float | None = setting(None, or_null(POSITIVE))
    share: float = setting(0.2, SHARE)
    buffer_m: float = setting(0.03, number(0))
    corner: str = setting("++", choice(*CORNERS))
    train_fraction: float = setting(0.1, number(0, open_low=True))
    train_count: int | None = setting(None, or_null(whole(1)))
    thin: float = setting(1.0, number(0, 1, open_low=True))
    spacing_m: float | None = setting(None, or_null(POSITIVE))
    leave_out: LeaveOut | int = ()
    end: str | None = setting(None, or_null(choice("tx", "rx", "both")))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end is not None and self.name != "stations":
            raise DataError(f"split.end={self.end}: split=stations takes it, not {self.name}")
        # These take a number of stations, or carriers, there; everything else a list of rows.
        if (
            self.name not in ("stations", "carriers")
            or type(self.leave_out) is not int
            or self.leave_out < 0
        ):
            ROWS.check("leave_out", self.leave_out)

    def for_moving_end(self, moving: str) -> SplitSettings:
        """Return the same of a site whose end `moving` moves: squares of it where it is asked."""
        new_places = self.end == moving
        return replace(self, name="blocks", end=None, leave_out=()) if new_places else self

    def held_out_count(self, count: int) -> int:
        """Return how many of `count` stations, or runs, are held out together; 0:
        each in its turn.
        """
        if self.name == "runs":
            return max(round(self.test_fraction * count), 1)
        return self.leave_out if isinstance(self.leave_out, int) else 0


@dataclass(frozen=True)
class FileSettings(Checked):
    """The folds of an index file: the config group `split` with the name `file`.

    Attributes:
        path: as a run writes it, split.json.
        leave_out: see `SplitSettings`.
    """

    name: str = "file"
    path: str = ""
    leave_out: LeaveOut = setting((), ROWS)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.path, str | Path) or str(self.path) in ("", "???"):
            raise DataError("split.path is not set; say split.path=split.json for split=file")
