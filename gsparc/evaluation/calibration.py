"""Risk against coverage, and whether promises hold: thresholds of many draws, tried on other rows."""

from __future__ import annotations

from collections.abc import Sequence
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
from gsparc.models.method import Method, predictions
from gsparc.prediction.confidence import (
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
    Guarantee,
    Threshold,
    binomial_interval,
    choose,
    levels_of,
    spread_out,
)


def bounded(relative_error: np.ndarray) -> np.ndarray:
    """Losses (n,) in [0, 1]: |e|^2 / |h|^2, where 1 (no better than silence) is as bad as it gets."""
    return np.minimum(relative_error, 1.0)


def risk_coverage(score: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Mean loss of the 1, 2, ..., n surest of n predictions, (n,).

    Its mean is the area under risk against coverage (Geifman, Uziel and El-Yaniv 2019). Equal scores share
    their mean loss: their order cannot matter.

    Args:
        score: (n,), larger is surer.
        loss: (n,).
    """
    order = np.argsort(-score, kind="stable")
    _, group = np.unique(-score[order], return_inverse=True)
    shared = (np.bincount(group, loss[order].astype(np.float64)) / np.bincount(group))[group]
    return np.cumsum(shared) / np.arange(1, len(score) + 1)


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
        alpha: largest share of bad ones that was guaranteed.
    """

    kind: str
    how: How
    realised: np.ndarray
    coverage: np.ndarray
    alpha: float

    def facts(self) -> dict[str, Any]:
        """Figures over the draws; None of those that nothing was accepted in.

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


def too_few(count: int, promise: Guarantee) -> str | None:
    """What is missing for any promise on so many positions; None where there are enough."""
    needed = int(np.ceil(promise.least / SHARES[1]))
    if count >= needed:
        return None
    return (
        f"{count} test positions can promise nothing: alpha={promise.alpha:g}, delta={promise.delta:g} need "
        f"{promise.least} good ones to calibrate on, {needed} in all; measure more, or promise less"
    )


def laxer(evidence: Evidence, promise: Guarantee, kind: str, spatial: bool, seed: int) -> Guarantee | None:
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
    return min(evidence.scores, key=lambda kind: risk_coverage(evidence.scores[kind][rows], loss).mean())


def accept(
    evidence: Evidence,
    promise: Guarantee,
    kind: str,
    spatial: bool,
    seed: int | list[int],
    apart_m: float = 0,
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
    threshold = choose(score[calibrate], bad[calibrate], levels_of(score[choose_on]), promise, patch)
    return used, threshold, test, choose_on


def trials(
    evidence: Evidence, promise: Guarantee, how: How, draws: int, kind: str = "auto", apart_m: float = 0.0,
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
        used, threshold, test, _ = accept(evidence, promise, kind, how == "spatial", [seed, draw], apart_m)
        accepted = test[evidence.scores[used][test] >= threshold.value]
        kinds.append(used)
        realised.append(bad[accepted].mean() if len(accepted) else np.nan)
        coverage.append(len(accepted) / max(len(test), 1))
    most = max(set(kinds), key=kinds.count)
    return Trial(most, how, np.array(realised), np.array(coverage), promise.alpha)


NAMES = {
    "learned": "learned", "expected": "expected error", "distance": "distance to the nearest",
    "gp_variance": "GP variance",
}  # fmt: skip


def draw_calibration(
    evidence: Evidence, trials: Sequence[Trial], promise: Guarantee, title: str, path: Path
) -> None:
    """Save risk against coverage, and what came of the draws, as one PNG."""
    figure, ((left, right),) = panels(11, 4.2, 1, 2)
    loss = bounded(evidence.error)
    coverage = np.arange(1, len(loss) + 1) / len(loss)
    for kind, score in evidence.scores.items():
        risk = risk_coverage(score, loss)
        left.plot(coverage, risk, label=f"{NAMES[kind]}, area {risk.mean():.3g}")
    risk = risk_coverage(-loss, loss)
    left.plot(coverage, risk, "k:", label=f"knowing the errors, area {risk.mean():.3g}")
    left.set(xlabel="share of positions accepted", ylabel="mean error among them (|e|²/|h|², at most 1)")
    left.set_title(title)
    for trial, colour in zip(trials, ("tab:blue", "tab:orange"), strict=False):
        broken = trial.facts()["broken_of_all"]
        label = f"{trial.how}: broken in {broken:.0%} of {len(trial.realised)} draws"
        right.scatter(trial.coverage, trial.realised, s=9, alpha=0.4, color=colour, label=label)
    # a draw that accepts nobody has no share of bad ones: NaN
    worst = max(promise.alpha, *(np.nan_to_num(trial.realised).max() for trial in trials))
    right.set(xlim=(-0.02, 1.02), ylim=(-0.02 * worst, 1.1 * worst))
    if not any(trial.coverage.any() for trial in trials):
        right.text(0.5, 0.5 * worst, "no draw accepted anybody", ha="center")
    right.axhline(promise.alpha, color="black", linewidth=1)
    right.set_title(f"promise: at most {promise.alpha:.0%} bad, broken in at most {promise.delta:.0%}")
    right.set(xlabel="share of test positions accepted", ylabel="realised share of bad ones among them")
    for axis in (left, right):
        axis.legend(fontsize=8)
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
    promise: Guarantee,
    kind: str,
    spatial: bool,
    seed: int,
) -> tuple[Trusted, str]:
    """Choose and calibrate on the checkpoint's own test rows, and keep it with the model; and how it went."""
    run = _unseen(path, dataset, split)
    method, data, fold = run.methods[0], run.data, run.split.folds[0]
    evidence = gather(method, data, fold, rows_of(fold, "test"))
    kind_used, choice, _, _ = accept(evidence, promise, kind, spatial, seed)
    threshold = threshold_of(kind_used, choice)
    stored = Trusted(kind_used, threshold, promise, known_positions(data, fold), position_kernel(data, fold))
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
    predicted = np.concatenate([said.mean.numpy() for _, _, said in predictions(method, data, fold.test)])
    target = data.target[fold.test]
    both = {"peers": published_normalisation(data.target, fold.train), "denormalised": (0j, 1.0)}
    results = {room: published_figures(predicted, target, *removed) for room, removed in both.items()}
    return {f"{room}/{name}": value for room, one in results.items() for name, value in one.items()}


def figures(evidence: Evidence, trials: Sequence[Trial], promise: Guarantee) -> dict[str, Any]:
    """Flat figures: `confidence/<kind>/*`, `promise/*`, `trial/<how>/*`."""
    loss = bounded(evidence.error)
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
    facts |= {f"promise/{name}": value for name, value in vars(promise).items()}
    for trial in trials:
        facts |= {f"trial/{trial.how}/{name}": value for name, value in trial.facts().items()}
    return facts
