"""Audits of maps of real levels: places are known, so is the share that holds.

python tests/helpers/audit_real.py FOLDER [audits]: FOLDER holds cbrs/mast1.csv and
real/powder-rss-462mhz.npz. A claim is the mean of the four nearest rows of one half of the places,
some decibels higher; the other half is what is drawn from. Logs are 100 rows as they were walked.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from scipy.special import ndtr

from gsparc.apps.maps.area import lay_grid
from gsparc.apps.maps.audit import SPREAD_DB, DriveRows, Question, doubt_part, draw_tours, judge
from gsparc.apps.maps.claim import Claim, ClaimErrors
from gsparc.datasets.own import read_any
from gsparc.prediction.levels import measured_levels

SIDE, TOURS, TOUR, LOG = 5.0, 15, 20, 100


def squares(place, level):
    """Places and mean levels of squares of 5 m, in the order of the first row."""
    _, first, number = np.unique(
        np.floor(place / SIDE), axis=0, return_index=True, return_inverse=True
    )
    number = number.reshape(-1)
    means = [np.bincount(number, column) / np.bincount(number) for column in (*place.T, level)]
    order = np.argsort(first)
    return np.column_stack(means[:2])[order], means[2][order]


def claims(place, level, high_db):
    """A claim of half of the places, `high_db` too high, and their true levels; threshold."""
    ours = np.random.default_rng(0).random(len(place)) < 0.5
    near = cKDTree(place[ours]).query(place[~ours], 4)[1]
    claimed, threshold = level[ours][near].mean(1) + high_db, float(np.quantile(level, 0.3))
    served = claimed >= threshold
    at = place[~ours][served]
    grid = lay_grid(None, [*(at.min(0) - SIDE), *(at.max(0) + SIDE)], step_m=SIDE)
    return Claim(at, claimed[served], grid, ""), level[~ours][served], threshold


def audit(claim, true, question, seed):
    """Return the verdict and how many places it took."""
    chance = ndtr(-(claim.level - question.threshold_db) / SPREAD_DB)
    ratio, none = chance / chance.mean(), np.zeros(len(true), int)
    rows = DriveRows(claim.place, true, none, none)
    draws, table, word, count = None, None, "open", 0
    for tour in range(1, TOURS + 1):
        before = (np.zeros(0),) * 3
        if table is not None:
            before = (a.to_numpy() for a in (table.weight, 1 - table.high, table.ratio))
        part = doubt_part(*before, ratio)
        new, _ = draw_tours(claim, "", ratio, part, (tour,), TOUR, seed)
        draws = new if draws is None else pd.concat([draws, new], ignore_index=True)
        word, count, table = judge(claim, draws, rows, question, 0.1)
        if word != "open":
            break
    return word, count


def covered(claim, true, threshold, logs):
    """Share of intervals of a model of logs that hold the true share, and their mean width."""
    margin, starts = claim.level - threshold, np.linspace(0, len(true) - LOG, logs).astype(int)
    ends = []
    for start in starts:
        rows = slice(start, start + LOG)
        errors = ClaimErrors.from_rows(claim.place[rows], claim.level[rows] - true[rows])
        ends.append(errors.share(claim.place, margin)[1:])
    low, high = np.array(ends).T
    share = (true >= threshold).mean()
    return ((low <= share) & (share <= high)).mean(), (high - low).mean()


def sites(folder):
    for file, wanted in (("cbrs/mast1.csv", "CD"), ("real/powder-rss-462mhz.npz", None)):
        data = read_any(folder / file).data
        level, _ = measured_levels(data, np.arange(len(data)))
        station, names = data.stations_of(), data.site.every_station.shown
        for number in [k for k, name in enumerate(names) if wanted is None or name in wanted][:3]:
            own = (station == number) & np.isfinite(level)
            yield names[number], *squares(data.moving[own, -3:-1], level[own])


def main(folder, count):
    for name, place, level in sites(folder):
        for high_db in (0.0, 8.0):
            claim, true, threshold = claims(place, level, high_db)
            share = float((true >= threshold).mean())
            line = (
                f"{name[:18]:18s} {high_db:2.0f} dB too high, {len(true):5d} places, {share:.3f}:"
            )
            for asked in (0.95, round(share, 3)):
                question = Question(threshold, asked)
                told = [audit(claim, true, question, seed) for seed in range(count)]
                words = [word for word, _ in told]
                shares = ", ".join(f"{w} {words.count(w) / count:.0%}" for w in ("stands", "falls"))
                line += f" of {asked} {shares}, {np.median([n for _, n in told]):.0f};"
            held, wide = covered(claim, true, threshold, 20)
            sys.stdout.write(f"{line} logs hold {held:.0%}, wide {wide:.2f}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 50)
