"""What one method has more than another on the same rows or draws of a split, with its standard error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import t

from gsparc.evaluation.metric_formats import WITH_SILENT

LEVEL = 0.95  # of the interval that must not hold 0
SAME_DB = 0.005  # less is 0 in the two decimals of a table


@dataclass(frozen=True)
class Lead:
    """A difference of scores, larger is better, and how well it is known.

    Rows count as independent, which neighbours are not: their error is a lower bound.

    Attributes:
        ahead_db: mean difference over pairs [dB].
        error_db: its standard error; NaN of a single pair [dB].
        count: of the pairs.
        of: what they are: `test rows`.
    """

    ahead_db: float
    error_db: float
    count: int
    of: str

    @staticmethod
    def from_gains(gains: np.ndarray, of: str) -> Lead:
        """Return the mean of differences (n,) of pairs that are `of` rows or draws."""
        error = gains.std(ddof=1) / len(gains) ** 0.5 if len(gains) > 1 else np.nan
        return Lead(float(gains.mean()), float(error), len(gains), of)

    @staticmethod
    def from_facts(facts: Mapping[str, Any], stem: str) -> Lead | None:
        """Return what `facts` stored under `stem`; None where a summary has none."""
        ahead, error = facts.get(f"{stem}_db"), facts.get(f"{stem}_error_db")
        if ahead is None or error is None:
            return None
        count, _, of = str(facts[f"{stem}_pairs"]).partition(" ")
        return Lead(ahead, error, int(count), of)

    def facts(self) -> dict[str, Any]:
        """Return it as values of a summary, by the ends of their names."""
        return {"_db": self.ahead_db, "_error_db": self.error_db, "_pairs": self.pairs}

    @property
    def pairs(self) -> str:
        """Return how many, of what: `32 test rows`."""
        return f"{self.count} {self.of}"

    @property
    def same(self) -> bool:
        """Whether both have the same figures in every pair."""
        return abs(self.ahead_db) < SAME_DB and not self.error_db >= SAME_DB

    @property
    def sure(self) -> bool:
        """Whether its 95 % interval (Student's t) leaves out 0: few draws tell their scatter badly."""
        reach = t.ppf((1 + LEVEL) / 2, max(self.count - 1, 1)) * self.error_db
        return not self.same and bool(abs(self.ahead_db) > reach)  # False where it is not known

    def __str__(self) -> str:
        error = "" if np.isnan(self.error_db) else f" ± {self.error_db:.2f}"
        return f"{self.ahead_db:.2f}{error} dB better over {self.pairs}"

    def __neg__(self) -> Lead:
        """Return what the other has more."""
        return replace(self, ahead_db=-self.ahead_db)

    def no_difference(self, one: str, other: str, figure: str) -> str:
        """Return the sentence for two methods, `one` having the lead, of which neither is surely better.

        >>> Lead(0.22, 0.14, 32, "test rows").no_difference("gp", "gsparc", "psnr_db")
        'gp and gsparc are not told apart in psnr_db: gp is 0.22 ± 0.14 dB better over 32 test rows'
        """
        if self.same:
            return f"{one} and {other} have the same {figure} over {self.pairs}"
        better, lead = (one, self) if self.ahead_db >= 0 else (other, -self)
        return f"{one} and {other} are not told apart in {figure}: {better} is {lead}"


def lead_over_rows(
    one: Mapping[str, Any], other: Mapping[str, Any], figure: str, of: str = "test rows"
) -> Lead | None:
    """Return what the score of `one` has more than that of `other`.

    Args:
        one, other: columns of `per_sample.csv` (n,) of the same rows.
        figure: the deciding one.
        of: what the pairs are called.

    Returns:
        None for figures that are no mean over rows, and of fewer than two rows.
    """
    column = {WITH_SILENT: "error_db_with_silent", "rmse_db": "error_db", "psnr_db": "psnr_db"}.get(
        figure, "error_power" if figure.startswith("nmse") else figure
    )
    if figure == "nmse_scalar" or column not in one or column not in other:
        return None
    a, b = (np.asarray(own[column], float) for own in (one, other))
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    if len(a) < 2:
        return None
    if column == "psnr_db":
        gains = a - b
    elif column == "error_power":
        # The difference of logarithms, and to first order what each row adds to it.
        low, high = (max(float(x.mean()), np.finfo(float).tiny) for x in (a, b))
        gains = 10 / np.log(10) * (np.log(high / low) + b / high - a / low)
    else:  # a^2 - b^2 = (a - b) (a + b)
        roots = sum(float(np.mean(x**2)) ** 0.5 for x in (a, b))
        gains = (b**2 - a**2) / max(roots, np.finfo(float).tiny)
    return Lead.from_gains(gains, of)
