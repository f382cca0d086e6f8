"""When rows of a table were measured: a column of times as tools write them,
or a date and a clock in two.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Container, Iterable

import numpy as np
import pandas as pd

from gsparc.tables.heads import LISTS, words_of
from gsparc.tables.sheet import Sheet

DATE, CLOCK = (
    r"\d{1,4}([-/. ])(?:\d{1,2}|[A-Za-z]{3})\1\d{1,4}",
    r"\d{1,2}:\d{2}(?::\d{2})?(?:[.,:]\d+)?",
)
WRITTEN = re.compile(
    rf"(?:{DATE})?(?:(?:^|[T ]+){CLOCK})?(?: ?[AaPp][Mm])?(?: ?(?:Z|UTC|[-+]\d\d:?\d\d))?"
)
# Least numbers since 1970, their units [s]
EPOCHS = (1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0)
# Words of heads whose numbers are seconds
PLAIN = LISTS["time"] | {"s", "sec", "seconds", "gps", "unix"}
HALF_DAY_S = 43_200.0


def find_times(sheet: Sheet, used: Container[str | None]) -> tuple[str, ...]:
    """Return the head of a column not `used` that holds times, or of a date and a clock; none:
    ().
    """
    heads = [
        head for head in sheet.heads if head not in used and LISTS["time"] & set(words_of(head))
    ]
    texts = {head: pd.Series(sheet.words(head)) for head in heads}
    dates, clocks = ([h for h in heads if _all_match(texts[h], part)] for part in (DATE, CLOCK))
    pairs = [(dates[0], clocks[0])] if dates and clocks else []
    candidates = [*pairs, *((head,) for head in heads if head not in dates)]
    return next(
        (candidate for candidate in candidates if read_times(sheet, candidate) is not None), ()
    )


def read_times(sheet: Sheet, heads: Iterable[str]) -> tuple[np.ndarray, str] | None:
    """Return seconds (S,) of columns that hold times together, NaN where none is,
    and what they were.

    Dates count from 1970, clocks without one from midnight of their first day, other numbers as
    they do. None where some are no times.
    """
    text = pd.Series(sheet.joined(heads))
    times = _read_numbers(text, " ".join(heads)) or _read_text(text)
    if times is None:
        return None
    seconds = times[0][np.isfinite(times[0])]
    return times[0], times[1] + (", not in order of time" if (np.diff(seconds) < 0).any() else "")


def _all_match(text: pd.Series, pattern: str) -> bool:
    return bool((text != "").any() and text[text != ""].str.fullmatch(pattern).all())


def _read_numbers(text: pd.Series, head: str) -> tuple[np.ndarray, str] | None:
    value = pd.to_numeric(text, errors="coerce").to_numpy(np.float64)
    if np.isnan(value).all() or (np.isnan(value) & (text != "")).any():
        return None
    for least, unit in EPOCHS:
        if np.nanmin(value) >= least:
            return value * unit, f"since 1970, in units of {unit:g} s"
    words = set(words_of(head))
    if {"ms", "msec"} & words:
        return value / 1e3, "milliseconds"
    return (value, "seconds") if words <= PLAIN else None


def _read_text(text: pd.Series) -> tuple[np.ndarray, str] | None:
    if not _all_match(text, WRITTEN.pattern):
        return None
    text = text.str.replace(",", ".").str.replace(r"(:\d\d:\d\d):(?=\d)", r"\1.", regex=True)
    if _all_match(text, CLOCK):
        whole = text.str.replace(r"^(\d+:\d+)(?=$|\.)", r"\1:00", regex=True)
        seconds = pd.to_timedelta(whole, errors="coerce").dt.total_seconds().to_numpy(copy=True)
        finite = np.isfinite(seconds)
        # A clock that falls by half a day has passed midnight.
        seconds[finite] += (
            2 * HALF_DAY_S * np.cumsum(np.diff(seconds[finite], prepend=0.0) < -HALF_DAY_S)
        )
        return seconds, "clock times of a day that is not named"
    first, middle = text.str.extract(r"^(\d+)[-/. ](\d+)").apply(pd.to_numeric).max().tolist()
    day_first = first <= 31 and not (middle > 12 or text.str.contains("[AaPp][Mm]$").any())
    how = {"dayfirst": day_first, "utc": True, "errors": "coerce"}
    with warnings.catch_warnings(action="ignore"):  # that no format was guessed
        moment = pd.to_datetime(text, **how)  # all written as the first: seven times as quick
        odd = moment.isna() & (text != "")
        moment[odd] = pd.to_datetime(text[odd], format="mixed", **how)
    if moment.isna().all():
        return None
    seconds = (moment - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy()
    doubt = day_first and first <= 12 and text.str.contains("/").any()
    return seconds, "dates, day before month? no day beyond 12 tells" if doubt else "dates"
