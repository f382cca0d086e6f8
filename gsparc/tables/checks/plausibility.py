"""Warnings about readable measurements: units of places and levels, wild rows, fixes that stood
still.

Pure functions of arrays; each returns lines for a person, none where nothing looks wrong. Rows are
links, what one station measured at one place, in the order of measuring; levels are in dB or dBm,
NaN for no value.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.base.errors import Severe, list_first
from gsparc.data.outliers import find_gap
from gsparc.data.row_order import morton_codes
from gsparc.data.schema import Measurements
from gsparc.processes.level_field import fit_level_field
from gsparc.tables.checks.level_steps import LevelStep, LinkLevels, step_warnings
from gsparc.tables.checks.piles import APART_DB, REPEATS

# Places where a site was heard, that tell; those, and sites, looked at
LEAST, MOST, SITES = 20, 100, 100
CLEAR = math.log(1e12)  # ratio of likelihoods: shadowing is not Gaussian
LIKELY = math.log(30)  # that a site's levels speak against a shift of all, at most
FEW = 3  # sites at places of others: of two a hill may be the reason
# A tenth of a site's levels lies about it, its beams ahead of it
STRONG, SHARES = 10, (1, 0.75, 0.5)
SLOPES = -60.0, -10.0  # of levels over the logarithm of the distance [dB]


def misplaced_warnings(levels: LinkLevels) -> list[str]:
    """Warn of sites whose levels tell other places: each other's, or shifted ones.

    Of the sectors of a site the strongest counts, so that no beam makes up for a distance.
    """
    where, first, site = np.unique(
        levels.station_position, axis=0, return_index=True, return_inverse=True
    )
    site, finite = site.reshape(-1)[levels.station], np.isfinite(where).all(axis=1)
    heard = dict[int, np.ndarray]()
    for number in np.flatnonzero(finite)[:SITES].tolist():
        rows = np.flatnonzero((site == number) & np.isfinite(levels.level_db))
        rows = rows[np.argsort(-levels.level_db[rows], kind="stable")]
        rows = rows[np.sort(np.unique(levels.position[rows], axis=0, return_index=True)[1])]
        heard |= {number: rows} if len(rows) >= LEAST else {}
    strong = [levels.position[rows[: len(rows) // STRONG]].mean(axis=0) for rows in heard.values()]
    shift = np.median(strong - where[[*heard]], axis=0) * [1, 1, 0] if heard else np.zeros(3)
    shifts = shift * np.array(SHARES)[:, None]
    gains, shifted = np.full((len(where),) * 2, -np.inf), np.zeros(len(SHARES))
    names, warnings = [levels.names[t] for t in first], list[str]()
    for number, rows in heard.items():
        some = np.random.default_rng(0).permutation(rows)[:MOST]
        places = np.vstack([where[number], where[number] + shifts, where[finite]])
        gain = _gains(levels.position[some], levels.level_db[some], places)
        shifted += np.maximum(gain[: len(SHARES)], -LIKELY)
        # Each that is tried may fit by chance.
        gains[number, finite] = gain[len(SHARES) :] - math.log(len(where))
    gains[np.diag_indices(len(where))] = 0
    stated, likely = linear_sum_assignment(gains, maximize=True)
    moved = np.flatnonzero(stated != likely)
    exchanged = gains[stated, likely].sum()
    if shifted.max() > max(CLEAR, exchanged) and len(heard) >= FEW:
        x, y, _ = shifts[shifted.argmax()]
        finding = f"fall with distance from places ({x:+.0f}, {y:+.0f}) m beside the stated ones"
        warnings.append(
            f"levels of all {len(heard)} sites {finding}: is their list about another origin?"
        )
    elif len(moved) >= FEW and exchanged > CLEAR:
        pairs = list_first([f"{names[i]} from that of {names[likely[i]]}" for i in moved])
        finding = f"levels fall with distance from places of other stations, {pairs}"
        warnings.append(f"{finding}: are names or places exchanged?")
    return warnings


def _gains(place: np.ndarray, level: np.ndarray, rivals: np.ndarray) -> np.ndarray:
    """Logarithms of likelihoods (k,) of levels (n,) by distances from rivals (k + 1, 3),
    less the first's.

    Beside one field for all, which fits best with the first or the likeliest of the others.
    """
    nearest = max(float(np.ptp(place[:, :2], axis=0).max()), 1.0) / 300
    away = np.log10(np.maximum(cdist(place, rivals), nearest))
    with np.errstate(divide="ignore", invalid="ignore"):  # of levels that are all alike
        likeliest = 1 + int(np.nan_to_num(np.corrcoef(level, away[:, 1:].T)[0, 1:]).argmin())
        fields = [
            fit_level_field(place, level, np.zeros(len(level)), [away[:, k]])
            for k in (0, likeliest)
        ]
        precision = max(fields, key=lambda one: one.score).precision(place)
        table = np.column_stack([level, away])
        table -= precision.sum(axis=0) @ table / precision.sum()
        gram = table.T @ precision @ table
        slope = gram[0, 1:] / gram.diagonal()[1:]
        rest = gram[0, 0] - slope * gram[0, 1:]
        gain = 0.5 * len(level) * np.log(rest[0] / rest[1:])
    possible = (SLOPES[0] < slope[1:]) & (slope[1:] < SLOPES[1]) & np.isfinite(gain)
    return np.where(possible, gain, -np.inf)


FEW_APART = 0.02  # share of rows far from the nearest
NAMED = 5  # wild rows that a station may have, however few its rows
HIGHEST_DBM, LOWEST_DBM = 60.0, -174.0  # a kilowatt received; thermal noise in a hertz
NARROW_DB = 1.0  # between all levels of a site there is more
OUTLIER_DB = 25.0  # from the rows before and after: more than fading does between neighbours
SPREADS = 10.0  # scaled median absolute deviations of that difference
NEIGHBOURS = 5  # rows on each side
LONG_STAY = 20  # rows at one place, in one piece
# Between levels of one place, at least: fading of who stands still is faster than it is deep
STILL_DB = 10.0


def sanity_warnings(levels: LinkLevels, steps: Sequence[tuple[int, LevelStep]]) -> list[str]:
    """Return all warnings about levels at places.

    Args:
        levels: of powers.
        steps: `find_level_steps` them.
    """
    severe = map(
        Severe,
        [
            *level_warnings(levels.level_db),
            *two_unit_warnings(levels),
            *misplaced_warnings(levels),
        ],
    )
    still, wild = still_warnings(levels), outlier_row_warnings(levels)
    return [*severe, *still, *wild, *step_warnings(levels, steps)]


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
    """Warn of levels (n,) [dB] that may be linear, percent, indices or parts of decibels."""
    values = level_db[np.isfinite(level_db)]
    if not len(values):
        return []
    low, high = float(values.min()), float(values.max())
    whole = (np.abs(values - values.round()) < 1e-3).all()  # powers in single precision
    positive = 0 <= low < high and (high <= 1 or high > HIGHEST_DBM or whole)
    losses = "losses (store minus them; dataset.columns.rssi_db=HEAD*-1)"
    doubts = {
        f"no level of {low:g} to {high:g} is below 0: {losses}, per cent, an index, or linear "
        "(give it as rssi, in W)?": positive,
        f"levels of {low:.4g} to {high:.4g}, most below thermal noise of a hertz: in decibels?": (
            np.median(values) < LOWEST_DBM
        ),
        f"levels differ by {high - low:.2g} dB in all: linear, parts of a decibel, or another "
        "column?": (len(values) > 1 and high - low < NARROW_DB),
    }
    return [text for text, holds in doubts.items() if holds][:1]


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


def still_warnings(levels: LinkLevels) -> list[str]:
    """Warn of a place that many rows in a piece share while levels change as on a way:
    a fix stood still.

    Where nothing moves, levels differ from row to row as much as they do
    in all (J. von Neumann, 1941).
    """
    still: dict[tuple[str, str, int], dict[str, float]] = defaultdict(dict)
    for t, used in levels.heard() if levels.ordered else ():
        moves = np.flatnonzero(np.diff(levels.position[used], axis=0).any(axis=1)) + 1
        for piece in np.split(used, moves):
            level = levels.level_db[piece]
            if (
                len(piece) >= LONG_STAY
                and np.ptp(level) > STILL_DB
                and np.diff(level).var() < level.var() / 2
            ):
                where = levels.rows[piece[0]], levels.rows[piece[-1]], len(piece)
                still[where][levels.names[t]] = float(np.ptp(level))
    return [
        f"{first} to {last}: one place for {count} rows, while levels change by "
        f"{max(who.values()):.0f} dB"
        f"{_of([*who], len(levels.names))}: did the fix stand still? take them out"
        for (first, last, count), who in still.items()
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
        used = used if levels.ordered else used[np.argsort(morton_codes(levels.position[used]))]
        level = levels.level_db[used]
        difference = np.abs(level - median_filter(level, 2 * NEIGHBOURS + 1, mode="mirror"))
        wild = difference > max(OUTLIER_DB, SPREADS * 1.4826 * float(np.median(difference)))
        # A single row: where the neighbour differs as much it is a place, not a fault.
        bad = np.flatnonzero(wild & ~np.roll(wild, 1) & ~np.roll(wild, -1))
        if 0 < len(bad) <= max(NAMED, len(used) // 100):
            outliers.append((t, used[bad], float(difference[bad].max())))
    return outliers


def _of(who: list[str], total: int) -> str:
    return "" if total == 1 else f" of station{'s' * (len(who) > 1)} {list_first(who)}"


LONG_ARRAY = 100  # wavelengths: no array of one receiver
ROUNDED = 0.02  # of a circle
TINY_DEGREES = 1.0  # a campaign's extent in degrees
# Heights 100 m apart, or a width of 10 km, are rarer than wrong units, as is a box of a centimetre
HIGHEST, WIDEST, NARROWEST = 100.0, 1e4, 0.01


def unit_warnings(data: Measurements) -> list[str]:
    """Warn of readable but implausible places, arrays and grids. Places are those of both ends,
    else of the one that moves, as a static end elsewhere widens the box.
    """
    site = data.site
    if not np.ptp(data.moving, axis=0).any():
        hints = ["all positions are the same, a box of 0 m: is it the moving end's column?"]
    elif site.georeference is not None:  # degrees became metres: no unit to mistake
        hints = _group_hints(data.moving)
    else:
        ends = np.concatenate([data.tx, data.rx_position]) + site.origin
        places = ends[np.isfinite(ends).all(axis=1)], data.moving[:, :3] + site.origin
        hints = next(filter(None, map(_position_hints, places)), [])
    reach = 0.0 if site.array is None else float(np.ptp(site.array, axis=0).max())
    if reach > LONG_ARRAY * (site.wavelength or np.inf):
        hints = [*hints, f"the antennas reach over {reach:.4g} m: in mm?"]
    turn = 0.0 if site.grid is None else site.grid.azimuth_step * site.grid.width
    # Steps in radians taken for degrees: the columns then span 2 pi degrees.
    if abs(np.degrees(turn) / (2 * np.pi) - 1) < ROUNDED:
        hints = [*hints, "the columns span a full circle in radians; convert grid_deg"]
    return hints


def _position_hints(positions: np.ndarray) -> list[str]:
    """Warnings that positions (n, 3), in the world, may not be metres."""
    extent, middle = np.ptp(positions, axis=0), np.abs(np.median(positions[:, :2], axis=0))
    width, across = float(extent.max()), float(extent[:2].max())
    reach = np.abs(positions[:, :2]).max(axis=0)
    on_earth = reach.max() <= 180 and reach.min() <= 90
    # Metres about a local origin lie near it; degrees of a small site lie many of its widths away.
    if on_earth and across < TINY_DEGREES and middle.min() > 5 * across and middle.max() > 10:
        near = f"({positions[0, 0]:.6g}, {positions[0, 1]:.6g})"
        how = "then give them as latitude and longitude (columns of a table: "
        how += "dataset.columns.lat=HEAD, .lon)"
        return [f"positions near {near} within {across:.2g}: degrees? {how}"]
    if groups := _group_hints(positions):
        return groups
    # Survey tools print millimetres as whole numbers; metres come with decimals.
    printed = across > WIDEST / 10 and bool((positions % 1 == 0).all())
    if not (extent[2] > HIGHEST or width > WIDEST or printed or width < NARROWEST):
        return []
    size = " x ".join(f"{side:.4g}" for side in extent)
    units = "kilometres" if width < NARROWEST else "millimetres, centimetres or feet"
    return [f"places fill a box of {size}: in {units}? convert them to metres"]


def _group_hints(positions: np.ndarray) -> list[str]:
    """A warning of two groups of positions (n, 3) far apart."""
    causes = "lost digits, latitude and longitude exchanged in some rows, zones of a projection "
    causes += "(give degrees), or two sites (a file for each)?"
    groups = find_gap(positions[:, :2])
    return (
        [] if groups is None else [f"two groups of places {groups[1] / 1e3:.4g} km apart: {causes}"]
    )
