"""A way of answering that is kept with a model."""

from __future__ import annotations

from dataclasses import dataclass

from gsparc.models.reduced import Settings
from gsparc.processes.stored import Stored


@dataclass(frozen=True)
class Operating(Stored):
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
