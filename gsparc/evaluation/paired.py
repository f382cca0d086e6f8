"""What one method has more than another on the same rows or draws of a split,
with its standard error.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from gsparc.evaluation.metric_formats import is_power_ratio, is_root, lower_is_better, sample_column
from gsparc.evaluation.results import score_db
from gsparc.evaluation.table import Row
from gsparc.processes.uncertainty import half_width, standard_error

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
        error = standard_error(gains) if len(gains) > 1 else np.nan
        return Lead(float(gains.mean()), error, len(gains), of)

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
        """Whether its 95 % interval leaves out 0."""
        # False where it is not known
        return not self.same and bool(abs(self.ahead_db) > self.reach_db)

    @property
    def reach_db(self) -> float:
        """Return half of its 95 % interval (Student's t):
        few draws tell their scatter badly [dB].
        """
        return half_width(LEVEL, max(self.count - 1, 1)) * self.error_db

    def __str__(self) -> str:
        error = "" if np.isnan(self.error_db) else f" ± {self.error_db:.2f} (standard error)"
        return f"{self.ahead_db:.2f}{error} dB better over {self.pairs}"

    def __neg__(self) -> Lead:
        """Return what the other has more."""
        return replace(self, ahead_db=-self.ahead_db)

    def no_difference(self, one: str, other: str, figure: str) -> str:
        """Return the sentence for two methods, `one` having the lead,
        of which neither is surely better.

        >>> Lead(0.22, 0.14, 9, "rows").no_difference("a", "b", "ssim").partition(": ")[2]
        'a is 0.22 ± 0.14 (standard error) dB better over 9 rows'
        """
        if self.same:
            return f"{one} and {other} have the same {figure} over {self.pairs}"
        better, lead = (one, self) if self.ahead_db >= 0 else (other, -self)
        return f"{one} and {other} do not differ significantly in {figure}: {better} is {lead}"


def gains_of_rows(
    one: Mapping[str, Any], other: Mapping[str, Any], figure: str
) -> np.ndarray | None:
    """Return what each row adds to the score of `one` beyond that of `other` (n,) [dB],
    NaN where unknown.

    Args:
        one, other: columns of `per_sample.csv` (n,) of the same rows.
        figure: the deciding one.

    Returns:
        None for figures that are no mean over rows, and of fewer than two rows.
    """
    column = sample_column(figure)
    if column not in one or column not in other:
        return None
    a, b = (np.asarray(samples[column], float) for samples in (one, other))
    a, b = a + 0 * b, b + 0 * a  # NaN in one is NaN in both: the means are of the same rows
    if np.isfinite(a).sum() < 2:
        return None
    if is_power_ratio(figure):
        # The difference of logarithms, and to first order what each row adds to it.
        low, high = (max(float(np.nanmean(x)), np.finfo(float).tiny) for x in (a, b))
        return 10 / np.log(10) * (np.log(high / low) + b / high - a / low)
    if is_root(figure):
        # a^2 - b^2 = (a - b) (a + b)
        roots = sum(float(np.nanmean(x**2)) ** 0.5 for x in (a, b))
        return (b**2 - a**2) / max(roots, np.finfo(float).tiny)
    return b - a if lower_is_better(figure) else a - b


def lead_over_rows(
    one: Mapping[str, Any], other: Mapping[str, Any], figure: str, of: str = "test rows"
) -> Lead | None:
    """Return what the score of `one` has more than that of `other`, over rows that are `of`;
    see `gains_of_rows`.
    """
    gains = gains_of_rows(one, other, figure)
    return None if gains is None else Lead.from_gains(gains[np.isfinite(gains)], of)


def lead_over_runs(own: Sequence[Row], others: Sequence[Row]) -> Lead | None:
    """Return what runs of a method or setting have more than those of another, pair by pair.

    Pairs are draws of the split, seeds of each averaged. Of a single draw they are its test rows,
    or its seeds where these tell less: a method without chance has no scatter over seeds.

    Args:
        own, others: rows of results with their `run`; one without a seed is paired with every seed.

    Returns:
        None without a common draw and seed, or where one draw has no common samples.
    """
    pairs = [
        (a, b)
        for a, b in product(own, others)
        if a["rows"] == b["rows"] and (a["seed"] == b["seed"] or None in (a["seed"], b["seed"]))
        if None not in (a["value"], b["value"])
    ]
    gains: dict[str, list[float]] = defaultdict(list)
    for a, b in pairs:
        gains[a["draw"]].append(score_db(a) - score_db(b))
    if len(gains) > 1:
        return Lead.from_gains(np.array([np.mean(seeds) for seeds in gains.values()]), "draws")
    rows = [gains_of_rows(_samples(a), _samples(b), a["figure"]) for a, b in pairs]
    row_gains = [of_rows for of_rows in rows if of_rows is not None]
    if not row_gains or len(row_gains) < len(rows):
        return None
    mean = np.mean(row_gains, axis=0)
    over_rows = Lead.from_gains(mean[np.isfinite(mean)], "test rows")
    over_seeds = Lead.from_gains(np.array(next(iter(gains.values()))), "seeds")
    return over_seeds if over_seeds.reach_db > over_rows.reach_db else over_rows


def _samples(row: Row) -> Mapping[str, Any]:
    """Columns of a run's `per_sample.csv`; a baseline beside it has others."""
    return {} if row["baseline"] else row["run"].samples
