"""A threshold with a promise: at most a share alpha of accepted positions is bad, with confidence 1 - delta.

Learn then Test (Angelopoulos, Bates, Candes, Jordan and Lei 2021) with fixed-sequence testing: thresholds are
tried towards laxer ones from where other positions predict success, each is a binomial test on the
calibration positions it accepts, and the first that fails ends the search. Given who is accepted the bad ones
are binomial, so the promise is about the error *among accepted positions*; plain split conformal promises a
share of all positions instead. Whether promises hold is told by `run_trials`: thresholds of many draws, tried
on other rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.special import betainc, log_expit
from scipy.stats import binom, binomtest, chi2, spearmanr

from gsparc.data.limits import SHARE, Checked, setting
from gsparc.processes.stored import Stored

RIVALS = ("distance", "gp_variance")
KINDS = ("learned", "expected", *RIVALS)
# Thresholds that are tried: more of them resolve finer, but each one may end the search.
LEVELS = 50
# Odds of bad as powers of the rank, all equally likely before positions are seen: powers and log factors.
CURVES = np.array([0, 0.5, 1, 2, 4])[:, None, None], np.linspace(-6, 6, 25)[:, None]
NEARLY_BEST = 0.98  # of the best level's chance to pass: the laxest such level is tried first
SURE_OF_EFFECT = 0.8
How = Literal["random", "spatial"]
SHARES = (0.2, 0.4)  # of the positions that choose kind and levels, and that calibrate where the rest tests
MOST_CALIBRATED = 10_000  # positions that a message may ask for
MOST_LAX_DB = 6  # limit of an error that a hint may name: twice as large as what is predicted
CELLS = 6  # along each horizontal side; whole cells are calibrated on or tested


@dataclass(frozen=True)
class Evidence:
    """Positions a method did not learn from.

    Attributes:
        row: (n,) rows of the dataset.
        position: (n, 3) [m].
        error: (n,) |e|^2 / |h|^2; for powers, of the linear power.
        scores: by kind, (n,) each, larger is surer.
    """

    row: np.ndarray
    position: np.ndarray
    error: np.ndarray
    scores: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.row)


def join_evidence(parts: Sequence[Evidence]) -> Evidence:
    """Join folds; scores that not every part has are dropped."""
    kinds = [kind for kind in KINDS if all(kind in part.scores for part in parts)]
    scores = {kind: np.concatenate([part.scores[kind] for part in parts]) for kind in kinds}
    facts = zip(*((part.row, part.position, part.error) for part in parts), strict=True)
    row, position, error = map(np.concatenate, facts)
    return Evidence(row, position, error, scores)


@dataclass(frozen=True)
class Guarantee(Stored, Checked):
    """What is promised.

    >>> Guarantee(alpha=0.1, delta=0.1).least  # 0.9^22 is below 0.1
    22
    >>> Guarantee(limit_db=-10.0).is_bad(np.array([0.05, 0.5]))
    array([False,  True])

    Attributes:
        limit_db: a prediction is bad when |e|^2 / |h|^2 exceeds this [dB].
        alpha: largest share of bad ones among the accepted.
        delta: probability that a calibration set misleads.
    """

    limit_db: float = -10.0
    alpha: float = setting(0.1, SHARE)
    delta: float = setting(0.1, SHARE)

    @property
    def least(self) -> int:
        """Positions that must be accepted, all of them good, before anything can be promised."""
        # n good ones by chance, though a share alpha is bad, have probability (1 - alpha)^n.
        return int(np.ceil(np.log(self.delta) / np.log1p(-self.alpha)))

    def is_bad(self, relative_error: np.ndarray) -> np.ndarray:
        """Tell whether predictions (n,) are bad."""
        return relative_error > 10 ** (self.limit_db / 10)


@dataclass(frozen=True)
class Threshold:
    """A threshold and what it was chosen on.

    >>> round(Threshold(value=0.7, accepted=22, bad=0).bound(delta=0.1), 3)
    0.099

    Attributes:
        value: accept scores of at least this; infinite when nothing can be promised, -infinite: all.
        accepted: calibration positions it accepts.
        bad: how many of them are bad.
    """

    value: float
    accepted: int
    bad: int

    def bound(self, delta: float) -> float:
        """Return the upper confidence bound on the share of bad ones accepted (Clopper and Pearson 1934)."""
        # Two tails of delta each: the upper end alone is exceeded with that probability.
        return binomial_interval(self.bad, self.accepted, 1 - 2 * delta)[1]


def binomial_interval(errors: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Return Clopper and Pearson's interval (1934) of a rate.

    >>> [round(end, 3) for end in binomial_interval(5, 50)]
    [0.033, 0.218]
    """
    if count == 0:
        return 0.0, 1.0
    interval = binomtest(errors, count).proportion_ci(level)
    return float(interval.low), float(interval.high)


def threshold_levels(score: np.ndarray, bad: np.ndarray, guarantee: Guarantee, count: int) -> np.ndarray:
    """Return thresholds (at most `LEVELS`,), strict to lax: quantiles of scores (n,) not the calibration's.

    The first is the laxest whose chance to pass on `count` calibration positions is nearly the best, so that
    one bad row among the few surest does not end the search. Chances are predicted from who is `bad` (n,), as
    the mean over `CURVES`, weighed by their likelihoods.
    """
    levels = np.unique(np.quantile(score, np.linspace(0, 1, LEVELS)))[::-1]
    order, (powers, factors) = np.argsort(-score), CURVES
    # Log odds of bad by rank, the surest first: (powers, factors, n).
    odds = factors + powers * np.log((np.arange(len(score)) + 0.5) / len(score))
    fit = np.where(bad[order], log_expit(odds), log_expit(-odds)).sum(-1)
    accepted = np.searchsorted(-score[order], -levels, side="right")
    share = np.cumsum(np.exp(log_expit(odds)), -1)[..., accepted - 1] / accepted
    expected = np.round(accepted / len(score) * count)
    most = binom.ppf(guarantee.delta, expected, guarantee.alpha) - 1  # bad ones with which a level passes
    chance = np.where(most < 0, 0, _error_tail(np.maximum(most, 0), expected, share))
    chance = np.tensordot(np.exp(fit - fit.max()), chance, 2)
    return levels[np.flatnonzero(chance >= NEARLY_BEST * chance.max())[-1] :]


def choose_threshold(
    score: np.ndarray, bad: np.ndarray, levels: np.ndarray, guarantee: Guarantee,
    group: np.ndarray | None = None,
) -> Threshold:  # fmt: skip
    """Choose the laxest threshold that the calibration set (n,) supports.

    Where neighbours err together, `group` (n,) names the patch each position belongs to: counts are divided
    by the design effect, how much more the share varies between patches than binomial counts would (Kish
    1965; approximate, where the test without groups is exact). A level too strict to be tested (no outcome
    could reject: fewer than log delta / log(1 - alpha) accepted) is passed over, and spends nothing. Where
    all are, accepting everybody is tested.

    >>> score = np.linspace(0, 1, 100)
    >>> choose_threshold(score, score < 0.5, score[::-2], Guarantee()).accepted >= 50
    True
    """
    threshold = Threshold(float("inf"), 0, 0)
    # The laxest of few levels may be too strict to be tested; the last is fixed without the labels, too.
    for level in (*levels, -np.inf):
        rows = score >= level
        accepted, wrong = int(rows.sum()), int(bad[rows].sum())
        if accepted < guarantee.least or (level == -np.inf and threshold.accepted):
            continue
        effect = 1.0 if group is None else design_effect(bad[rows], group[rows])
        # A fixed sequence: as the first test that fails ends it, delta need not be divided among the tests.
        if _error_tail(wrong / effect, accepted / effect, guarantee.alpha) > guarantee.delta:
            break
        threshold = Threshold(float(level), accepted, wrong)
    return threshold


def design_effect(bad: np.ndarray, group: np.ndarray) -> float:
    """Return the variance of the bad ones' share between groups (n,) over independent draws'; at least 1.

    A variance between few groups is itself uncertain: what is returned is its one-sided bound at
    `SURE_OF_EFFECT`, as of a normal variance.

    >>> design_effect(np.array([1, 1, 0, 0]), np.array([0, 0, 1, 1])) > 1  # neighbours err together
    True
    """
    _, which = np.unique(group, return_inverse=True)
    counts, wrong = np.bincount(which), np.bincount(which, bad)
    share, groups = wrong.sum() / counts.sum(), len(counts)
    # One group, or all good or all bad: there is no variance between groups to compare.
    if groups < 2 or share in (0.0, 1.0):
        return 1.0
    # Kish's ratio estimator: squared deviations of group counts from the common share.
    between = groups / (groups - 1) * ((wrong - share * counts) ** 2).sum() / counts.sum()
    # A sample variance of a normal variable, over the true one, is chi squared over its degrees of freedom.
    bound = (groups - 1) / chi2.ppf(1 - SURE_OF_EFFECT, groups - 1)
    return max(1.0, float(bound * between / (share * (1 - share))))


def _error_tail(wrong: Any, accepted: Any, alpha: Any) -> Any:
    """P(at most `wrong` of `accepted` are bad) when a share alpha is, for counts that need not be whole."""
    # The binomial tail as a regularised incomplete beta function: counts need not be whole, but positive.
    return betainc(np.maximum(accepted - wrong, 1e-9), wrong + 1, 1 - alpha)


def bounded_loss(relative_error: np.ndarray) -> np.ndarray:
    """Return losses (n,) in [0, 1]: |e|^2 / |h|^2, where 1 (no better than silence) is as bad as it gets."""
    return np.minimum(relative_error, 1.0)


def risk_coverage(score: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Return the mean loss of the 1, 2, ..., n surest of n predictions, (n,).

    Its mean is the area under risk against coverage (Geifman, Uziel and El-Yaniv 2019). Equal scores share
    their mean loss: their order cannot matter.

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


def rank_correlation(score: np.ndarray, loss: np.ndarray) -> float | None:
    """Return Spearman's correlation of scores (n,) with minus the losses (n,); None where one is constant.

    >>> round(rank_correlation(np.array([0.9, 0.1, 0.5]), np.array([0.0, 1.0, 0.5])), 3)
    1.0
    """
    if np.ptp(score) == 0 or np.ptp(loss) == 0:
        return None
    return float(spearmanr(score, -loss).statistic)


@dataclass(frozen=True)
class Trial:
    """What many calibration sets led to.

    Attributes:
        kind: confidence used.
        how: how positions were divided.
        realised: (draws,) share of bad ones among accepted test positions; NaN where none was accepted.
        coverage: (draws,) share of test positions accepted.
        alpha: largest share of bad ones that was guaranteed.
    """

    kind: str
    how: How
    realised: np.ndarray
    coverage: np.ndarray
    alpha: float

    def summarise(self) -> dict[str, Any]:
        """Return figures over the draws; None of those that nothing was accepted in.

        `broken` is the share of draws with more than alpha bad ones, of the draws that accepted anybody, with
        Clopper and Pearson's 95 % interval as if they were independent (they share their positions: it is the
        least that chance allows for). Delta bounds the share of *all* draws, `broken_of_all`: where most
        accept nobody, those that do are the ones that chance flattered. `silent` is the share that did not.
        """
        accepting = self.realised[~np.isnan(self.realised)]
        bad = accepting > self.alpha
        low, high = binomial_interval(int(bad.sum()), len(accepting)) if len(accepting) else (None, None)
        return {
            "kind": self.kind, "broken": float(bad.mean()) if len(accepting) else None, "broken_low": low,
            "broken_high": high, "broken_of_all": float(bad.sum() / len(self.realised)),
            "silent": float(np.isnan(self.realised).mean()),
            "realised": float(accepting.mean()) if len(accepting) else None,
            "coverage": float(self.coverage.mean()), "draws": len(self.realised),
        }  # fmt: skip


class CalibratedThreshold(NamedTuple):
    """Kind of confidence, its threshold, rows that neither saw, and rows that the kind is chosen on."""

    kind: str
    threshold: Threshold
    test: np.ndarray
    choose_on: np.ndarray


def split_choose_calibrate_test(
    evidence: Evidence, how: How, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return disjoint rows of the evidence: to choose on, to calibrate on, to test on.

    `spatial` deals out whole cells of the plane, so that a test position has no calibrated neighbour but
    across a cell's border.

    Raises:
        ValueError: too few positions, or patches, for three parts.
    """
    unit = np.arange(len(evidence)) if how == "random" else number_patches(evidence.position)
    order = rng.permutation(unit.max(initial=-1) + 1)
    first, second = (round(share * len(order)) for share in np.cumsum(SHARES))
    if not 0 < first < second < len(order):
        what = "positions" if how == "random" else "patches of the plane"
        raise ValueError(
            f"{len(order)} {what} cannot be parted into those to choose on, to calibrate on and to test on: "
            f"take more test rows{'' if how == 'random' else ', or spatial=false'}"
        )
    parts = order[:first], order[first:second], order[second:]
    choose_on, calibrate, test = (np.flatnonzero(np.isin(unit, part)) for part in parts)
    return choose_on, calibrate, test


def explain_too_few(count: int, guarantee: Guarantee, bad: float = 0.0, effect: float = 1.0) -> str | None:
    """Say how many test positions a promise needs of which a share `bad` is bad; None: not more than `count`.

    `effect` is their `design_effect`.

    >>> explain_too_few(32, Guarantee(alpha=0.2))  # enough
    >>> explain_too_few(32, Guarantee(alpha=0.2), bad=0.1).split(";")[0]
    '32 test positions are too few: alpha=0.2, delta=0.1 with 10% bad need 35 calibrated on, 44 in all'
    """
    # A share of alpha or more passes with no number: what none bad would need is the least.
    bad = bad if bad < guarantee.alpha else 0.0
    least = np.arange(guarantee.least, MOST_CALIBRATED)
    passed = least[_error_tail(bad * least / effect, least / effect, guarantee.alpha) <= guarantee.delta]
    if not len(passed) or count >= (needed := int(np.ceil(passed[0] / (1 - SHARES[0])))):
        return None
    alike = "" if effect == 1 else f", as neighbours err alike ({effect:.1f} are as one)"
    return (
        f"{count} test positions are too few: alpha={guarantee.alpha:g}, delta={guarantee.delta:g} with "
        f"{bad:.0%} bad need {passed[0]} calibrated on{alike}, {needed} in all; measure more, or promise less"
    )


def relax_guarantee(
    evidence: Evidence, guarantee: Guarantee, kind: str, spatial: bool, seed: int
) -> Guarantee | None:
    """Return the same promise with the least larger limit [whole dB] that these positions keep; or None."""
    for limit in range(int(np.floor(guarantee.limit_db)) + 1, MOST_LAX_DB + 1):
        other = replace(guarantee, limit_db=float(limit))
        if calibrate_threshold(evidence, other, kind, spatial, seed, tested=False).threshold.accepted:
            return other
    return None


def number_patches(position: np.ndarray) -> np.ndarray:
    """Number the patch of the plane that each position (n, 3) lies in, (n,); on a plumb line, of it."""
    flat = position[:, :2] if np.ptp(position[:, :2], axis=0).any() else position[:, [2, 2]]
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    # The largest coordinate of all would lie in a cell beyond the last.
    cell = np.minimum((flat - low) / np.where(extent > 0, extent, 1) * CELLS, CELLS - 1).astype(int)
    return np.unique(cell @ np.array([CELLS, 1]), return_inverse=True)[1].ravel()


def area_contributions(score: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Return what each of n samples adds to the area under risk-coverage, (n,), whose mean is the area.

    >>> score, loss = np.array([0.9, 0.1, 0.5]), np.array([0.0, 1.0, 0.5])
    >>> bool(np.isclose(area_contributions(score, loss).mean(), risk_coverage(score, loss).mean()))
    True
    """
    # The sample at rank r is in the means of r, r + 1, ..., n samples; equal scores share their ranks.
    weight = np.cumsum(1 / np.arange(len(score), 0, -1))[::-1]
    order, group = np.argsort(-score, kind="stable"), np.unique(-score, return_inverse=True)[1]
    shared = np.bincount(group[order], weight) / np.bincount(group)
    return loss * shared[group]


def best_kind(evidence: Evidence, rows: np.ndarray) -> str:
    """Return the confidence of the smallest area under risk-coverage on `rows`.

    The first, mostly the model's own, stays where another gains no more than the paired standard error (the
    one-standard-error rule of Breiman, Friedman, Olshen and Stone 1984).
    """
    # Bounded, so that a few fades do not decide which kind is the best.
    loss = bounded_loss(evidence.error[rows])
    parts = {kind: area_contributions(score[rows], loss) for kind, score in evidence.scores.items()}
    own, best = next(iter(parts)), min(parts, key=lambda kind: parts[kind].mean())
    gain = parts[own] - parts[best]
    # Both are of the same rows: their difference scatters less than either.
    return best if gain.mean() > gain.std() / np.sqrt(max(len(gain), 1)) else own


def explain_kind(evidence: Evidence, rows: np.ndarray) -> str:
    """Say on which figures `best_kind` chose on `rows`."""
    loss = bounded_loss(evidence.error[rows])
    areas = {kind: risk_coverage(score[rows], loss).mean() for kind, score in evidence.scores.items()}
    listed = ", ".join(f"{kind} {area:.3g}" for kind, area in areas.items())
    rule = f"{next(iter(areas))} stays unless one is smaller by more than chance"
    return f"chosen by the mean error of the surest 1, 2, ... of {len(rows)} rows: {listed} ({rule})"


def calibrate_threshold(
    evidence: Evidence, guarantee: Guarantee, kind: str, spatial: bool, seed: int | list[int],
    tested: bool = True,
) -> CalibratedThreshold:  # fmt: skip
    """Choose a confidence and its threshold.

    Unless `tested`, the unseen positions calibrate, too: a threshold that nobody tries needs none.

    Raises:
        ValueError: `kind` is no confidence of this evidence.
    """
    rng = np.random.default_rng(seed)
    how: How = "spatial" if spatial else "random"
    choose_on, calibrate, test = split_choose_calibrate_test(evidence, how, rng)
    used = best_kind(evidence, choose_on) if kind == "auto" else kind
    if used not in evidence.scores:
        raise ValueError(f"confidence={used}: expected auto or {', '.join(evidence.scores)}")
    score, bad = evidence.scores[used], guarantee.is_bad(evidence.error)
    if not tested:
        calibrate, test = np.concatenate([calibrate, test]), test[:0]
    # Divided at random, accepted positions are independent draws, and their counts are binomial.
    patch = number_patches(evidence.position)[calibrate] if spatial else None
    levels = threshold_levels(score[choose_on], bad[choose_on], guarantee, len(calibrate))
    threshold = choose_threshold(score[calibrate], bad[calibrate], levels, guarantee, patch)
    return CalibratedThreshold(used, threshold, test, choose_on)


def run_trials(
    evidence: Evidence, guarantee: Guarantee, how: How, draws: int, kind: str = "auto", seed: int = 0
) -> Trial:
    """Resample `draws` calibration sets.

    Args:
        evidence: positions the method did not learn from.
        guarantee: what every threshold promises.
        how: `random` or `spatial` division.
        draws: calibration sets.
        kind: a confidence, or `auto`: the best on the positions set aside for choosing.
        seed: of the draws.
    """
    realised, coverage, kinds = [], [], []
    bad, spatial = guarantee.is_bad(evidence.error), how == "spatial"
    for draw in range(draws):
        drawn = [seed, draw]
        used, threshold, test, _ = calibrate_threshold(evidence, guarantee, kind, spatial, drawn)
        accepted = test[evidence.scores[used][test] >= threshold.value]
        kinds.append(used)
        realised.append(bad[accepted].mean() if len(accepted) else np.nan)
        coverage.append(len(accepted) / max(len(test), 1))
    most = max(set(kinds), key=kinds.count)
    return Trial(most, how, np.array(realised), np.array(coverage), guarantee.alpha)


def calibration_facts(evidence: Evidence, trials: Sequence[Trial], guarantee: Guarantee) -> dict[str, Any]:
    """Return flat figures: `confidence/<kind>/*`, `promise/*`, `trial/<how>/*`."""
    loss = bounded_loss(evidence.error)
    perfect = risk_coverage(-loss, loss).mean()
    facts: dict[str, Any] = {"positions": len(evidence), "confidence/perfect/area": float(perfect)}
    risks = {kind: risk_coverage(score, loss) for kind, score in evidence.scores.items()}
    bar = float(risks["distance"].mean())
    for kind, risk in risks.items():
        area = float(risk.mean())
        own = {
            "area": area, "risk_at_70": float(risk[max(round(0.7 * len(risk)), 1) - 1]),
            "rank_correlation": rank_correlation(evidence.scores[kind], loss),
            "area_below_distance": 1 - area / bar if bar > 0 else None,  # nothing to save
        }  # fmt: skip
        facts |= {f"confidence/{kind}/{name}": value for name, value in own.items()}
    facts |= {f"promise/{name}": value for name, value in vars(guarantee).items()}
    for trial in trials:
        facts |= {f"trial/{trial.how}/{name}": value for name, value in trial.summarise().items()}
    return facts
