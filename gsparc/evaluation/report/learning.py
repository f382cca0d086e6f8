"""Accuracy against the seconds it took to learn."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from gsparc.evaluation.figures import form_of, heading_of, score_of
from gsparc.evaluation.report.runs import Run, number
from gsparc.evaluation.report.table import Column, Table

MINUTES = (1, 2, 5, 10)


def within_minutes(runs: Sequence[Run]) -> Table:
    """The best validation figure reached within fixed training times, and the time to fixed figures."""
    figure = validation_figure(runs[0])
    head = heading_of(figure)
    table = Table(
        "Accuracy against training time",
        [
            Column("method and setting"), Column("seed", "d"),
            *(Column(f"{head} within {m} min", form_of(figure)) for m in MINUTES),
            *(Column(f"s to {level:.4g}", ".3g") for level in levels(runs)),
            Column("train s in all", ".3g"),
        ],
        note="Validation rows; seconds of learning with preparation, without validation. Methods that train "
        "in one piece have no curve: their test figure counts from the end of their training.",
    )  # fmt: skip
    for run in runs:
        seconds, values = curve(run)
        if not len(seconds):
            continue
        best = np.array([score_of(figure, v) for v in values])
        early = [seconds <= 60 * minutes for minutes in MINUTES]
        cells = [float(values[t][best[t].argmax()]) if t.any() else None for t in early]
        good = [best >= score_of(figure, level) for level in levels(runs)]
        reached = [float(seconds[t.argmax()]) if t.any() else None for t in good]
        table.add(run.setting, run.facts.get("seed"), *cells, *reached, run.facts.get("time/train_s"))
    return table


def validation_figure(run: Run) -> str:
    """The figure of a learning curve: validation of channels and powers logs the mean squared error."""
    return "psnr_db" if run.kind == "spectrum" else "mse"


def curve(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (n,) and validation figures (n,); one point for a method that trains in one piece."""
    figure = validation_figure(run)
    found = run.curve.get(f"val/{figure}")
    if found is not None and np.isfinite(found).any():
        known = np.isfinite(found)
        return run.curve["train_s"][known], found[known]
    end, value = number(run.facts.get("time/train_s")), run.figure_of(figure)
    if end is None or value is None:
        return np.zeros(0), np.zeros(0)
    return np.array([end]), np.array([value])


def levels(runs: Sequence[Run], count: int = 3) -> list[float]:
    """Round figures between what the worst and the best run reach, the worst first."""
    score = partial(score_of, validation_figure(runs[0]))
    ends = [max(curve(run)[1], key=score) for run in runs if len(curve(run)[0])]
    if not ends:
        return []
    worst, best = min(ends, key=score), max(ends, key=score)
    if abs(best - worst) < 1e-9 * max(abs(best), 1e-9):
        return [float(f"{worst:.3g}")]
    between = {float(f"{v:.3g}") for v in np.linspace(worst, best, count + 2)[:-1]}
    return sorted(between, key=score)[:count]
