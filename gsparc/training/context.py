"""What a fit is given (`FitContext`), and what it says of itself (`FitReport`)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from gsparc.base.limits import POSITIVE, Checked, choice, setting, whole
from gsparc.data.split_settings import FileSettings, SplitSettings
from gsparc.data.splits import Fold
from gsparc.training import curve
from gsparc.training.cost import LINE, NO_COST, Cost
from gsparc.training.effort import Effort
from gsparc.training.race import Race

if TYPE_CHECKING:
    # Imports Lightning, which a loaded model does without
    from gsparc.datasets.datamodule import DataModule

log = logging.getLogger(__name__)

StationModels = Literal["auto", "each", "together"]


@dataclass(frozen=True)
class FitReport:
    """What fitting cost.

    Attributes:
        seconds: that it took, validations too [s].
        notes: what a reader must know (early stop, dropped components), one line each.
        cost: of each stage.
        cpu_s: processor seconds, of all threads [s]; a method says those alone that were spent
            elsewhere, as by the run that it went on from: `fit_or_resume` adds what it took here.
    """

    seconds: float
    notes: tuple[str, ...] = ()
    cost: Cost = NO_COST
    cpu_s: float = 0.0

    def with_cost(self, cost: Cost) -> FitReport:
        """Return the report with its stages, which are logged."""
        log.info(LINE.format(of_what="", cost=cost.describe()))
        return replace(self, cost=cost)


@dataclass(frozen=True)
class FitContext(Checked):
    """What a run brings along to a fit.

    Attributes:
        run_dir: where the fit may write; empty: nowhere.
        seed: of whatever is random and has no seed of its own.
        effort: that all counts of `Effort` are multiplied by.
        stations: of several, whether `each` has a model or all are one's `together`; `auto` as the
            method's `choose_stations` says.
        split: how the test rows were cut off, for choosing on rows cut off alike; None: at random.
        leave_out: groups of training rows; searches leave them out by turns, for errors of rows
            held out.
        race: the best of other solutions on these groups: searches end that fall behind.
        beside: solutions that were fitted before this one, by name.
        fold: what is learned, in the run's own numbers of rows; None: the fold that a method is
            given.
        resume: what an interrupted run left, to go on from: a file, or the folder of a run of
            parts.
        init_from: a checkpoint of the same model whose weights training starts from.
        batch_size: rows of a step of gradient training, where no `datamodule` says so.
        datamodule: the run's `DataModule`, whose loaders gradient training on its measurements goes
            through.
        trainer: makes a Lightning Trainer from further options; None: as
            `gsparc.field.gradient_stage` does.
        callbacks: makes fresh Lightning callbacks.
        loggers: made once per run, closed by the caller.
        terms: further terms of powers (`gsparc.processes.term.Columns`).
        config_yaml: the whole configuration, stored in every checkpoint.

    Raises:
        ValueError: an effort that is not positive, unknown `stations`, or a batch without rows.
    """

    run_dir: Path = Path()
    seed: int = 0
    effort: float = setting(1.0, POSITIVE)
    stations: StationModels = setting("auto", choice(*get_args(StationModels)))
    split: SplitSettings | FileSettings | None = None
    leave_out: tuple[np.ndarray, ...] = ()
    race: Race | None = None
    beside: Mapping[str, Any] = field(default_factory=dict)
    fold: Fold | None = None
    resume: Path | None = None
    init_from: Path | None = None
    batch_size: int = setting(16, whole(1))
    datamodule: DataModule | None = None
    trainer: partial[Any] | None = None
    callbacks: Callable[[], Sequence[Any]] = tuple
    loggers: Sequence[Any] = ()
    terms: tuple[Any, ...] = ()
    config_yaml: str = ""

    def for_part(self, folder: str, **changes: Any) -> FitContext:
        """Return the context of a part of the fit,
        which may write to a folder of its own in `run_dir`.
        """
        changes = {"fold": None, **changes}
        if self.loggers:
            from gsparc.training.tracking import PartLogger  # imports Lightning

            changes = {
                "loggers": [PartLogger(logger, folder) for logger in self.loggers],
                **changes,
            }
        # No folder stays none: below an empty path lies the working directory.
        return replace(
            self, run_dir=self.run_dir / folder if self.run_dir != Path() else Path(), **changes
        )

    def log_curve(
        self,
        seconds: float,
        what: str,
        error: float | None = None,
        step: int | None = None,
        **figures: Any,
    ) -> None:
        """Add a point to the learning curve, in the folder and the loggers;
        see `curve.curve_row`.
        """
        row = curve.curve_row(seconds, what, error, step, **figures)
        # All rows again: a file that appears by renaming cannot be appended to.
        curve.write_curve(self.run_dir, [*curve.read_curve(self.run_dir), row])
        curve.log_row(self.loggers, row)

    @property
    def counts(self) -> Effort:
        """What a fit counts before it ends."""
        return Effort().scale_by(self.effort)

    def requested_steps(self, rows: int, model_steps: int | None = None) -> int | None:
        """Return the number of steps that the Trainer is given, else the model's own;
        None where neither is.

        Args:
            rows: that are learned from, for epochs.
            model_steps: as the model is configured; gives way to the Trainer's.

        Raises:
            ValueError: the Trainer is given what is no number of steps.
        """
        options = {} if self.trainer is None else self.trainer.keywords
        steps, epochs = (
            None if options.get(n) == -1 else options.get(n) for n in ("max_steps", "max_epochs")
        )
        for name, value in (("max_steps", steps), ("max_epochs", epochs)):
            if value is not None and (type(value) is not int or value < 0):
                raise ValueError(
                    f"trainer.{name}={value!r}: a whole number of at least 0 is needed, or -1"
                )
        if model_steps == 0 or (steps is None and epochs is None):  # 0 of either is the start alone
            return model_steps
        if model_steps is not None:
            log.warning(
                "model.steps=%d gives way to the Trainer's max_steps or max_epochs", model_steps
            )
        size = self.batch_size if self.datamodule is None else self.datamodule.batch_size
        of_epochs = None if epochs is None else epochs * -(-rows // size)
        return min(limit for limit in (steps, of_epochs) if limit is not None)
