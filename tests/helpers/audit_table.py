"""Simulated audits: a claimed share of .95, tours of 20, at most 1,500 places.

Strata of an area: its share, whether the model marks it, whether it fails, whether a car gets
there. What is drawn in a tour has no order here: verdicts are read at its end alone.
"""

import numpy as np

from gsparc.apps.maps.audit import Demand, doubt_part
from gsparc.processes.betting import claim_capital, verdict_of

CLAIM, TOUR, MOST, FLOOR = 0.95, 20, 1500, 0.1


def area(true, marked=0.2, recall=None, corner=0.0, corner_fails=False):
    """Strata (k, 4): share, doubt over its mean, fails, reached; the model marks a part of the
    area with a share `recall` of what fails; None: it marks nothing.
    """
    bad, rows = 1 - true, []
    if corner:
        inner = bad - corner * corner_fails
        rows = [(corner, 1.0, corner_fails, 0), (inner, 1.0, 1, 1), (true, 1.0, 0, 1)]
        rows[2] = (1 - corner - inner, 1.0, 0, 1)
        return np.array(rows, float)
    if recall is None:
        return np.array([(bad, 1.0, 1, 1), (true, 1.0, 0, 1)], float)
    high = (1 - FLOOR) / marked + FLOOR
    parts = (bad * recall, high, 1, 1), (marked - bad * recall, high, 0, 1)
    return np.array(
        [*parts, (bad - bad * recall, FLOOR, 1, 1), (1 - marked - bad + bad * recall, FLOOR, 0, 1)]
    )


def audits(strata, count, seed=0, most=MOST):
    """Return verdicts (count,) and drawn places (count,) they took."""
    share, doubt, fails, reached = strata.T
    verdicts, taken, marks = [], [], np.ptp(doubt) > 0
    for number in range(count):
        random = np.random.default_rng([seed, number])
        low, high, weight, top = (np.zeros(most) for _ in range(4))
        ratio, word = np.ones(most), "open"
        # Without doubts parts are none, and all tours are drawn at once
        size = TOUR if marks else most
        for start in range(0, most, size):
            part = 0.0
            rows = slice(start, start + size)
            if marks:
                before = weight[:start], 1 - high[:start], ratio[:start]
                part = doubt_part(*before, np.repeat(doubt, (1000 * share).round().astype(int)))
            chance = share * (1 - part + part * doubt)
            drawn = random.choice(len(share), size, p=chance / chance.sum())
            ratio[rows], top[rows] = doubt[drawn], 1 / (1 - part)
            weight[rows] = 1 / (1 - part + part * doubt[drawn])
            holds = 1 - fails[drawn]
            low[rows] = np.where(reached[drawn] > 0, holds, 0.0)
            high[rows] = np.where(reached[drawn] > 0, holds, 1.0)
            upto = slice(0, start + size)
            ends = np.arange(TOUR, start + size + 1, TOUR)
            capital = claim_capital(low[upto], high[upto], (CLAIM, 1.0), weight[upto], top[upto])
            word, rows_taken = verdict_of(*capital, ends)
            if word != "open":
                break
        verdicts.append(word)
        taken.append(rows_taken if word != "open" else most)
    return np.array(verdicts), np.array(taken)


def levels(bias, within, count, seed=0, most=400):
    """The same of a claim of levels, of a deviation of 9 dB about a bias [dB]."""
    random, demand = np.random.default_rng(seed), Demand(None, within_db=within)
    level = -random.normal(bias, 9.0, (count, most))
    value = demand.bounds(np.zeros_like(level), level, np.zeros_like(level))[0]
    ends = np.arange(TOUR, most + 1, TOUR)
    pairs = zip(*claim_capital(value, value, demand.ends), strict=True)
    words, rows = zip(*(verdict_of(*pair, ends) for pair in pairs), strict=True)
    return np.array(words), np.array(rows)
