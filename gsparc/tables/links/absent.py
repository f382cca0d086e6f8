"""Rows of stations that were not heard, which a file of links leaves out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.base.errors import Question, Severe, list_first
from gsparc.data.assemble import FARTHEST
from gsparc.data.schema import OTHER, End, Stations
from gsparc.data.selection import take_rows
from gsparc.tables.checks.plausibility import find_marks
from gsparc.tables.links.strongest import StrongestLists
from gsparc.tables.own_checks import Checker

LEAST_LISTED = 3  # stations, for a floor
UNLISTED_EACH = 2  # rows of what is not listed for one that is


def add_absent(check: Checker, measured: str, count: int) -> None:
    """Say that each of `count` stations without a level at a place
    where others have one was not heard.
    """
    if measured != "rssi_db":
        return check.problems.add("dataset.absent", f"goes with levels [dB], not with {measured}")
    arrays = check.raw.arrays
    if arrays["rssi_db"].ndim != 1:
        return None  # refused where values are read
    _, first, of_place = np.unique(arrays["place"], return_index=True, return_inverse=True)
    of_place = of_place.reshape(-1)
    has_level = ~np.isnan(arrays["rssi_db"])
    some = np.bincount(of_place, has_level) > 0
    # Links are numbered place by station, so that those without a row are a set difference.
    gaps = np.setdiff1d(np.arange(len(first) * count), of_place * count + arrays["station"])
    gaps = gaps[some[gaps // count]]
    floor = _floors(arrays, count)
    # Minus infinity lies below whatever turns out to be the limit of hearing.
    _repeat(check, np.r_[: len(of_place), first[gaps // count]], gaps % count)
    if floor is not None and floor.ndim:
        check.raw.arrays["sensitivity_db"][len(of_place) :] = floor[gaps % count]
    empty = np.flatnonzero(~has_level & some[of_place])  # cells of a wide table
    check.raw.arrays["rssi_db"][empty] = -np.inf
    silent = len(gaps) + len(empty)
    check.notes.append(
        f"{silent} links without a level were not heard, as dataset.absent=silent says"
    )


def add_unlisted(
    check: Checker, stations: Stations, static: End, absent: str, listened: bool
) -> int:
    """Add rows, twice as many as are heard, of what lists of the strongest or a floor leave out.

    Of pairs that no row names nobody knows whether a receiver `listened`: that is asked.

    Returns how many lists leave out. Where `absent` is not `auto` what it does
    to figures is said alone.
    """
    arrays, count = check.raw.arrays, len(stations)
    levels, of, floor = arrays["rssi_db"], arrays["station"], _floors(arrays, count)
    whole = levels.ndim == 1 and "mask" not in arrays
    heard = np.flatnonzero(np.isfinite(levels) if whole else np.zeros(0))
    if not len(heard) or ("sensitivity_db" in arrays and floor is None):
        return 0
    # Noise below a stated level has its place in a list,
    # and bounds what is not listed by that level.
    levels = np.where(
        np.isfinite(levels), np.fmax(levels, arrays.get("sensitivity_db", -np.inf)), levels
    )
    moving = arrays[f"{OTHER[static]}_position"][heard].astype(np.float64)
    moving = np.where(np.abs(moving) > FARTHEST, np.nan, moving)  # refused where positions are read
    lists = StrongestLists.from_rows(
        arrays["place"][heard], of[heard], levels[heard], moving, count
    )
    strongest = lists.are_strongest()
    # What is known not to be heard, of marks or a stated sensitivity, needs no guess.
    limit_known = floor is not None or np.isneginf(levels).any() or bool(find_marks(levels[heard]))
    no_floor = strongest or limit_known or absent == "silent" or count < LEAST_LISTED
    bound = None if no_floor else lists.below_floor()
    if not strongest and bound is None:
        return 0
    listed = "the strongest alone" if lists.length == 1 else f"the {lists.length} strongest"
    missing = f"lists of {listed} of {count} stations"
    if bound is not None:
        missing = "levels are missing beside weak ones alone"
    if bound is not None and absent == "auto" and not listened:
        how = "not heard, or not measured? say dataset.absent=weaker (below each station's "
        how += "weakest), or dataset.absent=unknown (not measured, and not used)"
        check.notes.append(Question(f"{missing}: {how}"))
    if bound is not None:
        (floor, may), lists = bound, replace(lists, length=0)
        how = (
            f"not heard, below each station's weakest ({np.nanmin(floor):.4g} to "
            f"{np.nanmax(floor):.4g} dB)"
        )
        out = np.isnan(lists.level).any(0) & ~np.isnan(floor) & ~may.any(0)
        if out.any():
            how += (
                f", but of {list_first(np.array(stations.shown)[out])} unknown, strong ones "
                "are lost"
            )
    else:
        # Without a stated sensitivity, the weakest level heard anywhere bounds what lists leave
        # out.
        stated = np.full(count, np.nan if floor is None else floor)
        floor = np.nan_to_num(stated, nan=levels[heard].min())
        is_lossy = lists.short_are_lost(floor)
        may = np.isnan(lists.level) & (lists.full[:, None] | (not is_lossy))
        how = "a station that a full list leaves out is learned as below its weakest level"
        how += f", in lists shorter than {lists.length}: "
        how += "unknown, strong ones are lost there" if is_lossy else f"below {floor.min():.4g} dB"
    if absent not in ("auto", "weaker"):
        text = f"{missing} with dataset.absent={absent}: unlisted ones are predicted too "
        text += "high, or too low (silent), and figures of listed rows do not show it"
        check.notes.append(Severe(f"{text}; leave absent out"))
        return 0
    most, all_below = UNLISTED_EACH * len(heard), int(may.sum())
    of_list, station, below = lists.bound_unlisted(floor, most, may)
    _repeat(check, np.r_[heard, heard[lists.first[of_list]]], station)
    check.raw.arrays["sensitivity_db"] = np.r_[levels[heard], below]
    used = (
        "all" if len(below) == all_below else f"{len(below)} (mostly near where they are listed) of"
    )
    used = f"{used} {all_below} unlisted levels are used beside {len(heard)} listed ones"
    check.notes += [f"{missing}: {how}", f"{used} (dataset.absent=unknown uses none)"]
    return len(below) * strongest


def _floors(arrays: dict[str, np.ndarray], count: int) -> np.ndarray | None:
    """The sensitivity (), or (T,) of `count` stations where their rows agree; None elsewhere,
    or without.
    """
    floor = arrays.get("sensitivity_db")
    if floor is None or floor.ndim == 0:
        return floor
    each = np.full(count, floor.min())
    each[arrays["station"]] = floor
    return each if np.array_equal(each[arrays["station"]], floor, equal_nan=True) else None


def _repeat(check: Checker, like: np.ndarray, station: np.ndarray) -> None:
    """Take rows `like` (n,); the last of them are of stations (m,) that were not heard there."""
    arrays = take_rows(check.raw.arrays, like, len(check.raw.arrays["station"]))
    heard = len(like) - len(station)
    arrays["station"] = np.r_[arrays["station"][:heard], station]
    arrays["rssi_db"] = np.r_[
        arrays["rssi_db"][:heard].astype(np.float64), np.full(len(station), -np.inf)
    ]
    check.raw = replace(check.raw, arrays=arrays)
