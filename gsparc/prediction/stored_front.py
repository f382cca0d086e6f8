"""Operating points kept with a model: what its front spares, and what must be known to spare it again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsparc.models import checkpoint
from gsparc.models.pareto import Point, Settings
from gsparc.models.reduced import Measured

KEY = "operating"


@dataclass(frozen=True)
class Operating:
    """One stored way of answering.

    Attributes:
        label: in words.
        settings: what is spared.
        threads: CPU threads.
        score: larger is better: how near its answers are to the full model's [dB].
        figure: name and value of the accuracy that was shown with it.
        p50_ms: median latency where it was measured [ms]; this machine times anew.
    """

    label: str
    settings: Settings
    threads: int
    score: float
    figure: tuple[str, float]
    p50_ms: float


def keep(path: Path, points: Sequence[Point], figure: str, measured: Measured) -> None:
    """Store points in a checkpoint, replacing earlier ones; the file is rewritten whole or not at all."""
    stored = [
        Operating(p.label, dict(p.settings), p.threads, p.closeness_db, (figure, p.value(figure)), p.p50)
        for p in points
    ]
    checkpoint.amend(path, {KEY: {"points": [asdict(point) for point in stored], "measured": measured}})


def kept(extra: dict[str, Any]) -> tuple[list[Operating], Measured]:
    """The points in a checkpoint's `extra`, none when it was never swept."""
    found = extra.get(KEY) or {"points": [], "measured": {}}
    points = [Operating(**{**point, "figure": tuple(point["figure"])}) for point in found["points"]]
    return points, dict(found["measured"])
