"""`effects=auto`: measure each effect, keep those the requirement needs,
verify on held-back receivers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsparc.base.limits import SHARE, Checked, number, setting, whole
from gsparc.processes.uncertainty import most_failures
from gsparc.simulate.attribution import Deliverable, SurveyProbe, list_effect_sets, list_removals
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import TracedPaths

# Share of the processor time of a row, traced and stored, that goes with an effect, between those
# in the street canyon and in the conference room (docs/results/simulate.md).
PRICE = {
    "line_of_sight": 0.0,
    "specular": 0.25,
    "refraction": 0.0,
    "diffraction": 0.22,
    "edge_diffraction": 0.1,
    "diffuse": 0.1,
    "polarisation": 0.02,
}
BOUNCES = 0.8  # and with the bounces, to equal parts
RAYS = 0.8  # and with the rays
SIMILAR = 0.1  # of prices, within which the set of fewer effects is taken


@dataclass(frozen=True)
class AutoSettings(Checked):
    """How `auto` decides.

    Attributes:
        deliverable: the requirement, as text (`attribution.Deliverable.parse`).
        quantile: share of receivers for which it must hold.
        probes: receivers the decision is measured on, at least 16, spread out.
        confidence: with which the quantile must follow from them (`allowed_failures`).
        held_back: other receivers on which the choice is then verified.
        rays: share of the rays that is tried as well, where that may pay; 1 for none.
        full: what "everything on" means.
    """

    deliverable: str = "coverage +-1 dB"
    quantile: float = setting(0.95, SHARE)
    probes: int = setting(128, whole(16))
    confidence: float = setting(0.85, SHARE)
    held_back: int = setting(64, whole(16))
    rays: float = setting(0.3, number(0, 1, open_low=True))
    full: Effects = field(default_factory=lambda: Effects(depth=5))

    def __post_init__(self) -> None:
        super().__post_init__()
        Deliverable.parse(self.deliverable, self.quantile)

    @property
    def required(self) -> Deliverable:
        """The requirement."""
        return Deliverable.parse(self.deliverable, self.quantile)

    def allowed_failures(self, heard: int) -> int:
        """Return how many of `heard` receivers may exceed the tolerance,
        so that the quantile follows.

        0 where even none proves nothing.

        >>> AutoSettings(quantile=0.95, confidence=0.85).allowed_failures(128)
        3
        """
        return max(int(most_failures(heard, 1 - self.quantile, 1 - self.confidence)), 0)


@dataclass(frozen=True)
class EffectRow:
    """One row of the table: errors when one effect is left out.

    Attributes:
        effect: as in `list_removals`, or `rays > N`.
        share: mean share of a receiver's power.
        share_p95: its 95th percentile over the receivers.
        error, error_p95: of the deliverable, median and 95th percentile.
        failures: probes beyond the tolerance.
        kept: whether the requirement needs it.
    """

    effect: str
    share: float
    share_p95: float
    error: float
    error_p95: float
    failures: int
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
        effects: that the requirement needs.
        deliverable: the requirement, as text.
        table: one row per effect.
        probes: receivers that it took.
        samples: rays that are enough, of a call; None for those of the settings.
        refuted: effects that probes allowed and held-back receivers did not, so that everything is
            needed.
        verdict: filled by `verify_choice`.
    """

    effects: Effects
    deliverable: str
    table: tuple[EffectRow, ...]
    probes: int
    samples: int | None = None
    refuted: str = ""
    verdict: Verification | None = None

    @property
    def refused(self) -> bool:
        """Tell whether held-back receivers are outside of the tolerance too often."""
        return self.verdict is not None and not self.verdict.kept

    @staticmethod
    def from_dict(stored: Mapping[str, Any]) -> Choice:
        """Invert `dataclasses.asdict`."""
        verdict = None if stored["verdict"] is None else Verification(**stored["verdict"])
        table = tuple(EffectRow(**row) for row in stored["table"])
        effects = Effects(**stored["effects"])
        return Choice(**{**stored, "effects": effects, "table": table, "verdict": verdict})


def choose_effects(probe: SurveyProbe, settings: AutoSettings) -> Choice:
    """Return the cheapest effects that meet the requirement, by receivers traced with everything.

    Raises:
        ValueError: nothing reaches any of them.
    """
    full, required, heard = probe.effects, settings.required, int(probe.reached.sum())
    if not heard:
        raise ValueError(
            "effects=auto: nothing reaches any probe receiver; is the transmitter inside a "
            "building?"
        )
    most = settings.allowed_failures(heard)
    rows = [_row(name, probe, less, required) for name, less in list_removals(full).items()]

    def holds(effects: Effects) -> bool:
        errors = probe.errors(effects, required)[probe.reached]
        return bool((errors > required.tolerance).sum() <= most)

    removable = tuple(row.effect for row in rows if row.failures <= most)
    # The cheapest first: the search ends soon after the first set that holds.
    sets = sorted(
        list_effect_sets(full, removable), key=lambda effects: relative_cost(effects, full)
    )
    chosen, table = _cheapest(sets, holds, full), []
    for row in rows:
        effect, _, depth = row.effect.partition(" > ")
        # Rows are named after an effect, or `depth > N`.
        in_use = chosen.depth > int(depth) if depth else bool(getattr(chosen, effect))
        table.append(replace(row, kept=in_use))
    return Choice(chosen, str(required), tuple(table), len(probe.reached))


def verify_choice(choice: Choice, settings: AutoSettings, errors: np.ndarray) -> Choice:
    """Return the choice with its verification, by errors (n,)
    of the deliverable at held-back receivers.
    """
    if not len(errors):
        return choice
    met = float((errors <= settings.required.tolerance).mean())
    verdict = Verification(
        len(errors), met, float(np.median(errors)), _p95(errors), met >= settings.quantile
    )
    return replace(choice, verdict=verdict)


def choose_rays(
    choice: Choice, settings: AutoSettings, probe: SurveyProbe, traced: TracedPaths, samples: int
) -> Choice:
    """Return the choice with so many `samples` where those are enough, or without;
    a row says which.

    Args:
        choice, settings, probe: as of `choose_effects`.
        traced: the probe's receivers with the choice's effects and these samples.
    """
    row = _row(f"rays > {samples}", probe, traced, settings.required)
    heard = int(probe.reached.sum())
    enough = row.failures <= settings.allowed_failures(heard)
    table = (*choice.table, replace(row, kept=not enough))
    return replace(choice, table=table, samples=samples if enough else None)


def keep_all_rays(choice: Choice) -> Choice:
    """Return the choice, whose fewer rays the held-back receivers refute."""
    return replace(
        choice, samples=None, table=(*choice.table[:-1], replace(choice.table[-1], kept=True))
    )


def relative_cost(effects: Effects, full: Effects, rays: float = 1.0) -> float:
    """Return the expected time of tracing with some effects and a share of the rays,
    1 with everything.

    >>> full = Effects(depth=5)
    >>> relative_cost(full, full), relative_cost(full.switch_off("diffuse"), full) < 1
    (1.0, True)
    """
    off = [name for name in full.enabled if name not in effects.enabled]
    off += ["polarisation"] if full.polarisation and not effects.polarisation else []
    bounces = 1 - BOUNCES + BOUNCES * effects.depth / max(full.depth, 1)
    return bounces * math.prod(1 - PRICE[name] for name in off) * (1 - RAYS + RAYS * rays)


def _cheapest(sets: list[Effects], holds: Callable[[Effects], bool], full: Effects) -> Effects:
    """The cheapest set that meets the requirement; of sets with similar prices, the smallest."""
    enough: list[Effects] = []
    for effects in sets:
        if enough and relative_cost(effects, full) > (1 + SIMILAR) * relative_cost(enough[0], full):
            break
        if holds(effects):
            enough.append(effects)
    return min(enough, key=lambda s: (len(s.enabled), s.polarisation, s.depth), default=full)


def _row(
    name: str, probe: SurveyProbe, less: Effects | TracedPaths, required: Deliverable
) -> EffectRow:
    """What is lost with `less`, at receivers that something reaches; kept until it is clear."""
    share, error = (
        part[probe.reached]
        for part in (np.abs(probe.lost_power_shares(less)), probe.errors(less, required))
    )
    return EffectRow(
        name,
        float(share.mean()),
        _p95(share),
        float(np.median(error)),
        _p95(error),
        int((error > required.tolerance).sum()),
        True,
    )


def _p95(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.95))
