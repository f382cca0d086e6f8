"""How sure a claim about a mean is, while values arrive: capital of bets against it.

Whoever bets against a true claim gains a factor of 20 once in 20 times at most, whenever he looks
(I. Waudby-Smith and A. Ramdas, J. Roy. Stat. Soc. B 86 (2024); diversified bets of their section
5): nothing is assumed but that values are bounded, and drawn.
"""

from __future__ import annotations

import numpy as np
from scipy.special import betaincinv

ENOUGH = 20.0  # capital that settles a claim, from 1: wrong in 5 % of claims at most, each way
MOST_LOG = 600.0  # of a capital, below what overflows
# Parts of the largest bet that cannot ruin, near the best against shares of .92 to .7 and for 1
BETS = np.array([0.04, 0.1, 0.25, 0.5, 0.75, 0.95])


def betting_capital(
    value: np.ndarray,
    mean: float,
    weight: np.ndarray | float = 1.0,
    most: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the capital (..., n) after each value of bets that their mean is above `mean`.

    The capital is shared among `BETS`, so that no bet need be chosen; of values that are exchanged
    it ends the same.

    >>> betting_capital(np.ones(120), 0.95)[[59, 119]].round(1)
    array([ 6.4, 80.6])

    Args:
        value: (..., n) within 0 to 1.
        mean: within 0 to 1, both excluded.
        weight: (..., n) of values that were not drawn evenly: the even chance of a place over that
            which it was drawn with.
        most: (..., n) largest weight that the draw could have given.
    """
    gain = weight * (value - mean) / (most * mean)
    logs = np.log1p(BETS.reshape(-1, *[1] * np.ndim(gain)) * gain)
    return np.asarray(np.exp(np.cumsum(logs, axis=-1).clip(max=MOST_LOG)).mean(0))


def claim_capital(
    low: np.ndarray,
    high: np.ndarray,
    claim: tuple[float, float],
    weight: np.ndarray | float = 1.0,
    most: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the capitals (..., n) of who bets for and of who bets against a claim about a mean.

    A value of which bounds alone are known counts against both.

    Args:
        low, high: (..., n) bounds of values within 0 to 1, equal where they are known.
        claim: ends between which the mean is said to lie; 0 and 1 say nothing.
        weight, most: see `betting_capital`.
    """
    stands, falls = [], []
    if claim[0] > 0:
        stands.append(betting_capital(low, claim[0], weight, most))
        falls.append(betting_capital(1 - high, 1 - claim[0], weight, most))
    if claim[1] < 1:
        stands.append(betting_capital(1 - high, 1 - claim[1], weight, most))
        falls.append(betting_capital(low, claim[1], weight, most))
    return np.min(stands, axis=0), np.mean(falls, axis=0)


def verdict_of(stands: np.ndarray, falls: np.ndarray, ends: np.ndarray) -> tuple[str, int]:
    """Return `stands`, `falls` or `open`, and the number of rows that it took.

    Args:
        stands, falls: (n,) capitals.
        ends: (T,) rows at the end of each tour, where alone they are read: on its way a tour is in
            a corner.
    """
    for count in ends:
        for word, capital in (("stands", stands), ("falls", falls)):
            if capital[count - 1] >= ENOUGH:
                return word, int(count)
    return "open", int(ends[-1]) if len(ends) else 0


def detectable_shares(count: int, share: float, chance: float = 0.9) -> tuple[float, float]:
    """Return the share below which a claimed share falls with a chance after so many even rows,
    and the one above which it stands; NaN where none does.

    >>> [round(end, 2) for end in detectable_shares(60, 0.95, 0.8)]
    [0.8, nan]
    """
    value = np.arange(count) >= np.arange(count + 1)[:, None]  # so many fail
    stands, falls = (
        end[:, -1] >= ENOUGH for end in claim_capital(value * 1.0, value * 1.0, (share, 1.0))
    )
    least, most = count + 1 - int(falls.sum()), int(stands.sum()) - 1
    below = 1 - betaincinv(least, count - least + 1, chance) if falls.any() else np.nan
    above = 1 - betaincinv(most + 1, count - most, 1 - chance) if stands.any() else np.nan
    return float(below), float(above)
