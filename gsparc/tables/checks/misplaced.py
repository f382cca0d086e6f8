"""Sites whose levels fall with distance from another place than the one that is stated."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from gsparc.base.errors import list_first
from gsparc.processes.level_field import fit_level_field
from gsparc.tables.checks.link_levels import LinkLevels

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
