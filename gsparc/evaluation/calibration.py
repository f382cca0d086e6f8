"""Risk against coverage, and whether promises hold: thresholds of many draws, tried on other rows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.stats import spearmanr

from gsparc.data.datasets.argos import published_figures, published_normalisation
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.evaluation.drawing import panels, save
from gsparc.evaluation.open_runs import Opened, open_files
from gsparc.evaluation.scores import rows_of
from gsparc.models.method import Method
from gsparc.prediction.confidence import (
    CHUNK,
    Evidence,
    Trusted,
    gather,
    joined,
    keep,
    known_positions,
    position_kernel,
    threshold_of,
)
from gsparc.prediction.risk_threshold import (
    Promise,
    Threshold,
    binomial_interval,
    choose,
    levels_of,
    spread_out,
)


@dataclass(frozen=True)
class RiskCoverage:
    """Mean loss of the surest share of predictions.

    Attributes:
        coverage: (n,) shares accepted, 1 / n to 1.
        risk: (n,) mean loss among them.
    """

    coverage: np.ndarray
    risk: np.ndarray

    @property
    def area(self) -> float:
        """Mean risk over all coverages (Geifman, Uziel and El-Yaniv 2019)."""
        return float(self.risk.mean())

    def at(self, coverage: float) -> float:
        """Risk of the surest `coverage` of all."""
        return float(self.risk[max(round(coverage * len(self.risk)), 1) - 1])


def bounded(relative_error: np.ndarray) -> np.ndarray:
    """Losses (n,) in [0, 1]: |e|^2 / |h|^2, where 1 (no better than silence) is as bad as it gets."""
    return np.minimum(relative_error, 1.0)


def risk_coverage(score: np.ndarray, loss: np.ndarray) -> RiskCoverage:
    """Accept by falling score (n,); equal scores share their mean loss (n,): their order cannot matter.

    Raises:
        ValueError: not as many scores as losses, or none.
    """
    if len(score) != len(loss) or not len(score):
        raise ValueError(f"expected as many scores as losses, and some: got {len(score)} and {len(loss)}")
    order = np.argsort(-score, kind="stable")
    sorted_score, sorted_loss = score[order], loss[order].astype(np.float64)
    _, group = np.unique(-sorted_score, return_inverse=True)
    shared = (np.bincount(group, sorted_loss) / np.bincount(group))[group]
    count = np.arange(1, len(score) + 1)
    return RiskCoverage(count / len(score), np.cumsum(shared) / count)


def perfect_area(loss: np.ndarray) -> float:
    """Area of a confidence that knows the losses (n,)."""
    return risk_coverage(-loss, loss).area


def rank_correlation(score: np.ndarray, loss: np.ndarray) -> float | None:
    """Spearman's correlation of being sure (n,) and being right, minus the loss (n,); None of a constant."""
    if np.ptp(score) == 0 or np.ptp(loss) == 0:
        return None
    return float(spearmanr(score, -loss).statistic)


How = Literal["random", "spatial"]
SHARES = (0.2, 0.4)  # of the positions that choose the kind and the levels, and that calibrate
MOST_LAX_DB = 6  # limit of an error that a hint may name: twice as large as what is predicted
CELLS = 6  # along each horizontal side; whole cells are calibrated on or tested


@dataclass(frozen=True)
class Trial:
    """What many calibration sets led to.

    Attributes:
        kind: confidence used.
        how: how positions were divided.
        realised: (draws,) share of bad ones among accepted test positions; NaN where none was accepted.
        coverage: (draws,) share of test positions accepted.
        alpha, delta: as promised.
    """

    kind: str
    how: How
    realised: np.ndarray
    coverage: np.ndarray
    alpha: float
    delta: float

    @property
    def silent(self) -> float:
        """Share of draws in which nobody was accepted: nothing was promised, so nothing was kept."""
        return float(np.isnan(self.realised).mean())

    @property
    def _spoke(self) -> np.ndarray:
        return self.realised[~np.isnan(self.realised)]

    @property
    def broken(self) -> float | None:
        """Share of draws in which more than alpha were bad, of those that accepted anybody; None of none.

        The promise is delta of *all* draws (`broken_of_all`). Where most accept nobody, those that do are
        the ones that chance flattered, and this share is larger.
        """
        return float((self._spoke > self.alpha).mean()) if len(self._spoke) else None

    @property
    def broken_of_all(self) -> float:
        """Share of all draws in which more than alpha of the accepted were bad: what delta bounds."""
        return float((self.realised > self.alpha).mean())  # NaN > alpha is False

    @property
    def interval(self) -> tuple[float, float] | None:
        """Clopper and Pearson's 95 % interval of `broken`, as if the draws were independent.

        They share their positions, so this is the least that chance allows for.
        """
        spoke = self._spoke
        return binomial_interval(int((spoke > self.alpha).sum()), len(spoke)) if len(spoke) else None

    @property
    def mean_realised(self) -> float | None:
        """Mean share of bad ones among accepted test positions."""
        return None if np.isnan(self.realised).all() else float(np.nanmean(self.realised))


def divided(
    evidence: Evidence, how: How, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disjoint rows of the evidence: to choose on, to calibrate on, to test on.

    `spatial` deals out whole cells of the plane, so that a test position has no calibrated neighbour but
    across a cell's border.

    Raises:
        ValueError: too few positions, or patches, for three parts.
    """
    unit = np.arange(len(evidence)) if how == "random" else cells(evidence.position)
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


def divisible(evidence: Evidence, how: How) -> bool:
    """Whether `divided` has three parts to give."""
    try:
        divided(evidence, how, np.random.default_rng(0))
    except ValueError:
        return False
    return True


def too_few(count: int, promise: Promise) -> str | None:
    """What is missing for any promise on so many positions; None where there are enough."""
    needed = int(np.ceil(promise.least / SHARES[1]))
    if count >= needed:
        return None
    return (
        f"{count} test positions can promise nothing: alpha={promise.alpha:g}, delta={promise.delta:g} need "
        f"{promise.least} good ones to calibrate on, {needed} in all; measure more, or promise less"
    )


def laxer(evidence: Evidence, promise: Promise, kind: str, spatial: bool, seed: int) -> Promise | None:
    """The same promise with the least larger limit, in whole decibels, that these positions keep; or None."""
    for limit in range(int(np.floor(promise.limit_db)) + 1, MOST_LAX_DB + 1):
        other = replace(promise, limit_db=float(limit))
        if np.isfinite(accept(evidence, other, kind, spatial, seed)[1].value):
            return other
    return None


def cells(position: np.ndarray) -> np.ndarray:
    """Which patch of the plane each position (n, 3) lies in: (n,) numbers from 0; on a plumb line, of it."""
    flat = position[:, :2] if np.ptp(position[:, :2], axis=0).any() else position[:, [2, 2]]
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    cell = np.minimum((flat - low) / np.where(extent > 0, extent, 1) * CELLS, CELLS - 1).astype(int)
    return np.unique(cell @ np.array([CELLS, 1]), return_inverse=True)[1].ravel()


def best_kind(evidence: Evidence, rows: np.ndarray) -> str:
    """The confidence of the smallest area under risk-coverage on `rows`."""
    loss = bounded(evidence.error[rows])
    return min(evidence.scores, key=lambda kind: risk_coverage(evidence.scores[kind][rows], loss).area)


def accept(
    evidence: Evidence, promise: Promise, kind: str, spatial: bool, seed: int | list[int], apart_m: float = 0
) -> tuple[str, Threshold, np.ndarray, np.ndarray]:
    """Confidence, threshold, and positions (indices of the evidence): unseen by both, and set aside.

    Raises:
        ValueError: `kind` is no confidence of this evidence.
    """
    rng = np.random.default_rng(seed)
    choose_on, calibrate, test = divided(evidence, "spatial" if spatial else "random", rng)
    used = best_kind(evidence, choose_on) if kind == "auto" else kind
    if used not in evidence.scores:
        raise ValueError(f"confidence={used}: expected auto or {', '.join(evidence.scores)}")
    score, bad = evidence.scores[used], promise.bad(evidence.error)
    calibrate = spread_out(evidence.position, calibrate, apart_m, rng)
    patch = cells(evidence.position)[calibrate] if spatial else None
    found = choose(score[calibrate], bad[calibrate], levels_of(score[choose_on]), promise, patch)
    return used, found, test, choose_on


def trials(
    evidence: Evidence, promise: Promise, how: How, draws: int, kind: str = "auto", apart_m: float = 0.0,
    seed: int = 0,
) -> Trial:  # fmt: skip
    """Resample `draws` calibration sets.

    Args:
        evidence: positions the method did not learn from.
        promise: what every threshold promises.
        how: `random` or `spatial` division.
        draws: calibration sets.
        kind: a confidence, or `auto`: the best on the positions set aside for choosing.
        apart_m: calibration positions nearer to each other than this are thinned [m].
        seed: of the draws.
    """
    realised, coverage, kinds = [], [], []
    bad = promise.bad(evidence.error)
    for draw in range(draws):
        used, found, test, _ = accept(evidence, promise, kind, how == "spatial", [seed, draw], apart_m)
        taken = test[evidence.scores[used][test] >= found.value]
        kinds.append(used)
        realised.append(bad[taken].mean() if len(taken) else np.nan)
        coverage.append(len(taken) / max(len(test), 1))
    most = max(set(kinds), key=kinds.count)
    return Trial(most, how, np.array(realised), np.array(coverage), promise.alpha, promise.delta)


NAMES = {
    "learned": "learned", "expected": "expected error", "distance": "distance to the nearest",
    "gp_variance": "GP variance",
}  # fmt: skip


def draw_calibration(evidence: Evidence, trials: list[Trial], title: str, path: Path) -> None:
    """Save both halves of the story as one PNG."""
    figure, ((left, right),) = panels(11, 4.2, 1, 2)
    loss = bounded(evidence.error)
    for kind, score in evidence.scores.items():
        curve = risk_coverage(score, loss)
        left.plot(curve.coverage, curve.risk, label=f"{NAMES[kind]}, area {curve.area:.3g}")
    knowing = risk_coverage(-loss, loss)
    left.plot(knowing.coverage, knowing.risk, "k:", label=f"knowing the errors, area {knowing.area:.3g}")
    left.set(xlabel="share of positions accepted", ylabel="mean error among them (|e|²/|h|², at most 1)")
    left.set_title(title)
    left.legend(fontsize=8)
    for trial, colour in zip(trials, ("tab:blue", "tab:orange"), strict=False):
        right.scatter(
            trial.coverage, trial.realised, s=9, alpha=0.4, color=colour,
            label=f"{trial.how}: broken in {trial.broken_of_all:.0%} of {len(trial.realised)} draws",
        )  # fmt: skip
    if trials:
        # a draw that accepts nobody has no share of bad ones: NaN
        worst = max(trials[0].alpha, *(np.nan_to_num(trial.realised).max() for trial in trials))
        right.set(xlim=(-0.02, 1.02), ylim=(-0.02 * worst, 1.1 * worst))
        if not any(trial.coverage.any() for trial in trials):
            right.text(0.5, 0.5 * worst, "no draw accepted anybody", ha="center")
        right.axhline(trials[0].alpha, color="black", linewidth=1)
        alpha, delta = trials[0].alpha, trials[0].delta
        right.set_title(f"promise: at most {alpha:.0%} bad, broken in at most {delta:.0%}")
    right.set(xlabel="share of test positions accepted", ylabel="realised share of bad ones among them")
    right.legend(fontsize=8)
    save(figure, path)


def collect(
    paths: list[str], dataset: dict[str, Any], split: dict[str, Any]
) -> tuple[Evidence, dict[str, Any]]:
    """Evidence of every checkpoint's own test rows, and the facts that name them; no row twice."""
    parts, seen = [], np.zeros(0, np.int64)
    facts: dict[str, Any] = {}
    for path in paths:
        run = _unseen(path, dataset, split)
        fold = run.split.folds[0]
        rows = np.setdiff1d(rows_of(fold, "test"), seen)
        if len(rows):
            parts.append(gather(run.methods[0], run.data, fold, rows))
        seen = np.concatenate([seen, rows])
        facts = facts or _published(run.methods[0], run.data, fold) | run.facts()
    return joined(parts), facts


def store(
    path: str,
    dataset: dict[str, Any],
    split: dict[str, Any],
    promise: Promise,
    kind: str,
    spatial: bool,
    seed: int,
) -> tuple[Trusted, str]:
    """Choose and calibrate on the checkpoint's own test rows, and keep it with the model; and how it went."""
    run = _unseen(path, dataset, split)
    method, data, fold = run.methods[0], run.data, run.split.folds[0]
    evidence = gather(method, data, fold, rows_of(fold, "test"))
    used, found, _, _ = accept(evidence, promise, kind, spatial, seed)
    threshold = threshold_of(used, found)
    stored = Trusted(used, threshold, promise, known_positions(data, fold), position_kernel(data, fold))
    keep(path, stored)
    if np.isfinite(threshold):
        return stored, f"accepted from {threshold:.4g}"
    if too_few(len(evidence), promise) is not None:
        return stored, "no threshold keeps the bound"
    bad, limit = promise.bad(evidence.error).mean(), f"{promise.limit_db:g} dB"
    other = laxer(evidence, promise, kind, spatial, seed)
    hint = (
        f"no limit_db= up to {MOST_LAX_DB} is" if other is None else f"limit_db={other.limit_db:g} would be"
    )
    return stored, (
        f"no threshold keeps the bound: {bad:.0%} of {len(evidence)} test positions are worse than {limit}, "
        f"and the others are not told from them surely enough; {hint} kept, more training rows may help"
    )


def _unseen(path: str, dataset: dict[str, Any], split: dict[str, Any]) -> Opened:
    """A checkpoint with test rows that it has not learned from: on others no promise would hold."""
    run = open_files([path], dataset, split)
    if run.learned != 0:
        advice = "calibrate with the data and split of its training"
        raise ValueError(f"{path} was trained on {run.foreign}; {advice}")
    return run


def _published(method: Method, data: Measurements, fold: Fold) -> dict[str, float]:
    """`peers/*` and `denormalised/*` of Argos data: the figures under both normalisations, all test rows."""
    if data.uplink is None:
        return {}
    batches = (data.batch(fold.test[i : i + CHUNK]) for i in range(0, len(fold.test), CHUNK))
    predicted = np.concatenate([method.answer(batch).mean.numpy() for batch in batches])
    target = data.target[fold.test]
    both = {"peers": published_normalisation(data.target, fold.train), "denormalised": (0j, 1.0)}
    found = {room: published_figures(predicted, target, *removed) for room, removed in both.items()}
    return {f"{room}/{name}": value for room, one in found.items() for name, value in one.items()}


def figures(evidence: Evidence, found: list[Trial], promise: Promise) -> dict[str, Any]:
    """Flat figures: `confidence/<kind>/*`, `promise/*`, `trial/<how>/*`."""
    loss = bounded(evidence.error)
    facts: dict[str, Any] = {"positions": len(evidence), "confidence/perfect/area": perfect_area(loss)}
    curves = {kind: risk_coverage(score, loss) for kind, score in evidence.scores.items()}
    bar = curves["distance"].area
    for kind, curve in curves.items():
        own = {
            "area": curve.area, "risk_at_70": curve.at(0.7),
            "rank_correlation": rank_correlation(evidence.scores[kind], loss),
            "area_below_distance": 1 - curve.area / bar if bar > 0 else None,  # nothing to save
        }  # fmt: skip
        facts |= {f"confidence/{kind}/{name}": value for name, value in own.items()}
    facts |= {f"promise/{name}": value for name, value in vars(promise).items()}
    for trial in found:
        low, high = trial.interval or (None, None)
        came = {
            "kind": trial.kind, "broken": trial.broken, "broken_low": low, "broken_high": high,
            "broken_of_all": trial.broken_of_all, "silent": trial.silent, "realised": trial.mean_realised,
            "coverage": float(trial.coverage.mean()), "draws": len(trial.realised),
        }  # fmt: skip
        facts |= {f"trial/{trial.how}/{name}": value for name, value in came.items()}
    return facts
