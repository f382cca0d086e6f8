"""Operating points kept with a model, and the best that fits `gsparc.load(budget_ms=...)`."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsparc.models import checkpoint, loading
from gsparc.models.method import Method
from gsparc.models.reduced import ReductionInputs, Settings, with_reduction
from gsparc.prediction.confidence import check_kind, read_trusted
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.stored_point import Operating
from gsparc.prediction.timing import BLOCKS, time_interleaved
from gsparc.processes.stored import from_plain, to_plain

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


KEY = "operating"


def store_points(path: Path, points: Sequence[Mapping[str, Any]], inputs: ReductionInputs) -> None:
    """Store points, rows of a trade-off, in a checkpoint, replacing earlier ones;
    see `update_extra`.
    """
    operating = [
        Operating(
            p["label"],
            dict(p["settings"]),
            p["threads"],
            p["closeness_db"],
            (p["figure"], p["value"]),
            p["render_ms_p50"],
        )
        for p in points
    ]
    checkpoint.update_extra(path, {KEY: {"points": to_plain(operating), "measured": inputs}})


def stored_points(extra: dict[str, Any]) -> tuple[list[Operating], ReductionInputs]:
    """Return the points in a checkpoint's `extra`, none when it was never swept."""
    sweep = extra.get(KEY) or {"points": [], "measured": {}}
    return [*from_plain(sweep["points"])], dict(sweep["measured"])


log = logging.getLogger(__name__)

CLOCK = replace(BLOCKS, rounds=12, rounds_s=3.0)
QUANTILE = 0.75  # a point fits when three of four of its queries did: its median then does so again
QUERIES = 16  # at places drawn in the scene's box


def choose_within_budget(
    method: Method, stored: checkpoint.StoredModel, budget_ms: float
) -> tuple[Method, Operating]:
    """Choose the most accurate stored operating point that takes
    at most `budget_ms` on this machine.

    Sets torch's number of threads to the point's.

    Raises:
        ValueError: the budget is no positive number, or nothing fits; the fastest point is named.
    """
    if not (isinstance(budget_ms, (int, float)) and math.isfinite(budget_ms) and budget_ms > 0):
        raise ValueError(f"budget_ms={budget_ms!r}: a positive number of milliseconds is needed")
    points, inputs = stored_points(stored.extra)
    advice = "" if points else f"; `gsparc tradeoff ckpt={stored.path}` finds faster ways to answer"
    if not points:
        # A model that was never swept has one point, itself.
        points = [
            Operating("as trained", {}, torch.get_num_threads(), 0.0, ("", math.nan), math.nan)
        ]
    # More threads than cores wait for each other: such points are of another machine.
    points = [point for point in points if point.threads <= (os.cpu_count() or 1)] or points[:1]
    ways = [with_reduction(method, point.settings, inputs) for point in points]
    site, draw = stored.site, np.random.default_rng(0)
    low, high = site.query_box
    places = draw.uniform(low, high, (QUERIES, len(low)))
    calls = {i: Predictor(way, site).cycle_places(places) for i, way in enumerate(ways)}
    times = time_interleaved(calls, CLOCK, {i: point.threads for i, point in enumerate(points)})
    latencies = {i: float(np.quantile(ms, QUANTILE)) for i, ms in times.items()}
    fitting = [i for i in latencies if latencies[i] <= budget_ms]
    if not fitting:
        fastest = min(latencies, key=lambda i: latencies[i])
        raise ValueError(
            f"budget_ms={budget_ms:g}: no operating point of {stored.path} is that fast on this "
            "machine; the "
            f"fastest ({points[fastest].label}) takes {latencies[fastest]:.3g} ms{advice}"
        )
    # The most accurate of those that fit; of equally accurate ones the fastest.
    best = max(fitting, key=lambda i: (points[i].score, -latencies[i]))
    torch.set_num_threads(points[best].threads)
    log.info("%s: %s, %.3g ms here", stored.path, points[best].label, np.median(times[best]))
    return ways[best], points[best]


def load(
    path: str | Path | checkpoint.StoredModel,
    budget_ms: float | None = None,
    confidence: str | None = None,
    unit: str | None = None,
) -> Predictor:
    """Load the model in a checkpoint, ready to be asked.

    >>> gsparc.load("model.ckpt").rssi(rx=[2.0, 1.0, 1.5]).shape
    (1,)

    >>> gsparc.load("model.ckpt", unit="mW").unit
    'mW'

    Args:
        path: the file, or what `checkpoint.read` read of it.
        budget_ms: what one query may take on this machine, end to end [ms]. The operating points
            that `gsparc tradeoff` stored with the model are timed here (a few seconds), the most
            accurate that fits answers, and torch's number of threads becomes that point's.
        confidence: `expected` or `learned`; None takes the one that `gsparc calibrate` stored with
            the model, and the model's own where it was never calibrated.
        unit: of powers, like `dBm` or `mW`; None: that of the measurements.

    Raises:
        gsparc.models.checkpoint_content.CheckpointError: missing, damaged, hostile or newer file.
        ValueError: nothing is as fast as `budget_ms` (the fastest is named), or no such confidence
            or unit.
    """
    method, stored = loading.load(path)
    trusted = read_trusted(stored.extra)
    if confidence is not None:
        check_kind(confidence)
    chosen, point = (
        (method, None) if budget_ms is None else choose_within_budget(method, stored, budget_ms)
    )
    return Predictor(chosen, stored.site, method, point, trusted, confidence, stored.extra, unit)
