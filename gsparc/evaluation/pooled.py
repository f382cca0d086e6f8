"""All figures of one method's results, pooled over the folds of a split."""

from __future__ import annotations

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.intervals import power_intervals
from gsparc.evaluation.scores import Scores


def pooled(scores: Scores, data: Measurements, split: Split) -> dict[str, float | None]:
    """Accuracies, of powers how honest variances are; `rmse_db_after_constant` where stations are held out.

    Args:
        scores: of rows of `data`.
        data, split: what was learned from.
    """
    found = scores.figures()
    if data.site.kind == "rssi":
        found |= power_intervals(scores, data)
        if split.name == "stations" and data.station is not None:
            found["rmse_db_after_constant"] = scores.after_constant(data.station)
    return found
