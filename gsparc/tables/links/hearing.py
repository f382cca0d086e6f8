"""Which powers were measured, and which are only known to be below or above a level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.errors import Caution
from gsparc.base.limits import Limit, choice, number, or_null, or_word
from gsparc.data.blocks import is_big
from gsparc.data.schema import OTHER, StaticEnds
from gsparc.data.selection import take_rows
from gsparc.data.target import MOST_DB
from gsparc.physics.decibels import to_decibels
from gsparc.tables.checks.piles import APART_DB, find_saturation, find_sentinel_levels
from gsparc.tables.own_checks import Checker

POWERS = ("rssi", "rssi_db")
BESIDE, LEAST_MARKS = 6, 12  # rows around a mark; marks that tell
WEAK_SHARE = 0.62  # of marks beside rows that are weaker than half of the station's: not heard


def _are_levels(value: Any) -> bool:
    listed = np.atleast_1d(np.array(value, object)).ravel().tolist()
    return all(
        isinstance(level, int | float) and not isinstance(level, bool) and level < np.inf
        for level in listed
    )


# Of powers that were not measured, by a setting or an attribute of the file: the default,
# and what may be.
SAID = {
    "absent": ("auto", choice("auto", "weaker", "unknown", "silent")),
    "not_heard": (None, or_null(Limit("a list of levels [dB] like [-999]", _are_levels))),
    "saturation_db": ("auto", or_word(or_word(number(-MOST_DB, MOST_DB), "auto"), "none")),
}


def check_said(attributes: Mapping[str, Any]) -> None:
    """Raise `SettingError` where what is said of powers that were not measured cannot be."""
    for name, (default, limit) in SAID.items():
        limit.check(f"dataset.{name}", attributes.get(name, default))


def censor_rows(
    check: Checker, measured: str, links: StaticEnds, unlisted: int = 0
) -> StaticEnds | None:
    """Leave out rows without a value; censored ones hold the level that they lie below or above,
    masked.

    Args:
        check: of the file, whose `raw` is changed; takes notes, and what is wrong.
        measured: name of the measurement.
        links: of its rows; None is returned where something is wrong.
        unlisted: rows that lists of the strongest leave out.
    """
    if measured == "rssi_db" and links.static_end is not None:
        blank_ambiguous_marks(check, f"{OTHER[links.static_end]}_position")
    values, arrays, before = check.raw.arrays[measured], check.raw.arrays, len(check.problems)
    floor = _stated_floor(check, measured, values)
    if len(check.problems) > before:
        return None
    arrays.pop("sensitivity_db", None)
    mask = arrays.get("mask")
    if mask is not None and mask.shape != values.shape:
        return links  # said where the mask is read
    # A spectrum without power has no directions; where rows have paths they are a simulation's.
    silent = measured == "spectrum" and not is_big(values) and "path_offsets" not in arrays
    gaps = measured in POWERS or links.stations is not None  # what is not a number is missing there
    if not (gaps or mask is not None or silent):
        return links
    axes = tuple(range(1, values.ndim))
    unknown = np.isnan(values) if gaps else np.zeros(values.shape, bool)
    marked = np.ones(len(values), bool) if mask is None else mask.astype(bool).any(axis=axes)
    censored = saturated = np.zeros(len(values), bool)
    if measured == "rssi_db" and values.ndim == 1:
        unheard = _without_marks(check, values, floor) & marked
        heard = values[~unheard & np.isfinite(values)].astype(float)
        unknown |= unheard
        if floor is not None:
            # Of what is marked as not heard the weakest bounds it where no level is stated.
            floor = np.where(unheard & np.isnan(floor), heard.min(initial=np.inf), floor)
            unknown |= _below_floor(check, values, floor, ~unknown & marked)
            censored = unknown & marked & ~np.isnan(floor)
        elif unheard.any() and len(heard):
            floor, censored = np.full(len(values), heard.min()), unheard
        saturated = _saturated(check, values, ~unknown & marked)
    elif measured == "rssi" and values.ndim == 1 and (values == 0).any() and (values > 0).any():
        # Of linear powers 0 is what was not heard, as minus infinity is of levels.
        floor, censored = np.full(len(values), values[values > 0].min()), (values == 0) & marked
    if floor is not None:
        arrays[measured] = np.where(censored, floor, arrays[measured])
    is_missing = (unknown if mask is None else unknown & mask.astype(bool)).any(
        axis=axes
    ) & ~censored
    if mask is not None and is_missing.any():
        return links  # marked as measured, and is not: refused where values are read
    keep = marked & ~is_missing
    if silent and values.any():
        keep &= values.any(axis=axes)
    # As `Measurements.censored`: 1 too weak, -1 too strong, 0 measured.
    side = censored.astype(np.int8) - saturated
    if not (keep & (side == 0)).any():
        why = "nothing was heard in any row" if censored.any() else "nothing was measured"
        return check.refuse(measured, f"{why}; expected numbers")
    if not keep.all() or censored.any():
        none = " or without any power" if measured == "spectrum" else ""
        below = np.ones(1) if floor is None or not censored.any() else floor[censored]
        below = to_decibels(below) if measured == "rssi" else below
        limits = f"{below.min():.4g}" + (f" to {below.max():.4g}" if np.ptp(below) else "")
        reasons = ["not listed"] if unlisted else []
        reasons += ["not heard"] if not unlisted or censored.sum() > unlisted else []
        unheard = f"powers were {' or '.join(reasons)}: below {limits} dB"
        for flags, note in ((~keep, f"values are missing{none}"), (censored, unheard)):
            check.notes += [f"{flags.sum()} of {len(keep)} {note}"] if flags.any() else []
        arrays, side = take_rows(arrays, np.flatnonzero(keep), len(keep)), side[keep]
        check.raw = replace(check.raw, arrays=arrays)
    if not side.any():
        return links
    arrays["mask"] = arrays.get("mask", np.ones(len(side), bool)).astype(bool) & (side == 0)
    arrays["censored"] = side
    return links


def _stated_floor(check: Checker, measured: str, values: np.ndarray) -> np.ndarray | None:
    """The level (S,) [dB] below which the file says that nothing is heard; None without,
    or of no use.
    """
    level = check.read_real("sensitivity_db", (), (1,), values.shape[:1])
    saturates = not isinstance(check.raw.attributes.get("saturation_db", "auto"), str)
    for name, is_set in (
        ("sensitivity_db", level is not None),
        ("dataset.saturation_db", saturates),
    ):
        if is_set and measured != "rssi_db":
            return check.refuse(name, f"goes with rssi_db, not with {measured}")
    if level is None or values.ndim != 1:
        return None
    floor = np.broadcast_to(level, values.shape)
    if (np.abs(floor) > MOST_DB).any():  # NaN: of that station or row it is not known
        return check.refuse("sensitivity_db", "expected dB between -400 and 400")
    return floor


def _below_floor(
    check: Checker, values: np.ndarray, floor: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Which of known values (S,) lie below a level of hearing (S,), (S,) bool."""
    below = known & (values < floor)
    if below.any():
        share = f"{below.sum()} of {known.sum()} levels lie below sensitivity_db"
        check.notes.append(Caution(f"{share}: taken as not heard; has it the unit of the levels?"))
    return below


def blank_ambiguous_marks(check: Checker, moving: str) -> None:
    """Make marks that lie beside strong levels as well as beside weak ones NaN: no value,
    and not unheard.

    Args:
        check: of rows of links, whose `raw` is changed; takes notes.
        moving: name of the array of their places.
    """
    values, place = check.raw.arrays["rssi_db"], check.raw.arrays.get(moving, np.zeros(0))
    if (
        check.raw.attributes.get("not_heard") is not None
        or values.ndim > 1
        or place.shape != (len(values), 3)
    ):
        return
    station = check.raw.arrays.get("station", np.zeros(len(values), np.int64))
    marks, rest = find_sentinel_levels(values), values[np.isfinite(values) & (values != 0)]
    # However few, 0 beside levels far below is what a receiver says that knows none.
    alone = 0 < (values == 0).sum() < LEAST_MARKS and rest.max(initial=-np.inf) < -APART_DB
    marks += [0.0] if alone and 0.0 not in marks and len(rest) >= LEAST_MARKS else []
    heard = np.isfinite(values) & ~np.isin(values, marks) & np.isfinite(place).all(1)
    for mark in marks:
        beside: list[bool] = []
        marked = (values == mark) & np.isfinite(place).all(1)
        for marked_station in np.unique(station[marked]):
            heard_rows, marked_rows = (
                np.flatnonzero(rows & (station == marked_station)) for rows in (heard, marked)
            )
            if len(heard_rows) < BESIDE:
                continue
            near = cKDTree(place[heard_rows]).query(place[marked_rows], k=BESIDE)[1]
            level = values[heard_rows].astype(float)
            beside += (level[near].mean(1) < np.median(level)).tolist()
        # A coin that falls on either side: of few marks nothing is told.
        if not (mark == 0 and alone) and (
            len(beside) < LEAST_MARKS or np.mean(beside) > WEAK_SHARE
        ):
            continue
        check.raw.arrays["rssi_db"] = np.where(values == mark, np.nan, check.raw.arrays["rssi_db"])
        share = f"{int((values == mark).sum())} of {len(values)} levels"
        where = "" if mark == 0 and alone else ", beside strong levels as well as weak ones"
        note = (
            f"{share} are exactly {round(mark, 6) + 0:g}, apart from all others{where}: no "
            "value, left out"
        )
        check.notes.append(
            Caution(f"{note}; dataset.not_heard=[{mark:.12g}] takes them as not heard")
        )


def _without_marks(check: Checker, values: np.ndarray, level: np.ndarray | None) -> np.ndarray:
    """Which of levels (S,) are marks for "not heard", (S,) bool: those that the file names,
    else found.
    """
    setting = check.raw.attributes.get("not_heard")
    marks = (
        find_sentinel_levels(values)
        if setting is None
        else np.atleast_1d(np.asarray(setting, np.float64)).tolist()
    )
    # `not_heard=[]` keeps minus infinity as a level, too.
    silent = np.isin(values, marks) | ((values == -np.inf) & (setting is None or len(marks) > 0))
    floor = "sensitivity_db"
    if level is None and silent.any() and np.isfinite(values[~silent]).any():
        floor = f"{values[~silent & np.isfinite(values)].min():.4g} dB, the weakest level heard"
    for mark in marks if setting is None else ():
        share = (
            f"{int((values == mark).sum())} of {len(values)} levels are exactly "
            f"{round(mark, 6) + 0:g}"
        )
        note = f"{share}, apart from all others: taken as not heard, that is below {floor}"
        does = "refuses" if abs(mark) > MOST_DB else "keeps"
        say = f"dataset.not_heard=[] {does} them, sensitivity_db= sets another level"
        check.notes.append(Caution(f"{note}; {say}"))
    return silent


def _saturated(check: Checker, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Which of levels (S,) are at least the file's, or the found, level of saturation, (S,)
    bool.
    """
    limit = check.raw.attributes.get("saturation_db", "auto")
    level = (
        find_saturation(values[known])
        if limit == "auto"
        else None
        if limit == "none"
        else float(limit)
    )
    if level is None:
        return np.zeros(len(values), bool)
    # Both in float32: a file's level may differ from the decimal setting by its rounding.
    above = known & (values.astype(np.float32) >= np.float32(level))
    note = f"{int(above.sum())} of {int(known.sum())} levels are"
    if limit == "auto":
        note += f" exactly {level:.6g}, the most: a receiver in saturation? taken as at least that"
        check.notes.append(Caution(f"{note}; dataset.saturation_db=none takes them as measured"))
    else:
        check.notes.append(f"{note} {level:g} dB or more: saturated, taken as at least that")
    # Saturated rows hold the level itself: that bound is all that is known of them.
    check.raw.arrays["rssi_db"] = np.where(above, level, values)
    return above
