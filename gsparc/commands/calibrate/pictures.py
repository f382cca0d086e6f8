"""Risk-coverage curves, and what 200 calibration sets led to."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.commands.calibrate.curves import bounded, risk_coverage
from gsparc.commands.calibrate.trial import Trial
from gsparc.evaluation.drawing import panels, save
from gsparc.prediction.confidence_scores import Evidence

NAMES = {
    "learned": "learned", "expected": "expected error", "distance": "distance to the nearest",
    "gp_variance": "GP variance",
}  # fmt: skip


def draw(evidence: Evidence, trials: list[Trial], title: str, path: Path) -> None:
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
