"""Sites whose levels fall with distance from another place than the one that is stated."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from gsparc.data.checks.link_levels import LinkLevels
from gsparc.data.errors import list_first
from gsparc.processes.level_field import fit_level_field

LEAST, MOST, SITES = 20, 100, 100  # places where a site was heard, that tell; those, and sites, looked at
CLEAR = math.log(1e12)  # ratio of likelihoods: shadowing is not Gaussian
LIKELY = math.log(30)  # the same of kilometres: few sites stand within a thousandth of the reach of 0, 0
FEW = 3  # sites at places of others: of two a hill may be the reason
SLOPES = -60.0, -10.0  # of levels over the logarithm of the distance [dB]
NO = -1e6  # the logarithm of a likelihood, of what cannot be


def misplaced_warnings(levels: LinkLevels) -> list[str]:
    """Warn of sites whose levels tell other places: each other's, or their own in kilometres.

    Of the sectors of a site the strongest counts, so that no beam makes up for a distance.
    """
    if levels.station_position is None:
        return []
    where, site = np.unique(levels.station_position, axis=0, return_inverse=True)
    known = np.isfinite(where).all(axis=1)
    gains, own = np.full((len(where),) * 2, NO), np.zeros(len(where))
    for one in np.flatnonzero(known)[:SITES]:
        rows = np.flatnonzero((site.reshape(-1)[levels.station] == one) & np.isfinite(levels.level_db))
        rows = rows[np.argsort(-levels.level_db[rows], kind="stable")]
        rows = rows[np.unique(levels.position[rows], axis=0, return_index=True)[1]]
        if len(rows) >= LEAST:
            some = np.random.default_rng(0).permutation(rows)[:MOST]
            rivals = np.concatenate([where[known], where[one : one + 1] * [1e3, 1e3, 1]])
            gain = _gains(levels.position[some], levels.level_db[some], where[one], rivals)
            # Each that is tried may fit by chance.
            gains[one, known], own[one] = gain[:-1] - math.log(len(where)), gain[-1]
    gains[np.diag_indices(len(where))] = 0
    names = [levels.names[int((site.reshape(-1) == one).argmax())] for one in range(len(where))]
    fall, warnings = "fall with distance from", list[str]()
    if (own > LIKELY).any():
        who = list_first([names[one] for one in np.flatnonzero(own > LIKELY)])
        warnings.append(f"levels of {who} {fall} a place a thousand times as far: is it in kilometres?")
    first, second = linear_sum_assignment(gains, maximize=True)
    moved = np.flatnonzero(gains[first, second] != 0)
    if len(moved) >= FEW and gains[first, second].sum() > CLEAR:
        pairs = list_first([f"{names[one]} from that of {names[second[one]]}" for one in moved])
        warnings.append(f"levels {fall} places of other stations, {pairs}: are names or places exchanged?")
    return warnings


def _gains(place: np.ndarray, level: np.ndarray, stated: np.ndarray, rivals: np.ndarray) -> np.ndarray:
    """Logarithms of likelihoods (k,) of levels (n,) by distances from rivals (k, 3), less the stated place's.

    Beside one field for all, which fits best with the stated place or the likeliest rival.
    """
    nearest = max(float(np.ptp(place[:, :2], axis=0).max()), 1.0) / 300
    away = np.log10(np.maximum(cdist(place, np.vstack([stated, rivals])), nearest))
    with np.errstate(invalid="ignore"):  # of levels that are all alike
        likeliest = 1 + int(np.nan_to_num(np.corrcoef(level, away[:, 1:].T)[0, 1:]).argmin())
    fields = [fit_level_field(place, level, np.zeros(len(level)), [away[:, k]]) for k in (0, likeliest)]
    precision = max(fields, key=lambda one: one.score).precision(place)
    weight = precision.sum(axis=0) / precision.sum()
    table = np.column_stack([level, away])
    table -= weight @ table
    white = precision @ table
    with np.errstate(divide="ignore", invalid="ignore"):
        power = (table * white).sum(axis=0)
        slope = white[:, 0] @ table[:, 1:] / power[1:]
        rest = power[0] - slope**2 * power[1:]
        gain, slope = 0.5 * len(level) * np.log(rest[0] / rest[1:]), slope[1:]
    return np.where((SLOPES[0] < slope) & (slope < SLOPES[1]) & np.isfinite(gain), gain, NO)
