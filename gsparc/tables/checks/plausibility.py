"""Warnings about readable measurements: units, columns, copies, wild rows,
stations that changed or were off.

Pure functions of arrays; each returns lines for a person, none where nothing looks wrong. Rows are
links, what one station measured at one place, in the order of measuring; levels are in dB or dBm,
NaN for no value.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from gsparc.base.errors import Severe, list_first
from gsparc.data.blocks import rows_by
from gsparc.data.row_order import along_curve
from gsparc.tables.checks.level_steps import MOST_BLOCKS, LevelStep, detect_level_steps
from gsparc.tables.checks.link_levels import UNNAMED, LinkLevels
from gsparc.tables.checks.misplaced import misplaced_warnings

NAMED = 5  # wild rows that a station may have, however few its rows
SATURATED = 0.01  # of all levels, at least
PILE = 0.05  # of all levels, at least: no level of a receiver holds as many by chance
APART_DB, GAP_DB = 20.0, 3.0  # between a mark and all levels; below a pile that holds many
REPEATS, FEW_APART = 3, 0.02
# Width of a pile of a receiver's noise; its share of the levels, at least
NOISE_DB, PILED = 4.0, 1 / 3
HIGHEST_DBM, LOWEST_DBM = 60.0, -174.0  # a kilowatt received; thermal noise in a hertz
OUTLIER_DB = 25.0  # from the rows before and after: more than fading does between neighbours
SPREADS = 10.0  # scaled median absolute deviations of that difference
NEIGHBOURS = 5  # rows on each side
LONG_GAP = 20  # rows without a value, or at one place, in one piece
# Rows, of levels that all agree but for one, and of stations at one place or with one content
LEAST = 5
# Between levels of one place, at least: fading of who stands still is faster than it is deep
STILL_DB = 10.0


def sanity_warnings(levels: LinkLevels, steps: Sequence[tuple[int, LevelStep]]) -> list[str]:
    """Return all warnings about levels at places.

    Args:
        levels: of powers.
        steps: `find_level_steps` them.
    """
    texts = [*level_warnings(levels.level_db), *two_unit_warnings(levels), *floor_warnings(levels)]
    severe = map(Severe, [*texts, *misplaced_warnings(levels)])
    warnings = [
        *severe,
        *twin_warnings(levels),
        *still_warnings(levels),
        *outlier_row_warnings(levels),
    ]
    return [*warnings, *step_warnings(levels, steps), *gap_warnings(levels)]


def degree_warnings(latitude: np.ndarray, longitude: np.ndarray) -> list[str]:
    """Warn of latitudes and longitudes (n,) [deg] on Earth that may be swapped, or radians."""
    where = f"latitude {np.median(latitude):.6g}, longitude {np.median(longitude):.6g}"
    if not -60 <= np.median(latitude) <= 75:
        pole = "Antarctic" if np.median(latitude) < 0 else "Arctic"
        return [f"the places lie in the {pole} ({where}): latitude and longitude swapped?"]
    if np.abs(latitude).max() <= np.pi / 2 and np.abs(longitude).max() <= np.pi:
        sea = f"the places lie in the Gulf of Guinea ({where}), at sea"
        return [f"{sea}: radians? write degrees, or [rad] in the heads of a table"]
    return []


def level_warnings(level_db: np.ndarray) -> list[str]:
    """Warn of levels (n,) [dB] that may be linear, percent or indices, or hold marks."""
    values = level_db[np.isfinite(level_db)]
    if len(values) < 2:
        return []
    different, counts = np.unique(values, return_counts=True)
    others = len(values) - counts.max()
    if others <= min(1, len(values) // LEAST):
        but = (
            (f" but {others}, {values[values != different[counts.argmax()]][0]:g} dB,")
            if others
            else ""
        )
        return [
            f"all levels{but} are {different[counts.argmax()]:g} dB: is it the column of levels?"
        ]
    low, high = float(values.min()), float(values.max())
    if low < 0 and high > HIGHEST_DBM:
        count = int((values > HIGHEST_DBM).sum())
        why = "a sign lost, or a kilowatt received?"
        return [f"{count} levels above {HIGHEST_DBM:g} dBm, up to {high:g}: {why}"]
    if np.median(values) < LOWEST_DBM:
        return [
            f"levels of {low:.4g} to {high:.4g}, most below thermal noise of a hertz: in decibels?"
        ]
    whole = (np.abs(values - values.round()) < 1e-3).all()  # powers in single precision
    if low >= 0 and (high <= 1 or high > HIGHEST_DBM or whole):
        finding = (
            f"no level of {low:g} to {high:g} is below 0: losses (store minus them; "
            "dataset.columns."
        )
        return [
            f"{finding}rssi_db=HEAD*-1), per cent, an index, or linear (give it as rssi, in W)?"
        ]
    return []


def two_unit_warnings(levels: LinkLevels) -> list[str]:
    """Warn of some levels in another unit, as dBW beside dBm: near rows agree, or are far apart."""
    differences = [np.zeros(0)]
    for _, used in levels.heard():
        place, level = levels.position[used], levels.level_db[used]
        if len(used) > NEIGHBOURS:
            differences.append(np.abs(level - level[cKDTree(place).query(place, 2)[1][:, 1]]))
    rows = np.concatenate(differences)
    far, between = (
        int((rows > APART_DB).sum()),
        int(((rows > APART_DB / 2) & (rows <= APART_DB)).sum()),
    )
    if far <= max(REPEATS, FEW_APART * len(rows), between):
        return []
    finding = f"{far} of {len(rows)} levels are over {APART_DB:g} dB from that of the nearest row"
    return [f"{finding}, {between} over {APART_DB / 2:g}: in two units?"]


def floor_warnings(levels: LinkLevels) -> list[str]:
    """Warn of stations whose levels pile up at a receiver's own noise, or lowest reading."""
    piles, names = find_noise(levels.station, levels.level_db, levels.limited), levels.names
    # Upwards, so that levels below what is said are those of the pile;
    # single precision has errors of 1e-6.
    floors = [
        (
            "" if t < 0 else _of([names[t]], len(names)),
            float(np.ceil(round(100 * top, 3)) / 100),
            share,
        )
        for t, (top, share) in piles.items()
    ]
    shares = list_first(
        [f"{share:.0%} of the levels{who} below {top:g} dB" for who, top, share in floors]
    )
    return [
        f"not heard? {shares} look like a receiver's noise or lowest reading, but are learned as "
        "signals; "
        f"sensitivity_db={top:g} in the file (of a table dataset.columns.sensitivity_db={top:g}, "
        "or a "
        "column) takes lower levels as not heard"
        for top in sorted(top for _, top, _ in floors)[-1:]
    ]


def find_noise(
    station: np.ndarray, level_db: np.ndarray, limited: Container[int] = ()
) -> dict[int, tuple[float, float]]:
    """Return `find_floor_pile` of stations (n,) whose levels (n,) [dB] have one,
    else that of all under -1.

    NaN are no levels; stations `limited` have a level of hearing that is known.
    """
    station, level_db = station[finite := np.isfinite(level_db)], level_db[finite]
    heard = {int(t): level_db[station == t] for t in np.unique(station) if t not in limited}
    # Of a station that is seldom heard weak levels are missing, not piled up.
    often = max(map(len, heard.values()), default=0) / 2
    piles = {t: find_floor_pile(level) for t, level in heard.items() if len(level) >= often}
    piles |= {} if limited or any(piles.values()) else {-1: find_floor_pile(level_db)}
    return {t: pile for t, pile in piles.items() if pile}


def find_floor_pile(levels: np.ndarray) -> tuple[float, float] | None:
    """Return the level below which a pile at the lowest of levels (n,) lies, and its share;
    None without.

    The lowest level may repeat. Else signals become rarer upwards no faster than exponentially
    (distances and shadowing have log-concave densities in decibels): a pile is one that far fewer
    follow than that law with the mean of all lets expect.
    """
    levels, (different, counts) = np.sort(levels), np.unique(levels, return_counts=True)
    if len(counts) < 4:
        return None
    if counts[0] > max(PILE * len(levels), 10, 5 * float(np.median(counts)), 3 * counts[1]):
        return float(different[1]), counts[0] / len(levels)
    window_counts = np.searchsorted(levels, levels + NOISE_DB, "right") - np.arange(len(levels))
    first, count = int(window_counts.argmax()), int(window_counts.max())
    top = levels[first] + NOISE_DB
    # A decibel above the pile
    after, end = np.searchsorted(levels, top + np.array([1, 1 + NOISE_DB]))
    low = first <= 0.1 * count + 2 and count >= max(PILED * len(levels), 15)
    # Few far above: the range of all is small
    if not low or len(levels) - end < PILE * len(levels):
        return None
    most = end - after + np.sqrt(end - after) + 1  # a deviation more than were counted
    expected = count * np.exp(-(NOISE_DB + 1) / (levels[first:] - levels[first]).mean())
    # In simulated tables without a floor more than .7 of those expected follow.
    return (float(top), (first + count) / len(levels)) if most < 0.7 * expected else None


def find_saturation(values: np.ndarray) -> float | None:
    """Return the highest of levels (n,) where it repeats as no level
    of a receiver does by chance.
    """
    different, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    piled = len(counts) > 1 and counts[-1] > max(SATURATED * counts.sum(), 10, 5 * counts[-2])
    return float(different[-1]) if piled else None


def find_marks(values: np.ndarray) -> list[float]:
    """Return levels [dB] among (n,) that repeat exactly, apart from all others: marks, not levels.

    At either end more than 20 dB apart, and far beside the spread of the rest; at the upper end, as
    rows beside a station are strong, not below 0 or nearly as far as all others lie apart; at the
    lower end a pile needs only a gap, as a receiver's own levels have none.
    """
    marks: list[float] = []
    rest = values[np.isfinite(values)]
    while True:
        different, counts = np.unique(rest, return_counts=True)
        if len(different) < 4:
            return marks
        steps = np.diff(different)
        spans = (different[-1] - different[1], different[-2] - different[0])
        usual = max(GAP_DB, 5 * float(np.median(steps)))
        piled = counts[0] > max(PILE * len(rest), 10) and counts[0] > 5 * float(np.median(counts))
        piled = piled and steps[0] >= usual
        enough = (steps[[0, -1]] > np.maximum(APART_DB, 0.3 * np.array(spans))) & (
            counts[[0, -1]] >= REPEATS
        )
        beyond = different[-1] >= 0 or steps[-1] > max(1.5 * APART_DB, 0.7 * spans[1])
        new_marks = different[[0, -1]][enough & [True, beyond] | [piled, False]].tolist()
        if not new_marks:
            return marks
        marks += new_marks
        rest = rest[~np.isin(rest, new_marks)]


def still_warnings(levels: LinkLevels) -> list[str]:
    """Warn of a place that many rows in a piece share while levels change as on a way:
    a fix stood still.

    Where nothing moves, levels differ from row to row as much as they do
    in all (J. von Neumann, 1941).
    """
    still: dict[tuple[str, str, int], dict[str, float]] = defaultdict(dict)
    alone: dict[str, float] = {}
    for t, used in levels.heard() if levels.ordered else ():
        moves = np.flatnonzero(np.diff(levels.position[used], axis=0).any(axis=1)) + 1
        if not len(moves) and len(used) >= LEAST and np.ptp(levels.level_db[used]) > STILL_DB:
            alone[levels.names[t]] = float(np.ptp(levels.level_db[used]))
            continue
        for piece in np.split(used, moves):
            level = levels.level_db[piece]
            if (
                len(piece) >= LONG_GAP
                and np.ptp(level) > STILL_DB
                and np.diff(level).var() < level.var() / 2
            ):
                where = levels.rows[piece[0]], levels.rows[piece[-1]], len(piece)
                still[where][levels.names[t]] = float(np.ptp(level))
    finding = (
        f"all rows{_of([*alone], len(levels.names))} are at one place, while levels change "
        "by up to "
    )
    return [
        f"{finding}{max([0.0, *alone.values()]):.0f} dB: elsewhere nothing is learned of it"
    ] * bool(alone) + [
        f"{first} to {last}: one place for {count} rows, while levels change by "
        f"{max(who.values()):.0f} dB"
        f"{_of([*who], len(levels.names))}: did the fix stand still? take them out"
        for (first, last, count), who in still.items()
    ]


def twin_warnings(levels: LinkLevels) -> list[str]:
    """Warn of stations whose names differ by capitals alone,
    or that hold equal levels at equal places.
    """
    alike: dict[tuple[str, object], list[str]] = defaultdict(list)
    for t, used in levels.heard():
        rows = np.column_stack([levels.position[used], levels.level_db[used]])
        alike["differ by capitals alone", levels.names[t].casefold()].append(levels.names[t])
        if len(np.unique(levels.level_db[used])) >= LEAST:
            content = rows[np.lexsort(rows.T)].tobytes()
            alike["hold the same levels at the same places", content].append(levels.names[t])
    named = [(how, names) for (how, _), names in alike.items() if len(names) > 1]
    return [
        f"stations {list_first(names)} {how}: one, under several names?" for how, names in named
    ]


def outlier_row_warnings(levels: LinkLevels) -> list[str]:
    """Warn of single rows whose level is far from those before and after them
    at the same station.
    """
    warnings = []
    for t, bad, most in find_outlier_rows(levels):
        where = f"station {levels.names[t]}: " if len(levels.names) > 1 else ""
        rows = list_first([levels.rows[i] for i in bad])
        warnings.append(f"{where}{rows}: up to {most:.0f} dB from the rows around; wrong?")
    return warnings


def find_outlier_rows(levels: LinkLevels) -> list[tuple[int, np.ndarray, float]]:
    """Return (station, rows (k,), largest difference [dB]) of rows far from those around them."""
    outliers = []
    for t, used in levels.heard():
        if len(used) < 4 * NEIGHBOURS:
            continue
        used = used if levels.ordered else used[np.argsort(along_curve(levels.position[used]))]
        level = levels.level_db[used]
        difference = np.abs(level - median_filter(level, 2 * NEIGHBOURS + 1, mode="mirror"))
        wild = difference > max(OUTLIER_DB, SPREADS * 1.4826 * float(np.median(difference)))
        # A single row: where the neighbour differs as much it is a place, not a fault.
        bad = np.flatnonzero(wild & ~np.roll(wild, 1) & ~np.roll(wild, -1))
        if 0 < len(bad) <= max(NAMED, len(used) // 100):
            outliers.append((t, used[bad], float(difference[bad].max())))
    return outliers


def step_warnings(levels: LinkLevels, steps: Sequence[tuple[int, LevelStep]]) -> list[str]:
    """Warn of stations whose level changes at a row, unexplained by places (`level_steps`)."""
    names, rows, warnings = levels.names, levels.rows, []
    for t in dict.fromkeys(t for t, _ in steps):
        who = f"station {names[t]}" if len(names) > 1 else "the level"
        station_steps = [step for station, step in steps if station == t]
        change = " and ".join(
            f"{'rises' if step.change_db > 0 else 'falls'} by {abs(step.change_db):.0f} dB between "
            f"{rows[step.last]} and {rows[step.first]}"
            for step in station_steps
        )
        first = ",".join(str(levels.file_row[step.first]) for step in station_steps)
        setting = (
            f"'dataset.level_steps={{{levels.keys[t]}:[{first}]}}' (rows from 0) makes it another"
        )
        setting = "" if names[t] == UNNAMED else f" {setting} station from there on"
        warnings.append(
            f"{who} {change}, which the places do not explain: another gain or antenna?{setting}"
        )
    return warnings


def find_level_steps(levels: LinkLevels) -> list[tuple[int, LevelStep]]:
    """Return stations and their steps, which name rows of `levels`."""
    if not levels.ordered:
        return []
    steps = []
    blocks = int(
        np.clip(20 * MOST_BLOCKS / max(len(np.unique(levels.station)), 1), 200, MOST_BLOCKS)
    )
    for t, used in rows_by(levels.station):
        where = levels.station_position[t]
        where = where if np.isfinite(where).all() else None
        device = None if levels.device is None else levels.device[used]
        rows = levels.position[used], levels.level_db[used]
        for step in detect_level_steps(*rows, where, blocks, device):
            steps.append((t, replace(step, last=int(used[step.last]), first=int(used[step.first]))))
    return steps


def gap_warnings(levels: LinkLevels) -> list[str]:
    """Warn of missing levels: long runs of rows in an order (a station was off), scattered ones."""
    names, rows, warnings = levels.names, levels.rows, list[str]()
    # By first row, last row, length
    outages: dict[tuple[str, str, int], list[str]] = defaultdict(list)
    silent, plain = list[str](), dict[str, int]()  # how many, by station
    for t, used in rows_by(levels.station):
        missing = ~np.isfinite(levels.level_db[used])
        if missing.all():
            silent.append(names[t])
            continue
        absent, count = np.flatnonzero(missing), int(missing.sum())
        pieces = np.split(absent, np.flatnonzero(np.diff(absent) > 1) + 1)
        for piece in pieces if levels.ordered else ():
            if len(piece) >= LONG_GAP:
                outages[rows[used[piece[0]]], rows[used[piece[-1]]], len(piece)].append(names[t])
                count -= len(piece)
        plain |= {names[t]: count} if count else {}
    for (first, last, length), who in sorted(outages.items(), key=lambda item: -item[0][2]):
        where = f"no level in the {length} rows from {first} to {last}{_of(who, len(names))}"
        warnings.append(f"{where}: off, not listed or not heard; these rows are not used")
    if silent:
        warnings.append(f"no level in any row{_of(silent, len(names))}")
    if plain:
        text = f"{sum(plain.values())} single levels missing{_of([*plain], len(names))}"
        warnings.append(f"{text}: lost, not listed or not measured; they are not used")
    return warnings


def _of(who: list[str], total: int) -> str:
    return "" if total == 1 else f" of station{'s' * (len(who) > 1)} {list_first(who)}"
