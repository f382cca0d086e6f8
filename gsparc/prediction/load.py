"""`gsparc.load(FILE)`: a trained model, ready to be asked, as fast as it must be."""

from __future__ import annotations

from pathlib import Path

from gsparc.models import loading
from gsparc.prediction.confidence import kept
from gsparc.prediction.operating_point import within
from gsparc.prediction.predictor import Predictor


def load(path: str | Path, budget_ms: float | None = None, confidence: str | None = None) -> Predictor:
    """The model in a checkpoint, ready to be asked.

    Args:
        path: the file.
        budget_ms: what one query may take on this machine, end to end [ms]. The operating points that
            `gsparc tradeoff` stored with the model are timed here (a few seconds), the most
            accurate that fits answers, and torch's number of threads becomes that point's.
        confidence: `learned`, `expected`, `distance` or `gp_variance`; None takes the one that
            `gsparc calibrate` found best on positions set aside and stored with the model, and
            the model's own where it was never calibrated.

    Raises:
        gsparc.models.checkpoint.CheckpointError: missing, damaged, hostile or newer file.
        ValueError: nothing is as fast as `budget_ms` (the fastest is named), or no such confidence.
    """
    method, stored = loading.load(path)
    trusted = kept(stored.extra)
    if confidence is not None:
        trusted.check(confidence)
    if budget_ms is None:
        return Predictor(method, stored.site, trusted=trusted, kind=confidence, extra=stored.extra)
    chosen, point = within(method, stored, budget_ms)
    return Predictor(
        chosen, stored.site, whole=method, point=point, trusted=trusted, kind=confidence, extra=stored.extra
    )
