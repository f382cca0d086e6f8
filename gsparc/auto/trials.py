"""Candidates tried on inner folds: what each predicts of rows left out, and what that cost."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsparc.auto.mixture import judged, judged_variance
from gsparc.data.inner_folds import InnerFolds
from gsparc.data.schema import Measurements
from gsparc.methods.censored import heard
from gsparc.methods.method import FitContext, Method
from gsparc.methods.time_budget import Clock, less_repeatable

MOST_ROWS = 2_000  # of a fold that are predicted, drawn evenly
MOST_ENTRIES = 2_048  # of a target that are looked at, evenly spaced
CHUNK = 64  # rows predicted at a time
REFUSALS = (
    ValueError,
    RuntimeError,
    NotImplementedError,
)  # of data that a method does not serve, or diverged
QUIET = ("gsparc", "lightning.pytorch")  # who say of a trial what they will say of the fit


@dataclass(frozen=True)
class Asked:
    """Rows of a fold that were left out and are predicted.

    Attributes:
        row: (n,) of the measurements.
        target: (n, D) in the unit that is judged.
        measured: (n, D) bool.
    """

    row: np.ndarray
    target: Tensor
    measured: Tensor


@dataclass
class Trial:
    """What a candidate did on the folds that it was tried on.

    Attributes:
        name: of the candidate.
        residual: of each fold (n, D), measured less predicted, 0 where nothing was measured.
        variance: of each fold (n,), in the judged unit; None where it says none.
        seconds: of each fit and its predictions, by the clock of the budget [s].
        over_s: the most that one took beyond the seconds it was given [s].
        limited_by: see `FitReport`.
        method: as the last of the fits left it.
        refusal: why it does not serve these data; None where it does.
        stopped: whether it was given up as clearly worse.
    """

    name: str
    residual: list[Tensor] = field(default_factory=list)
    variance: list[Tensor | None] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    over_s: float = 0.0
    limited_by: Clock | None = None
    method: Method | None = None
    refusal: str | None = None
    stopped: bool = False

    @property
    def usable(self) -> bool:
        """Whether it may be chosen."""
        return self.refusal is None and not self.stopped and bool(self.residual)


@dataclass(frozen=True)
class Course:
    """Where candidates are tried.

    Attributes:
        data: measurements.
        inner: the folds.
        asked: of each fold.
    """

    data: Measurements
    inner: InnerFolds
    asked: tuple[Asked, ...]

    def units(self, folds: int) -> np.ndarray:
        """Units (n,) of the rows asked for in the first so many folds."""
        return np.concatenate([self.inner.unit[one.row] for one in self.asked[:folds]])

    def powers(self, folds: int) -> float:
        """Mean square of an entry of the targets of these rows."""
        every = [one.target.abs().square()[one.measured] for one in self.asked[:folds]]
        return float(torch.cat(every).double().mean())


def course(data: Measurements, inner: InnerFolds, seed: int) -> Course:
    """The rows of each fold that candidates predict: what was heard, of many an even draw.

    Raises:
        ValueError: nothing was heard in any fold.
    """
    folds, asked = [], []
    for number, fold in enumerate(inner.folds):
        rows = heard(data, fold.test)
        if len(rows) > MOST_ROWS:
            rows = np.sort(np.random.default_rng([seed, number, 6]).permutation(rows)[:MOST_ROWS])
        if data.mask is not None:
            rows = rows[data.mask[rows].reshape(len(rows), -1).any(1)]
        if len(rows):
            chosen = _entries(data)
            mask = (
                np.ones((len(rows), *data.target.shape[1:]), bool) if data.mask is None else data.mask[rows]
            )
            target = judged(data.targets(rows), data.site.kind)[:, chosen]
            asked.append(Asked(rows, target, torch.from_numpy(mask).flatten(1)[:, chosen]))
            folds.append(fold)
    if not asked:
        raise ValueError("auto: nothing was heard in the rows to choose on; name one model")
    return Course(data, replace(inner, folds=tuple(folds)), tuple(asked))


def attempt(trial: Trial, make: Callable[[], Method], course: Course, context: FitContext) -> None:
    """Fit a fresh candidate on the next fold and predict what is left out; refusals are kept in `trial`."""
    number = len(trial.residual)
    asked = course.asked[number]
    try:
        with tempfile.TemporaryDirectory() as aside, _quiet():  # what a trial writes is no part of the run
            method = make()
            own = replace(
                context, run_dir=Path(aside), resume=None, init_from=None, datamodule=None, callbacks=tuple,
                loggers=(),
            )  # fmt: skip
            report = method.fit(course.data, course.inner.folds[number], own)
            predicted, variance = _predicted(method, course.data, asked.row)
    except KeyboardInterrupt:  # its advice would name a file of the trial, which is gone
        said = f"auto was interrupted while it tried {trial.name}; there is no checkpoint yet"
        raise KeyboardInterrupt(said) from None
    except REFUSALS as refused:
        trial.refusal = str(refused).strip().partition("\n")[0] or type(refused).__name__
        return
    residual = torch.where(asked.measured, asked.target - predicted, 0)
    if not torch.isfinite(residual.abs()).all():
        trial.refusal = f"{trial.name}: predicts numbers that are not finite"
        return
    trial.residual.append(residual)
    trial.variance.append(variance)
    trial.method = method
    trial.limited_by = less_repeatable(trial.limited_by, report.limited_by)


def products(trials: Sequence[Trial], course: Course, folds: int) -> np.ndarray:
    """Mean products (n, K, K) of the errors of K trials per measured entry, of the first so many folds."""
    found = []
    for number in range(folds):
        stack = torch.stack([trial.residual[number] for trial in trials], 1)
        stack = stack.to(torch.complex128 if stack.is_complex() else torch.float64)
        gram = (stack @ stack.mH).real
        found.append(gram / course.asked[number].measured.sum(1)[:, None, None])
    return torch.cat(found).numpy()


def variances(trials: Sequence[Trial], errors: Sequence[float], folds: int) -> np.ndarray:
    """Variances (n, K) that trials said of their predictions; the left-out error where they said none."""
    columns = []
    for trial, error in zip(trials, errors, strict=True):
        parts = zip(trial.variance[:folds], trial.residual, strict=False)
        said = [torch.full((len(r),), error, dtype=torch.float64) if v is None else v for v, r in parts]
        columns.append(torch.cat(said).double())
    return torch.stack(columns, 1).numpy()


def _entries(data: Measurements) -> slice:
    count = int(np.prod(data.target.shape[1:]))
    return slice(None, None, -(-count // MOST_ENTRIES))


@torch.no_grad()
def _predicted(method: Method, data: Measurements, rows: np.ndarray) -> tuple[Tensor, Tensor | None]:
    """Rows (n, D) and variances (n,) in the judged unit; None where the method says none."""
    kind, chosen = data.site.kind, _entries(data)
    means, said = [], []
    for start in range(0, len(rows), CHUNK):
        found = method.answer(data.batch(rows[start : start + CHUNK]))
        means.append(judged(found.mean, kind)[:, chosen])
        if found.variance is not None:
            said.append(judged_variance(found.variance, found.mean, kind).double())
    variance = torch.cat(said) if len(said) == len(means) else None
    if variance is not None and not torch.isfinite(variance).all():
        variance = None
    return torch.cat(means), variance


@contextmanager
def _quiet() -> Iterator[None]:
    """Nothing but warnings while it lasts."""
    loggers = [logging.getLogger(name) for name in QUIET]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
