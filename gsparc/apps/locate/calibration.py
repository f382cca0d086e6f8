"""How far a field is trusted to say where, from snapshots that it did not learn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from gsparc.apps.locate.likelihood import Trust
from gsparc.apps.locate.search import Search

# Bounds of the search, within which `decode_trust` clips the simplex.
TEMPERATURES, TAILS, INFLATIONS = (1e-4, 1.0), (0.5, 100.0), (0.05, 50.0)
SPREADS, SPREAD = (1e-3, 1.0), 0.2  # of the edge of a coarse cell
LOOKS = 160  # trials
# Steps in logarithms, and of the mean log density, whose standard error is some .1, that end the search.
STEP, GAIN = 0.02, 0.002


def calibrate_trust(snapshots: Sequence[Search], places: np.ndarray, share: float, start: Trust) -> Trust:
    """Return the trust under which held-out places are most likely, with an area that holds a share.

    All numbers but the level maximise the mean log density at the true places, a proper score; the level is
    then the quantile of masses down to the truth that conformal prediction takes (V. Vovk et al.,
    "Algorithmic Learning in a Random World" (2005)): whatever the model's errors, areas of that level hold
    the share of places that are exchangeable with these.

    Args:
        snapshots: with their likelihoods over cells.
        places: (n, 3), where they were heard [m, local].
        share: of places, to be held.
        start: of the search.
    """
    edge = float(np.max([one.cells.edge.max() for one in snapshots]))
    spans = np.log([INFLATIONS, TEMPERATURES, TAILS, SPREADS]).T

    # In logarithms: all are positive and known up to factors.
    def decode_trust(point: np.ndarray) -> Trust:
        inflation, temperature, tail, spread = np.exp(np.clip(point, *spans)).tolist()
        return Trust(inflation, temperature, tail, edge * spread)

    def surprise(point: np.ndarray) -> float:
        trust, pairs = decode_trust(point), zip(snapshots, places, strict=True)
        return -float(np.mean([one.posterior(trust).log_density_at(place) for one, place in pairs]))

    first = np.log([start.inflation, start.temperature, start.tail, start.spread / edge or SPREAD])
    # First steps, in logarithms: 1 is a factor of 2.7; the temperature is first tried lower.
    simplex = first + np.vstack([np.zeros(4), np.diag([1.0, -1.5, 1.0, 1.0])])
    how = {"maxfev": LOOKS, "initial_simplex": simplex, "xatol": STEP, "fatol": GAIN}
    optimum = minimize(surprise, first, method="Nelder-Mead", options=how)
    return calibrate_level(decode_trust(optimum.x), snapshots, places, share)[0]


def calibrate_level(
    trust: Trust, snapshots: Sequence[Search], places: np.ndarray, share: float
) -> tuple[Trust, float]:
    """Return the trust with the level whose areas hold a share of places (n, 3) [m], and the worst misfit.

    And by how much a radius of these areas is wider, as a share of it, where the level is a standard error
    higher.
    """
    known = [one.posterior(trust) for one in snapshots]
    levels = np.sort([one.mass_above(place) for one, place in zip(known, places, strict=True)])
    # Of n exchangeable masses and one more the ceil((n + 1) share)-th: split conformal prediction.
    rank = int(np.ceil((len(levels) + 1) * share))
    # The number of masses below the share's quantile is binomial.
    higher = rank + int(np.ceil(np.sqrt(len(levels) * share * (1 - share))))
    # Too few snapshots for this share: nothing less than the whole site is sure to hold it.
    level, above = (float(levels[one - 1]) if one <= len(levels) else 1.0 for one in (rank, higher))
    ratio = np.median([one.area(above) / one.area(level) for one in known])
    trust = replace(trust, level=level, worst=max(one.least_misfit(trust) for one in snapshots))
    return trust, float(ratio ** (1 / max((snapshots[0].cells.edge.max(0) > 0).sum(), 1)) - 1)
