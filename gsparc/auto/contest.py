"""Candidates tried in turn on inner folds, within seconds, the clearly worse ones given up early."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gsparc.auto.trials import Course, Trial, attempt, products
from gsparc.data.schema import Kind
from gsparc.methods import stacking
from gsparc.methods.method import FitContext, Method
from gsparc.methods.time_budget import TimeBudget

log = logging.getLogger(__name__)

LEAST_S = 0.5  # seconds below which no such candidate is fitted
LEAST_SHARE = 0.3  # of the seconds of its first trial, below which a candidate is tried no further
MARGIN = 0.04  # of the budget that is kept back: seconds are not kept to exactly
FIGURE: dict[Kind, str] = {"rssi": "rmse {:.3g} dB", "csi": "nmse {:.3g}", "spectrum": "mse {:.3g}"}


class Contest:
    """Candidates tried one after the other, within the seconds of a budget.

    Args:
        way: where.
        context: of every trial but for its seconds.
        budget: of everything, the fits of what is chosen included.
    """

    def __init__(self, way: Course, context: FitContext, budget: TimeBudget) -> None:
        self.way, self.context, self.budget = way, context, budget
        self.trials: list[Trial] = []

    def left(self, reserved: float = 0.0) -> float:
        """Seconds that are left [s]."""
        return self.budget.seconds * (1 - MARGIN) - self.budget.spent - reserved

    def try_out(self, name: str, make: Callable[[], Method], waiting: int = 0) -> None:
        """Fit a candidate on the folds, as long as it is worth it.

        Args:
            name: of the candidate.
            make: a fresh one.
            waiting: candidates whose seconds can be chosen, this one included; 0: this one's cannot be.
        """
        trial, folds = Trial(name), len(self.way.asked)
        self.trials.append(trial)
        share = self.left(self._final_s()) / max(waiting, 1) if waiting else math.inf
        share = min(share, self.left()) if math.isfinite(self.budget.seconds) else share
        before = self.budget.spent
        while len(trial.residual) < folds and trial.refusal is None and not trial.stopped:
            rest = share - (self.budget.spent - before)  # of which the fit to all rows is to have its part
            seconds = self._seconds(trial, rest, folds) if waiting else None
            if self._too_long(trial, rest, seconds):
                break
            began = self.budget.spent
            if seconds is not None:
                log.info(
                    "auto: %s: fold %d of %d, about %.0f s; %.0f s are left in all", trial.name,
                    len(trial.residual) + 1, folds, seconds, max(self.budget.seconds - began, 0.0),
                )  # fmt: skip
            attempt(trial, make, self.way, replace(self.context, budget_s=seconds))
            trial.seconds.append(self.budget.spent - began)
            trial.over_s = max(trial.over_s, trial.seconds[-1] - (seconds or 0.0))
            first = trial.refusal is None and len(trial.residual) == 1
            trial.stopped = first and self._clearly_worse(trial)
            if first and waiting == 1 and folds > 1 and self._settled(trial):
                log.info("auto: %s: clearly better than all others, tried no further", trial.name)
                break
        self._log_trial(trial)

    def _seconds(self, trial: Trial, rest: float, folds: int) -> float:
        """Of the next fit [s], so that those that follow, and one to all rows, have as many.

        What the first one takes beyond its seconds is not known before: it gets less.
        """
        coming = folds - len(trial.residual) + 1
        return rest / coming - trial.over_s if trial.residual else rest / (coming + 1)

    def _too_long(self, trial: Trial, rest: float, seconds: float | None) -> bool:
        """Whether the trials of a candidate end here for want of seconds."""
        if seconds is not None:
            first = trial.seconds[0] - trial.over_s if trial.seconds else 0.0
            short = seconds < max(LEAST_S, LEAST_SHARE * first)
        else:
            short = rest < 2 * max(trial.seconds, default=0.0) or rest <= 0
        self.budget.limited |= short
        return short

    def _final_s(self) -> float:
        """Seconds that the fit of the best so far will take [s], where they cannot be chosen."""
        best = self._best()
        return 0.0 if best is None else 1.5 * max(best.seconds)

    def _best(self, other: Trial | None = None) -> Trial | None:
        usable = [trial for trial in self.trials if trial.usable and trial is not other]
        return min(usable, key=lambda trial: float(self._squares([trial])[:, 0, 0].mean()), default=None)

    def _squares(self, trials: Sequence[Trial]) -> np.ndarray:
        return products(trials, self.way, min(len(trial.residual) for trial in trials))

    def _clearly_worse(self, trial: Trial) -> bool:
        best = self._best(other=trial)
        if best is None or len(self.way.asked) == 1:
            return False
        return self._behind(trial, best)

    def _settled(self, trial: Trial) -> bool:
        """Whether all others are clearly worse: its fit to all rows has the seconds of more folds."""
        others = [one for one in self.trials if one.usable and one is not trial]
        return bool(others) and trial.usable and all(self._behind(one, trial) for one in others)

    def _behind(self, trial: Trial, best: Trial) -> bool:
        gram = self._squares([trial, best])
        units = self.way.units(min(len(trial.residual), len(best.residual)))
        return stacking.clearly_worse(gram[:, 0, 0], gram[:, 1, 1], gram[:, 0, 1], units)

    def _log_trial(self, trial: Trial) -> None:
        """One line of what was found."""
        if trial.refusal is not None:
            log.debug("%s: %s", trial.name, trial.refusal)
            return
        done = len(trial.residual)
        if not done:
            log.info("auto: %s: no time was left for it", trial.name)
            return
        error = float(self._squares([trial])[:, 0, 0].mean())
        stopped = ", given up as clearly worse" if trial.stopped else ""
        log.info(
            "auto: %s: %s left out (%d of %d folds, %.1f s%s)",
            trial.name, figure_of(self.way, error, done), done, len(self.way.asked), sum(trial.seconds),
            stopped,
        )  # fmt: skip


def figure_of(way: Course, error: float, folds: int) -> str:
    """A mean squared error in the unit that is judged, as people read it."""
    kind = way.data.site.kind
    value = {"rssi": math.sqrt(error), "csi": error / max(way.powers(folds), 1e-300), "spectrum": error}[kind]
    return FIGURE[kind].format(value)
