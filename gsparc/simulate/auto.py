"""`effects=auto`: measure each effect, keep those the requirement needs, verify on held-back receivers."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import binom

from gsparc.simulate.attribution import Deliverable, Probe, combinations, removals
from gsparc.simulate.effects import Effects
from gsparc.simulate.engine import Engine

log = logging.getLogger(__name__)

TIMED = 48  # probes that times are measured on
REPEATS = 2
TIMING_NOISE = 0.1  # a competing process moves a measured time by more than this


@dataclass(frozen=True)
class AutoSettings:
    """How `auto` decides.

    Attributes:
        deliverable: the requirement, as text (`attribution.Deliverable.parse`).
        quantile: share of receivers for which it must hold.
        probes: receivers the decision is measured on, at least 16, spread out.
        confidence: with which the quantile must follow from them (`allowed_failures`).
        held_back: other receivers on which the choice is then verified.
        full: what "everything on" means.
    """

    deliverable: str = "coverage +-1 dB"
    quantile: float = 0.95
    probes: int = 128
    confidence: float = 0.85
    held_back: int = 128
    full: Effects = field(default_factory=lambda: Effects(depth=5))

    def __post_init__(self) -> None:
        if self.probes < 16 or self.held_back < 16:
            raise ValueError("effects.probes and effects.held_back: at least 16 receivers each, spread out")
        if not 0 < self.confidence < 1:
            raise ValueError(f"effects.confidence={self.confidence}: expected a share between 0 and 1")
        Deliverable.parse(self.deliverable, self.quantile)


@dataclass(frozen=True)
class EffectRow:
    """One row of the table: errors when one effect is left out.

    Attributes:
        effect: as in `removals`.
        share: mean share of a receiver's power.
        share_p95: its 95th percentile over the receivers.
        nmse, nmse_p95: of the channel, median and 95th percentile.
        error, error_p95: of the deliverable, likewise.
        seconds: CPU time of tracing `TIMED` probes without it [s].
        reason: expectation from physics; empty where there is none.
        kept: whether it is simulated.
    """

    effect: str
    share: float
    share_p95: float
    nmse: float
    nmse_p95: float
    error: float
    error_p95: float
    seconds: float
    reason: str
    kept: bool


@dataclass(frozen=True)
class Verification:
    """Whether the requirement holds on receivers that were not used to decide.

    Attributes:
        receivers: how many were verified.
        met: share of them within the tolerance.
        error, error_p95: of the deliverable, median and 95th percentile.
        kept: whether the requirement is met.
    """

    receivers: int
    met: float
    error: float
    error_p95: float
    kept: bool


@dataclass(frozen=True)
class Choice:
    """The decision of `auto` and the measurements behind it.

    Attributes:
        effects: to simulate.
        deliverable: the requirement, as text.
        table: one row per effect.
        seconds_all, seconds_chosen: the same with everything and with the choice [s].
        seconds: what deciding cost in all [s].
        verdict: filled by `verify`.
    """

    effects: Effects
    deliverable: str
    table: tuple[EffectRow, ...]
    seconds_all: float
    seconds_chosen: float
    seconds: float
    verdict: Verification | None = None

    @property
    def saved(self) -> float:
        """Share of the tracing time that the choice saves against everything."""
        return 1 - self.seconds_chosen / self.seconds_all if self.seconds_all > 0 else 0.0

    @staticmethod
    def from_dict(stored: Mapping[str, Any]) -> Choice:
        """Inverse of `dataclasses.asdict`."""
        verdict = None if stored["verdict"] is None else Verification(**stored["verdict"])
        table = tuple(EffectRow(**row) for row in stored["table"])
        return Choice(
            **{**stored, "effects": Effects(**stored["effects"]), "table": table, "verdict": verdict}
        )


def decide(
    engine: Engine,
    receivers: np.ndarray,
    settings: AutoSettings,
    probe: Probe,
    explain: Callable[[Probe], Mapping[str, str]],
) -> Choice:
    """Measure on `receivers` (R, 3) [m] and choose the cheapest effects that meet the requirement.

    Args:
        engine: traces.
        receivers: the probes.
        settings: requirement and confidence.
        probe: the same receivers traced with everything.
        explain: prior reasons by effect.
    """
    begin = time.perf_counter()
    full = probe.effects
    deliverable = Deliverable.parse(settings.deliverable, settings.quantile)
    reached = probe.reached
    if not reached.any():
        raise ValueError(
            "effects=auto: nothing reaches any probe receiver; is the transmitter inside a building?"
        )
    dropped = removals(full)
    errors = {name: probe.errors(kept, deliverable)[reached] for name, kept in dropped.items()}
    failures = allowed_failures(int(reached.sum()), settings.quantile, settings.confidence)

    def holds(error: np.ndarray) -> bool:
        return bool((error > deliverable.tolerance).sum() <= failures)

    removable = tuple(name for name, error in errors.items() if holds(error))
    timed = receivers[:TIMED]
    seconds_all = _timed(engine, timed, full)
    seconds = {name: _timed(engine, timed, less) for name, less in dropped.items()}
    costs = {s: _estimate(s, full, seconds, seconds_all) for s in combinations(full, removable)}
    chosen = _cheapest(costs, lambda some: holds(probe.errors(some, deliverable)[reached]), full)
    why, table = explain(probe), []
    for name, less in dropped.items():
        share, nmse, error = probe.shares(less)[reached], probe.nmse(less)[reached], errors[name]
        effect, _, depth = name.partition(" > ")
        kept = chosen.depth > int(depth) if depth else bool(getattr(chosen, name))
        table.append(EffectRow(
            name, float(share.mean()), _p95(share), float(np.median(nmse)), _p95(nmse),
            float(np.median(error)), _p95(error), seconds[name], why.get(effect, ""), kept,
        ))  # fmt: skip
    seconds_chosen = seconds_all if chosen == full else _timed(engine, timed, chosen)
    return Choice(
        chosen, str(deliverable), tuple(table), seconds_all, seconds_chosen, time.perf_counter() - begin
    )


def verify(choice: Choice, settings: AutoSettings, held_back: Probe) -> Choice:
    """The choice with its verification on held-back receivers, by path attribution in a full run."""
    deliverable = Deliverable.parse(settings.deliverable, settings.quantile)
    errors = held_back.errors(choice.effects, deliverable)[held_back.reached]
    met = float((errors <= deliverable.tolerance).mean())
    kept = met >= deliverable.quantile
    verdict = Verification(len(errors), met, float(np.median(errors)), _p95(errors), kept)
    return replace(choice, verdict=verdict)


def allowed_failures(probes: int, quantile: float, confidence: float) -> int:
    """Most probes that may exceed the tolerance while the requirement still follows.

    The largest c with P(Binomial(probes, 1 - quantile) <= c) <= 1 - confidence: were it violated, so few
    failures would be that unlikely. 0 where even none proves nothing (too few probes).
    """
    return max(0, int(binom.ppf(1 - confidence, probes, 1 - quantile)) - 1)


def _cheapest(costs: Mapping[Effects, float], holds: Callable[[Effects], bool], full: Effects) -> Effects:
    """The cheapest set that meets the requirement; of sets with similar costs, the smallest."""
    found: list[Effects] = []
    for some in sorted(costs, key=lambda s: costs[s]):
        if found and costs[some] > (1 + TIMING_NOISE) * costs[found[0]]:
            break
        if holds(some):
            found.append(some)
    return min(found, key=lambda s: (len(s.on), s.polarisation, s.depth, costs[s]), default=full)


def _timed(engine: Engine, receivers: np.ndarray, effects: Effects) -> float:
    """CPU seconds of a warm trace, the best of `REPEATS`; the first compiles."""
    engine.trace(receivers, effects)
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        engine.trace(receivers, effects)
        seconds.append(time.process_time() - start)
    return min(seconds)


def _estimate(some: Effects, full: Effects, seconds: Mapping[str, float], everything: float) -> float:
    """Seconds of a combination, as if what each removal saves multiplied; the choice itself is then timed.

    Leaving an effect out never costs time: a measurement that says so is noise.
    """
    saved = [f"depth > {some.depth}"] if some.depth < full.depth else []
    saved += [name for name in full.on if name in seconds and name not in some.on]
    if full.polarisation and not some.polarisation:
        saved.append("polarisation")
    return everything * math.prod(min(seconds[name] / everything, 1.0) for name in saved)


def _p95(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.95))
