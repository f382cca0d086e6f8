"""A threshold with a promise: at most a share alpha of accepted positions is bad,
with confidence 1 - delta.

Given who is accepted the bad ones are binomial (`gsparc.processes.uncertainty.choose_threshold`),
so the promise is about the error *among accepted positions*; plain split conformal promises a share
of all positions instead. Whether promises hold is told by `run_trials`: thresholds of many draws,
tried on other rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gsparc.prediction.confidence import Guarantee
from gsparc.prediction.left_out import Evidence
from gsparc.processes.uncertainty import (
    Threshold,
    binomial_interval,
    binomial_tail,
    choose_threshold,
    design_effect,
    least_accepted,
    rank_correlation,
    risk_coverage,
    threshold_levels,
)

# Of the positions that choose levels, and that calibrate where the rest tests
SHARES = (0.2, 0.4)
MOST_CALIBRATED = 10_000  # positions that a message may ask for
MOST_LAX_DB = 6  # limit of an error that a hint may name: twice as large as what is predicted
CELLS = 6  # along each horizontal side; whole cells are calibrated on or tested


def bounded_loss(relative_error: np.ndarray) -> np.ndarray:
    """Return losses (n,) in [0, 1]: |e|^2 / |h|^2, where 1 (no better than silence)
    is as bad as it gets.
    """
    return np.minimum(relative_error, 1.0)


@dataclass(frozen=True)
class Trial:
    """What many calibration sets led to.

    Attributes:
        kind: confidence used.
        how: positions were divided, `random` or `spatial`.
        realised: (draws,) share of bad ones among accepted test positions; NaN where none was
            accepted.
        coverage: (draws,) share of test positions accepted.
        alpha: largest share of bad ones that was guaranteed.
    """

    kind: str
    how: str
    realised: np.ndarray
    coverage: np.ndarray
    alpha: float

    def summarise(self) -> dict[str, Any]:
        """Return figures over the draws; None of those that nothing was accepted in.

        `broken` is the share of draws with more than alpha bad ones, of the draws that accepted
        anybody, with Clopper and Pearson's 95 % interval as if they were independent (they share
        their positions: it is the least that chance allows for). Delta bounds the share of *all*
        draws, `broken_of_all`: where most accept nobody, those that do are the ones that chance
        flattered. `silent` is the share that did not.
        """
        accepting = self.realised[~np.isnan(self.realised)]
        bad = accepting > self.alpha
        low, high = (
            binomial_interval(int(bad.sum()), len(accepting)) if len(accepting) else (None, None)
        )
        return {
            "kind": self.kind,
            "broken": float(bad.mean()) if len(accepting) else None,
            "broken_low": low,
            "broken_high": high,
            "broken_of_all": float(bad.sum() / len(self.realised)),
            "silent": float(np.isnan(self.realised).mean()),
            "realised": float(accepting.mean()) if len(accepting) else None,
            "coverage": float(self.coverage.mean()),
            "draws": len(self.realised),
        }


class CalibratedThreshold(NamedTuple):
    """Kind of confidence, its threshold, rows that neither saw, rows that chose its levels."""

    kind: str
    threshold: Threshold
    test: np.ndarray
    aside: np.ndarray


def split_choose_calibrate_test(
    evidence: Evidence, spatial: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return disjoint rows of the evidence: to choose on, to calibrate on, to test on.

    A `spatial` division deals out whole cells of the plane, so that a test position has no
    calibrated neighbour but across a cell's border.

    Raises:
        ValueError: too few positions, or patches, for three parts.
    """
    unit = number_patches(evidence.position) if spatial else np.arange(len(evidence))
    order = rng.permutation(unit.max(initial=-1) + 1)
    first, second = (round(share * len(order)) for share in np.cumsum(SHARES))
    if not 0 < first < second < len(order):
        units = "patches of the plane" if spatial else "positions"
        raise ValueError(
            f"{len(order)} {units} cannot be parted into those to choose on, to calibrate on and "
            "to test on: "
            f"take more test rows{', or spatial=false' * spatial}"
        )
    parts = order[:first], order[first:second], order[second:]
    choose_on, calibrate, test = (np.flatnonzero(np.isin(unit, part)) for part in parts)
    return choose_on, calibrate, test


def explain_too_few(
    count: int, guarantee: Guarantee, bad: float = 0.0, effect: float = 1.0
) -> str | None:
    """Say how many test positions a promise needs of which a share `bad` is bad; None:
    not more than `count`.

    `effect` is their `design_effect`.

    >>> explain_too_few(32, Guarantee(alpha=0.2))  # enough
    >>> explain_too_few(32, Guarantee(alpha=0.2), bad=0.1).split(";")[0].partition(": ")[2]
    'alpha=0.2, delta=0.1 with 10% bad need 35 calibrated on, 44 in all'
    """
    # A share of alpha or more passes with no number: what none bad would need is the least.
    bad = bad if bad < guarantee.alpha else 0.0
    least = np.arange(least_accepted(guarantee.alpha, guarantee.delta), MOST_CALIBRATED)
    passed = least[
        binomial_tail(bad * least / effect, least / effect, guarantee.alpha) <= guarantee.delta
    ]
    if not len(passed) or count >= (needed := int(np.ceil(passed[0] / (1 - SHARES[0])))):
        return None
    alike = "" if effect == 1 else f", as neighbours err alike ({effect:.1f} are as one)"
    return (
        f"{count} test positions are too few: alpha={guarantee.alpha:g}, "
        f"delta={guarantee.delta:g} with "
        f"{bad:.0%} bad need {passed[0]} calibrated on{alike}, {needed} in all; measure more, or "
        "promise less"
    )


def explain_missing_threshold(
    evidence: Evidence, guarantee: Guarantee, kind: str, spatial: bool, seed: int
) -> str:
    """Say why no threshold was found, and the least larger limit [whole dB] that is kept by one.

    See `calibrate_threshold`.
    """
    wrong = guarantee.is_bad(evidence.error)
    bad, effect = float(wrong.mean()), 1.0
    if spatial:
        effect = design_effect(wrong, number_patches(evidence.position))
    if few := explain_too_few(len(evidence), guarantee, bad, effect):
        return few
    hint = f"no limit_db= up to {MOST_LAX_DB} is"
    for limit in range(int(np.floor(guarantee.limit_db)) + 1, MOST_LAX_DB + 1):
        other = replace(guarantee, limit_db=float(limit))
        if calibrate_threshold(
            evidence, other, kind, spatial, seed, tested=False
        ).threshold.accepted:
            hint = f"limit_db={limit} would be"
            break
    reason = "no confidence separates the others surely enough"
    if bad < guarantee.alpha:
        reason = f"too few rows to show that at most alpha={guarantee.alpha:g} are"
    return (
        f"{bad:.0%} of {len(evidence)} test positions are worse than {guarantee.limit_db:g} dB, "
        "and "
        f"{reason}; {hint} kept, more training rows may help"
    )


def number_patches(position: np.ndarray) -> np.ndarray:
    """Number the patch of the plane that each position (n, 3) lies in, (n,); on a plumb line,
    of it.
    """
    flat = position[:, :2] if np.ptp(position[:, :2], axis=0).any() else position[:, [2, 2]]
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    # The largest coordinate of all would lie in a cell beyond the last.
    cell = np.minimum((flat - low) / np.where(extent > 0, extent, 1) * CELLS, CELLS - 1).astype(int)
    return np.unique(cell @ np.array([CELLS, 1]), return_inverse=True)[1].ravel()


def calibrate_threshold(
    evidence: Evidence,
    guarantee: Guarantee,
    kind: str,
    spatial: bool,
    seed: int | list[int],
    tested: bool = True,
) -> CalibratedThreshold:
    """Return the threshold of a confidence, `kind` or the first of the evidence.

    Unless `tested`, the unseen positions calibrate, too: a threshold that nobody tries needs none.

    Raises:
        ValueError: `kind` is no confidence of this evidence, or it has none.
    """
    if not evidence.scores:
        raise ValueError("the model states neither an error variance nor a confidence")
    used = next(iter(evidence.scores)) if kind == "auto" else kind
    if used not in evidence.scores:
        raise ValueError(f"confidence={used}: expected auto or {', '.join(evidence.scores)}")
    rng = np.random.default_rng(seed)
    choose_on, calibrate, test = split_choose_calibrate_test(evidence, spatial, rng)
    score, bad = evidence.scores[used], guarantee.is_bad(evidence.error)
    if not tested:
        calibrate, test = np.concatenate([calibrate, test]), test[:0]
    # Divided at random, accepted positions are independent draws, and their counts are binomial.
    patch = number_patches(evidence.position)[calibrate] if spatial else None
    risks = guarantee.alpha, guarantee.delta
    levels = threshold_levels(score[choose_on], bad[choose_on], len(calibrate), *risks)
    threshold = choose_threshold(score[calibrate], bad[calibrate], levels, *risks, patch)
    return CalibratedThreshold(used, threshold, test, choose_on)


def run_trials(
    evidence: Evidence,
    guarantee: Guarantee,
    spatial: bool,
    draws: int,
    kind: str = "auto",
    seed: int = 0,
) -> Trial:
    """Resample `draws` calibration sets.

    Args:
        evidence: positions the method did not learn from.
        guarantee: what every threshold promises.
        spatial: see `split_choose_calibrate_test`.
        draws: calibration sets.
        kind: a confidence, or `auto`: the expected error where the method states one.
        seed: of the draws.
    """
    realised, coverage, used = [], [], kind
    bad = guarantee.is_bad(evidence.error)
    for draw in range(draws):
        used, threshold, test, _ = calibrate_threshold(
            evidence, guarantee, kind, spatial, [seed, draw]
        )
        accepted = test[evidence.scores[used][test] >= threshold.value]
        realised.append(bad[accepted].mean() if len(accepted) else np.nan)
        coverage.append(len(accepted) / max(len(test), 1))
    how = "spatial" if spatial else "random"
    return Trial(used, how, np.array(realised), np.array(coverage), guarantee.alpha)


def calibration_facts(
    evidence: Evidence, trials: Sequence[Trial], guarantee: Guarantee
) -> dict[str, Any]:
    """Return flat figures: `confidence/<kind>/*`, `promise/*`, `trial/<how>/*`."""
    loss = bounded_loss(evidence.error)
    perfect = risk_coverage(-loss, loss).mean()
    facts: dict[str, Any] = {"positions": len(evidence), "confidence/perfect/area": float(perfect)}
    risks = {kind: risk_coverage(score, loss) for kind, score in evidence.scores.items()}
    for kind, risk in risks.items():
        area = float(risk.mean())
        figures = {
            "area": area,
            "risk_at_70": float(risk[max(round(0.7 * len(risk)), 1) - 1]),
            "rank_correlation": rank_correlation(evidence.scores[kind], -loss),
        }
        facts |= {f"confidence/{kind}/{name}": value for name, value in figures.items()}
    facts |= {f"promise/{name}": value for name, value in vars(guarantee).items()}
    for trial in trials:
        facts |= {f"trial/{trial.how}/{name}": value for name, value in trial.summarise().items()}
    return facts
