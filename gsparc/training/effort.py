"""What a fit counts before it ends: the same on every machine, however busy it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from gsparc.base.limits import SettingError

LEAST_ROWS = 150  # that settings are chosen on, however little the effort
GONE = ("budget_s", "budget_clock", "budgets")
INSTEAD = (
    "no seconds end a fit: effort=.3 counts less (gsparc compare: efforts=[.3]), rounds_s= ends "
    "timings,"
)
INSTEAD += " trainer.max_time=00:00:01:00 ends gradient steps after a minute"


@dataclass(frozen=True)
class Effort:
    """How much a fit counts before it ends.

    Attributes:
        chosen_on: rows that settings are chosen on, of more; each look at them factors a
            covariance.
        term_rows: rows that powers of the terms of a channel field are learned on.
        evaluations: of a search for sources: factors of covariances and blocks of candidates.
        restarts: of spectra that no neighbour solves, times the starts of each.
        steps, steps_after_solving: of gradient, where neither model nor Trainer is given a number;
            after a start in closed form.
        factor: of all of it, for what counts by itself.
    """

    chosen_on: int = 1_000
    term_rows: int = 400
    evaluations: int = 3_000
    restarts: int = 100_000
    steps: int = 400
    steps_after_solving: int = 60
    factor: float = 1.0

    def scale_by(self, factor: float) -> Effort:
        """Return all of it times `factor`; rows times its cube root,
        as a covariance of n rows takes n^3.
        """
        counts = {
            setting_field.name: factor * getattr(self, setting_field.name)
            for setting_field in fields(self)
        }
        rows = {name: max(factor ** (1 / 3) * getattr(self, name), LEAST_ROWS) for name in ROWS}
        whole = {name: max(round(count), 1) for name, count in {**counts, **rows}.items()}
        return Effort(**{**whole, "factor": counts["factor"]})  # type: ignore[arg-type]


ROWS = ("chosen_on", "term_rows")


def refuse_seconds(settings: Mapping[str, Any]) -> None:
    """Raise a `SettingError` where a setting, by its dotted name, gives a fit seconds."""
    for name, value in settings.items():
        if name.rpartition(".")[2] in GONE and value is not None:
            raise SettingError(f"{name}={value}: {INSTEAD}")
