"""Points of accuracy against latency, and which of them nobody beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gsparc.models.reduced import Settings

WORDS = {
    "keep": lambda value: f"{value:.0%} kept",
    "stride": lambda value: f"1 of {value} x {value} pixels",
    "confidence": lambda value: "" if value else "no confidence",
    "searches": lambda value: f"{value} search{'es' if value > 1 else ''}",
}


def defined_figure(figures: Mapping[str, float | None], name: str) -> float:
    """Return a figure of merit.

    Raises:
        ValueError: the rows that were scored do not define it.
    """
    if (value := figures[name]) is None:
        raise ValueError(
            f"{name} is not defined on these test rows (all silent?): say another split="
        )
    return value


def describe_point(settings: Settings) -> str:
    """Return `25% kept, 1 of 3 x 3 pixels`; `as trained` when nothing is spared."""
    words = [
        WORDS.get(knob, lambda value, k=knob: f"{k} {value}")(value)
        for knob, value in settings.items()
    ]
    return ", ".join(word for word in words if word) or "as trained"


def pareto_front(latency: Sequence[float], score: Sequence[float]) -> list[int]:
    """Return indices of the points that no other beats, fastest first.

    A point is on the front if every point at most as slow is less accurate
    than it (ties: the first wins).

    Args:
        latency: (n,) [ms].
        score: (n,) larger is better.
    """
    # Of equal latencies the most accurate first: it then beats the others.
    order = sorted(range(len(latency)), key=lambda i: (latency[i], -score[i]))
    best: list[int] = []
    for i in order:
        if not best or score[i] > score[best[-1]]:
            best.append(i)
    return best
