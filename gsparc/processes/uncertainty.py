"""How sure: errors of rows that nothing was learned from, and their groups -> an interval,
a threshold.

Rows of one group (a block of places, a station, a run) err together: by them a mean is known, and a
share held, no better than by as many groups. Formulas alone;
errors are gathered in `gsparc.prediction.left_out`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import bdtrik, betainc, betaincinv, chdtri, erf, log_expit, ndtri, stdtrit

# Thresholds that are tried: more of them resolve finer, but each one may end the search.
LEVELS = 50
# Odds of bad as powers of the rank, all equally likely before positions are seen:
# powers and log factors.
CURVES = np.array([0, 0.5, 1, 2, 4])[:, None, None], np.linspace(-6, 6, 25)[:, None]
NEARLY_BEST = 0.98  # of the best level's chance to pass: the laxest such level is tried first
SURE_OF_EFFECT = 0.8
COMPLETED = 100  # passes over censored rows
LEAST_RATIO = 1e-12  # of squared errors to variances: its logarithm is finite
ONE_DEVIATION = float(erf(0.5**0.5))  # share of a normal variable within a deviation of its mean


def half_width(share: float, degrees: float = np.inf) -> float:
    """Return how many deviations about the mean hold a share of a normal variable.

    Where the deviation is estimated from few values, with `degrees` of freedom,
    they are more (Student's t).

    >>> round(half_width(0.9), 3), round(half_width(0.9, 3), 3)
    (1.645, 2.353)
    """
    end = (1 + share) / 2
    return float(ndtri(end) if np.isinf(degrees) else stdtrit(degrees, end))


def standard_error(values: np.ndarray, group: np.ndarray | None = None) -> float:
    """Return the standard error of the mean of values (n,).

    Values of one group (n,) are not independent; without groups all are. Infinite of a single
    group, or value: then nothing tells how far to trust the mean.

    >>> standard_error(np.array([1.0, 3.0]))
    1.0
    """
    each = (
        np.arange(len(values))
        if group is None
        else np.unique(group, return_inverse=True)[1].reshape(-1)
    )
    sums = np.bincount(each, values - np.mean(values))
    if len(sums) < 2:
        return float("inf")
    return float(np.sqrt(len(sums) / (len(sums) - 1) * (sums**2).sum()) / len(values))


def variance_factor(ratios: np.ndarray) -> float:
    """Return what stated variances are to be multiplied by; of few rows, or unlike ones, nearer 1.

    Before any row is seen its logarithm is normal about 0 with a deviation of 1: to be wrong by a
    half is as likely as by two.

    >>> round(variance_factor(np.full(50, 0.25)), 3), variance_factor(np.array([0.25]))
    (0.257, 1.0)

    Args:
        ratios: (n,) squared errors over stated variances, of rows that nothing was learned from.
    """
    mean = max(float(np.mean(ratios)), LEAST_RATIO)
    # Entries of a row may err together: it tells no more than one complex entry does.
    error = max((standard_error(ratios) / mean) ** 2, 1 / len(ratios))
    return float(mean ** (1 / (1 + error)))


def mean_and_error(values: np.ndarray, group: np.ndarray) -> tuple[float, float]:
    """Return the mean of values (n,) and its `standard_error` by their groups (n,).

    Of few groups it is larger, so that as many normal means lie within it (Student's t).
    """
    degrees = max(len(np.unique(group)) - 1, 1)
    return float(values.mean()), half_width(ONE_DEVIATION, degrees) * standard_error(values, group)


def is_surely_above(gains: np.ndarray, deviations: float, least: float = 0.0) -> bool:
    """Tell whether the mean of gains (n,) is above `least`,
    and above 0 by so many standard errors.
    """
    return bool(np.mean(gains) > max(least, deviations * standard_error(gains)))


def central_interval(draws: np.ndarray, share: float) -> tuple[float, float]:
    """Return the ends between which the middle share of draws (n,) lies."""
    low, high = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2]).tolist()
    return low, high


def weighted_quantiles(
    values: np.ndarray, mass: np.ndarray, share: float | np.ndarray
) -> np.ndarray:
    """Return values, of (n,) with masses (n,), below which shares lie;
    of equal ones as `np.quantile`.
    """
    order = np.argsort(values, kind="stable")
    before = np.cumsum(mass[order]) - mass[order]
    return np.interp(share, before / max(float(before[-1]), 1e-300), values[order])


def conformal_level(share: float, groups: int) -> float:
    """Return which quantile of the errors of so many groups a share of further errors lies below.

    At most 1, the largest error: the guarantee of `conformal_quantile` ends
    where groups are too few.

    >>> conformal_level(0.5, 10)
    0.55
    """
    return min(share * (1 + 1 / groups), 1.0)


def conformal_quantile(values: Sequence[float], share: float) -> float:
    """Return what a further value exchangeable with these (n,)
    is below with a probability of `share`.

    Split conformal prediction (V. Vovk et al., "Algorithmic Learning in a Random World" (2005)): of
    n + 1 values the ceil((n + 1) share)-th; infinite where that is the further one itself.

    >>> conformal_quantile([0.3, 0.1, 0.2], 0.75), conformal_quantile([0.3, 0.1, 0.2], 0.8)
    (0.3, inf)
    """
    rank = int(np.ceil((len(values) + 1) * share))
    return float(np.sort(values)[rank - 1]) if rank <= len(values) else float("inf")


def censored_distribution(bound: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (m,) and their masses, those of censored rows spread over the errors they
    allow.

    The distribution of largest likelihood (B. W. Turnbull, J. Roy. Stat. Soc. B 38 (1976)); a row
    that allows no measured error counts as the least that its own can be in size.

    Args:
        bound: (n,) errors; of censored rows what bounds them.
        side: (n,) 1 where the error lies below its bound, -1 where above, 0 where it was measured.
    """
    order = np.argsort(bound, kind="stable")
    bound, side = bound[order], side[order].astype(np.int64)
    heard = bound[side == 0]
    low, high = heard[[0, -1]] if len(heard) else (np.inf, -np.inf)
    alone = ((side > 0) & (bound < low)) | ((side < 0) & (bound > high))
    error = np.where(alone, side * np.minimum(side * bound, 0.0), bound)
    exact = np.sort(error[(side == 0) | alone])
    below = np.searchsorted(exact, bound[(side > 0) & ~alone], side="right")
    above = np.searchsorted(exact, bound[(side < 0) & ~alone], side="left")
    mass = np.full(len(exact), 1 / len(exact))
    for _ in range(COMPLETED if len(below) + len(above) else 0):
        total = np.r_[0.0, np.cumsum(mass)]
        share = np.zeros(len(exact) + 1)
        np.add.at(share, below, 1 / total[below])
        # An error takes its part of all rows that allow it
        shared = np.cumsum(share[::-1])[::-1][1:]
        share[:] = 0.0
        np.add.at(share, above, 1 / (total[-1] - total[above]).clip(np.finfo(float).tiny))
        mass = (1 + mass * (shared + np.cumsum(share)[:-1])) / len(bound)
    return exact, mass


def coverage_and_width(error: np.ndarray, half: np.ndarray) -> tuple[float, float]:
    """Return the share of errors (n,) within intervals of half widths (n,), and their mean width.

    Where nothing is promised `half` is NaN; these rows are left out.
    """
    finite = np.isfinite(half)
    return float((np.abs(error) <= half)[finite].mean()), float(2 * half[finite].mean())


def binomial_interval(errors: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Return Clopper and Pearson's interval (1934) of a rate.

    >>> [round(end, 3) for end in binomial_interval(5, 50)]
    [0.033, 0.218]
    """
    tail, right = (1 - level) / 2, count - errors
    low = betaincinv(errors, right + 1, tail) if errors else 0.0
    return float(low), float(betaincinv(errors + 1, right, 1 - tail) if right else 1.0)


def binomial_tail(wrong: Any, count: Any, share: Any) -> Any:
    """Return P(at most `wrong` of `count` are bad) when a share is,
    for counts that need not be whole.
    """
    # The binomial tail as a regularised incomplete beta function: counts need not be whole,
    # but positive.
    return betainc(np.maximum(count - wrong, 1e-9), wrong + 1, 1 - share)


def most_failures(count: Any, share: float, risk: float) -> np.ndarray:
    """Return the largest number of bad ones of `count` whose `binomial_tail` is at most the risk.

    -1 where even none would show nothing: so few are all good by chance.

    >>> most_failures(np.array([22, 21]), share=0.1, risk=0.1)  # 0.9^22 is below 0.1
    array([ 0, -1])
    """
    none = binomial_tail(0, count, share) > risk
    return np.where(none, -1, np.floor(bdtrik(risk, np.maximum(count, 1), share))).astype(np.int64)


def least_accepted(alpha: float, delta: float) -> int:
    """Return how many, all of them good, show with confidence 1 - delta that
    at most a share alpha is bad.

    >>> least_accepted(alpha=0.1, delta=0.1)  # 0.9^22 is below 0.1
    22
    """
    # n good ones by chance, though a share alpha is bad, have probability (1 - alpha)^n.
    return int(np.ceil(np.log(delta) / np.log1p(-alpha)))


def design_effect(bad: np.ndarray, group: np.ndarray) -> float:
    """Return the variance of the bad ones' share between groups (n,) over independent draws';
    at least 1.

    A variance between few groups is itself uncertain: what is returned is its one-sided bound at
    `SURE_OF_EFFECT`, as of a normal variance.

    >>> design_effect(np.array([1, 1, 0, 0]), np.array([0, 0, 1, 1])) > 1  # neighbours err together
    True
    """
    share, groups = float(np.mean(bad)), len(np.unique(group))
    # One group, or all good or all bad: there is no variance between groups to compare.
    if groups < 2 or share in (0.0, 1.0):
        return 1.0
    # A sample variance of a normal variable, over the true one,
    # is chi squared over its degrees of freedom.
    bound = (groups - 1) / chdtri(groups - 1, SURE_OF_EFFECT)
    return max(
        1.0, float(bound * len(bad) * standard_error(bad, group) ** 2 / (share * (1 - share)))
    )


def risk_coverage(score: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Return the mean loss of the 1, 2, ..., n surest of n predictions, (n,).

    Its mean is the area under risk against coverage (Geifman, Uziel and El-Yaniv 2019). Equal
    scores share their mean loss: their order cannot matter.

    >>> risk_coverage(np.array([0.9, 0.1, 0.5]), np.array([0.0, 1.0, 0.5]))
    array([0.  , 0.25, 0.5 ])

    Args:
        score: (n,), larger is surer.
        loss: (n,).
    """
    order = np.argsort(-score, kind="stable")
    _, group = np.unique(-score[order], return_inverse=True)
    shared = (np.bincount(group, loss[order].astype(np.float64)) / np.bincount(group))[group]
    return np.cumsum(shared) / np.arange(1, len(score) + 1)


def rank_correlation(one: np.ndarray, other: np.ndarray) -> float | None:
    """Return Spearman's correlation of values (n,) and others (n,);
    None where one of them is constant.

    >>> round(rank_correlation(np.array([0.9, 0.1, 0.5]), np.array([0.0, 1.0, 0.5])), 3)
    -1.0
    """
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return None
    pairs = (np.unique(part, return_inverse=True, return_counts=True)[1:] for part in (one, other))
    # Equal values share the mean of their ranks.
    first, second = ((np.cumsum(count) - count / 2)[which.reshape(-1)] for which, count in pairs)
    return float(np.corrcoef(first, second)[0, 1])


@dataclass(frozen=True)
class Threshold:
    """A threshold and what it was chosen on.

    >>> round(Threshold(value=0.7, accepted=22, bad=0).bound(delta=0.1), 3)
    0.099

    Attributes:
        value: accept scores of at least this; infinite when nothing can be promised, -infinite:
            all.
        accepted: calibration positions it accepts.
        bad: how many of them are bad.
    """

    value: float
    accepted: int
    bad: int

    def bound(self, delta: float) -> float:
        """Return the upper confidence bound on the share of bad ones accepted (Clopper
        and Pearson 1934).
        """
        # Two tails of delta each: the upper end alone is exceeded with that probability.
        return binomial_interval(self.bad, self.accepted, 1 - 2 * delta)[1]


def threshold_levels(
    score: np.ndarray, bad: np.ndarray, count: int, alpha: float, delta: float
) -> np.ndarray:
    """Return thresholds (at most `LEVELS`,), strict to lax: quantiles of scores (n,)
    not the calibration's.

    The first is the laxest whose chance to pass on `count` calibration positions is nearly the
    best, so that one bad row among the few surest does not end the search. Chances are predicted
    from who is `bad` (n,), as the mean over `CURVES`, weighed by their likelihoods.
    """
    levels = np.unique(np.quantile(score, np.linspace(0, 1, LEVELS)))[::-1]
    order, (powers, factors) = np.argsort(-score), CURVES
    # Log odds of bad by rank, the surest first: (powers, factors, n).
    odds = factors + powers * np.log((np.arange(len(score)) + 0.5) / len(score))
    fit = np.where(bad[order], log_expit(odds), log_expit(-odds)).sum(-1)
    accepted = np.searchsorted(-score[order], -levels, side="right")
    share = np.cumsum(np.exp(log_expit(odds)), -1)[..., accepted - 1] / accepted
    expected = np.round(accepted / len(score) * count)
    most = most_failures(expected, alpha, delta)
    chance = np.where(most < 0, 0, binomial_tail(np.maximum(most, 0), expected, share))
    chance = np.tensordot(np.exp(fit - fit.max()), chance, 2)
    return levels[np.flatnonzero(chance >= NEARLY_BEST * chance.max())[-1] :]


def choose_threshold(
    score: np.ndarray,
    bad: np.ndarray,
    levels: np.ndarray,
    alpha: float,
    delta: float,
    group: np.ndarray | None = None,
) -> Threshold:
    """Choose the laxest threshold of which the calibration set (n,)
    shows that at most a share alpha is bad.

    Learn then Test (Angelopoulos, Bates, Candes, Jordan and Lei 2021) with fixed-sequence testing:
    `levels` are tried from strict to lax, each is a binomial test on the positions it accepts, and
    the first that fails ends the search. Where neighbours err together, `group` (n,) names the
    patch each position belongs to: counts are divided by the design effect, how much more the share
    varies between patches than binomial counts would (Kish 1965; approximate, where the test
    without groups is exact). A level too strict to be tested (fewer than `least_accepted`) is
    passed over, and spends nothing. Where all are, accepting everybody is tested.

    >>> score = np.linspace(0, 1, 100)
    >>> choose_threshold(score, score < 0.5, score[::-2], alpha=0.1, delta=0.1).accepted >= 50
    True
    """
    threshold, least = Threshold(float("inf"), 0, 0), least_accepted(alpha, delta)
    # The laxest of few levels may be too strict to be tested;
    # the last is fixed without the labels, too.
    for level in (*levels, -np.inf):
        rows = score >= level
        accepted, wrong = int(rows.sum()), int(bad[rows].sum())
        if accepted < least or (level == -np.inf and threshold.accepted):
            continue
        effect = 1.0 if group is None else design_effect(bad[rows], group[rows])
        # A fixed sequence: as the first test that fails ends it,
        # delta need not be divided among the tests.
        if binomial_tail(wrong / effect, accepted / effect, alpha) > delta:
            break
        threshold = Threshold(float(level), accepted, wrong)
    return threshold
