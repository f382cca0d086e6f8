"""A threshold with a promise: at most a share alpha of accepted positions is bad, with confidence 1 - delta.

Learn then Test (Angelopoulos, Bates, Candes, Jordan and Lei 2021) with fixed-sequence testing: thresholds are
tried from strict to lax, each is a binomial test on the calibration positions it accepts, and the first that
fails ends the search. Given who is accepted the bad ones are binomial, so the promise is about the error
*among accepted positions*; plain split conformal promises a share of all positions instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betainc
from scipy.stats import beta, chi2

LEVELS = 50
SURE_OF_EFFECT = 0.8


@dataclass(frozen=True)
class Guarantee:
    """What is promised.

    Attributes:
        limit_db: a prediction is bad when |e|^2 / |h|^2 exceeds this [dB].
        alpha: largest share of bad ones among the accepted.
        delta: probability that a calibration set misleads.
    """

    limit_db: float = -10.0
    alpha: float = 0.1
    delta: float = 0.1

    def __post_init__(self) -> None:
        if not (0 < self.alpha < 1 and 0 < self.delta < 1):
            raise ValueError(f"promise: alpha={self.alpha} and delta={self.delta} must lie between 0 and 1")

    @property
    def least(self) -> int:
        """Positions that must be accepted, all of them good, before anything can be promised."""
        return int(np.ceil(np.log(self.delta) / np.log1p(-self.alpha)))

    def bad(self, relative_error: np.ndarray) -> np.ndarray:
        """Whether predictions (n,) are bad."""
        return relative_error > 10 ** (self.limit_db / 10)


@dataclass(frozen=True)
class Threshold:
    """A threshold and what it was chosen on.

    Attributes:
        value: accept scores of at least this; infinite when nothing can be promised.
        accepted: calibration positions it accepts.
        bad: how many of them are bad.
    """

    value: float
    accepted: int
    bad: int

    def bound(self, delta: float) -> float:
        """Upper confidence bound on the share of bad ones among the accepted (Clopper and Pearson 1934)."""
        return binomial_interval(self.bad, self.accepted, 1 - 2 * delta)[1]


def binomial_interval(errors: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Clopper and Pearson's interval (1934) of a rate."""
    if count == 0:
        return 0.0, 1.0
    tail = (1 - level) / 2
    low = 0.0 if errors == 0 else float(beta.ppf(tail, errors, count - errors + 1))
    high = 1.0 if errors == count else float(beta.ppf(1 - tail, errors + 1, count - errors))
    return low, high


def levels_of(score: np.ndarray, count: int = LEVELS) -> np.ndarray:
    """Thresholds (at most `count`,) to try, strict to lax: quantiles of scores (n,) not the calibration's."""
    return np.unique(np.quantile(score, np.linspace(0, 1, count)))[::-1]


def choose(
    score: np.ndarray,
    bad: np.ndarray,
    levels: np.ndarray,
    promise: Guarantee,
    group: np.ndarray | None = None,
) -> Threshold:
    """The laxest threshold that the calibration set (n,) supports.

    Where neighbours err together, `group` (n,) names the patch each position belongs to: counts are divided
    by the design effect, how much more the share varies between patches than binomial counts would (Kish
    1965; approximate, where the test without groups is exact). A level too strict to be tested (no outcome
    could reject: fewer than log delta / log(1 - alpha) accepted) is passed over, and spends nothing.
    """
    threshold = Threshold(float("inf"), 0, 0)
    for level in levels:
        rows = score >= level
        accepted, wrong = int(rows.sum()), int(bad[rows].sum())
        if accepted < promise.least:
            continue
        effect = 1.0 if group is None else design_effect(bad[rows], group[rows])
        if _tail(wrong / effect, accepted / effect, promise.alpha) > promise.delta:
            break
        threshold = Threshold(float(level), accepted, wrong)
    return threshold


def design_effect(bad: np.ndarray, group: np.ndarray) -> float:
    """Variance of the share of bad ones (n,) between groups (n,) over that of independent draws; at least 1.

    A variance between few groups is itself uncertain: what is returned is its one-sided bound at
    `SURE_OF_EFFECT`, as of a normal variance.
    """
    _, which = np.unique(group, return_inverse=True)
    counts, wrong = np.bincount(which), np.bincount(which, bad)
    share, groups = wrong.sum() / counts.sum(), len(counts)
    if groups < 2 or share in (0.0, 1.0):
        return 1.0
    between = groups / (groups - 1) * ((wrong - share * counts) ** 2).sum() / counts.sum()
    bound = (groups - 1) / chi2.ppf(1 - SURE_OF_EFFECT, groups - 1)
    return max(1.0, float(bound * between / (share * (1 - share))))


def _tail(wrong: float, accepted: float, alpha: float) -> float:
    """P(at most `wrong` of `accepted` are bad) when a share alpha is, for counts that need not be whole."""
    return float(betainc(max(accepted - wrong, 1e-9), wrong + 1, 1 - alpha))


def spread_out(
    positions: np.ndarray, rows: np.ndarray, apart_m: float, rng: np.random.Generator
) -> np.ndarray:
    """Some of `rows`, no two within `apart_m` [m]: neighbours err together and count as one."""
    if apart_m <= 0:
        return rows
    chosen: list[int] = []
    order = rng.permutation(rows)
    near = cKDTree(positions[order]).query_ball_point(positions[order], apart_m)
    gone = np.zeros(len(order), bool)
    for i, others in enumerate(near):
        if not gone[i]:
            chosen.append(int(order[i]))
            gone[others] = True
    return np.sort(np.array(chosen, dtype=np.int64))
