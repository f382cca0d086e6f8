"""A simulated dataset from beginning to end: places, effects, shards, convergence error, one file."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.claims import each_once
from gsparc.simulate import auto, priors
from gsparc.simulate.assembly import SECONDS, Assembled, assemble, shard_arrays
from gsparc.simulate.attribution import Deliverable, Probe
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.convergence import Convergence, compare
from gsparc.simulate.effects import Effects
from gsparc.simulate.engine import Engine
from gsparc.simulate.scenes.build import build
from gsparc.simulate.scenes.placement import neighbours, spread
from gsparc.simulate.settings import Campaign
from gsparc.simulate.shards import Shards, written_by

log = logging.getLogger(__name__)

STAGES = ("build", "decide", "trace", "converge", "write")
PARTS = 2  # version of what a shard holds: those of another are refused


@dataclass(frozen=True)
class Changed:
    """Errors by dropped effects at held-back receivers.

    Attributes:
        rows: (n,) receivers.
        errors: (n,) of the deliverable, in the unit of its tolerance.
    """

    rows: np.ndarray
    errors: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """A finished dataset and what it cost.

    Attributes:
        made: the file and facts about it.
        receivers: (S, 3) [m], world.
        transmitter: (3,) [m].
        effects: that were simulated.
        choice, changed: of `auto`; else None.
        convergence: between two seeds; None where there are no rays.
        seconds: by stage [s].
    """

    made: Assembled
    receivers: np.ndarray
    transmitter: np.ndarray
    effects: Effects
    choice: Choice | None
    changed: Changed | None
    convergence: Convergence | None
    seconds: dict[str, float]


def simulate(campaign: Campaign, out: Path, shared: bool = False) -> Outcome | None:
    """Make the dataset, or go on where an interrupted run stopped; processes that make the same one share it.

    Args:
        campaign: what is simulated.
        out: the file.
        shared: whether others may be making it, or may have made it.

    Returns:
        None where another process has written the file.

    Raises:
        ValueError: `out` exists, or parts beside it belong to another simulation, or bad settings.
        SimulatorMissing: the scene needs Sionna and it is not here.
    """
    plan = {**asdict(campaign), "parts": PARTS}
    if out.exists():
        if shared and written_by(out, plan):
            return None
        raise ValueError(f"out={out} exists; remove it or choose another")
    laps = [time.perf_counter()]
    engine, receivers = build(campaign.scene, campaign.sampling)
    shards = Shards(out, plan)
    laps.append(time.perf_counter())
    choice, changed, effects, decided_s = None, None, campaign.effects, 0.0
    if isinstance(effects, AutoSettings):
        decided = _choose(campaign, effects, engine, receivers, shards)
        if decided is None:
            return None
        choice, changed, decided_s = decided
        effects = choice.effects
    effects = engine.supported(effects)
    laps.append(time.perf_counter())
    _trace_all(campaign, engine, receivers, effects, shards)
    laps.append(time.perf_counter())
    mine: list[Outcome] = []

    def finish(unused: str) -> None:
        convergence = _converge(campaign, engine, receivers, effects)
        laps.append(time.perf_counter())
        other_s = laps[1] - laps[0] + decided_s + laps[4] - laps[3]
        made = assemble(campaign, engine, receivers, effects, choice, convergence, other_s, shards)
        laps.append(time.perf_counter())
        seconds = dict(zip(STAGES, np.diff(laps).tolist(), strict=True))
        whole = Outcome(made, receivers, engine.transmitter, effects, choice, changed, convergence, seconds)
        mine.append(whole)

    each_once(["file"], shards.lock, lambda unused: out.exists(), finish)
    return mine[0] if mine else None


def _choose(
    campaign: Campaign, settings: AutoSettings, engine: Engine, receivers: np.ndarray, shards: Shards
) -> tuple[Choice, Changed, float] | None:
    """The decision of `auto`, taken once and stored with the shards; errors it makes; its time [s].

    None where another process has written the file meanwhile.
    """

    def work(note: str) -> None:
        shards.write_note(note, _decide(campaign, settings, engine, receivers))

    each_once(["choice"], shards.lock, lambda note: shards.finished or shards.has_note(note), work)
    stored = shards.read_note("choice")
    if stored is None:
        return None
    changed = Changed(np.array(stored["rows"], dtype=int), np.array(stored["errors"]))
    return Choice.from_dict(stored["choice"]), changed, float(stored["seconds"])


def _decide(
    campaign: Campaign, settings: AutoSettings, engine: Engine, receivers: np.ndarray
) -> dict[str, Any]:
    """The decision of `auto` as it is stored."""
    begin = time.perf_counter()
    chosen = spread(receivers, settings.probes + settings.held_back, campaign.scene.seed)
    # Farthest-point order: taking every so many leaves both groups spread out.
    taken = np.zeros(len(chosen), dtype=bool)
    taken[np.linspace(0, len(chosen) - 1, settings.probes).round().astype(int)] = True
    probes, held = chosen[taken], chosen[~taken]
    full = engine.supported(settings.full)
    log.info("auto: %d probes with %s", len(probes), full)
    probe, places = _probe(campaign, engine, receivers, probes, full), receivers[probes]
    materials = engine.materials()
    choice = auto.decide(
        engine, places, settings, probe, lambda p: priors.reasons(p, engine.transmitter, places, materials)
    )
    log.info("auto: keeps %s; verifying on %d held-back receivers", choice.effects, len(held))
    probe = _probe(campaign, engine, receivers, held, full)
    choice = auto.verify(choice, settings, probe)
    errors = probe.errors(choice.effects, Deliverable.parse(settings.deliverable, settings.quantile))
    seconds = time.perf_counter() - begin
    cost = {"rows": held.tolist(), "errors": errors.tolist(), "seconds": seconds}
    return {"choice": asdict(choice), **cost}


def _probe(
    campaign: Campaign, engine: Engine, receivers: np.ndarray, rows: np.ndarray, effects: Effects
) -> Probe:
    """Some receivers traced, with their nearest others where the requirement is about spectra."""
    settings, nearest = campaign.effects, None
    if isinstance(settings, AutoSettings) and Deliverable.parse(settings.deliverable).kind == "spectrum":
        nearest = engine.trace(receivers[neighbours(receivers, rows)], effects)
    paths, wavelength = engine.trace(receivers[rows], effects), engine.wavelength
    elements, frequency = campaign.csi.elements(wavelength), campaign.scene.frequency_hz
    return Probe(paths, effects, frequency, wavelength, elements, campaign.spectrum, nearest)


def _converge(
    campaign: Campaign, engine: Engine, receivers: np.ndarray, effects: Effects
) -> Convergence | None:
    """The same receivers under a second seed; None for an engine without rays."""
    if campaign.check == 0 or not engine.random:
        return None
    rows = np.sort(spread(receivers, campaign.check, campaign.scene.seed + 1))
    first = _probe(campaign, engine, receivers, rows, effects)
    return compare(first, replace(first, paths=engine.trace(receivers[rows], effects, campaign.check_seed)))


def _trace_all(
    campaign: Campaign, engine: Engine, receivers: np.ndarray, effects: Effects, shards: Shards
) -> None:
    """Every shard that is not there yet and that no other process is making, with progress in the log."""
    starts = range(0, len(receivers), campaign.shard)
    parts = {n: receivers[i : i + campaign.shard] for n, i in enumerate(starts)}
    missing = {n: places for n, places in parts.items() if not shards.path(n).exists()}
    if len(missing) < len(starts):
        log.info("%d of %d shards are there already", len(starts) - len(missing), len(starts))
    begin, count = time.perf_counter(), len(receivers)
    at_first = sum(map(len, missing.values()))

    def there(number: int) -> bool:
        return shards.path(number).exists() or shards.finished

    def work(number: int) -> None:
        start = time.perf_counter()
        made = shard_arrays(engine.trace(missing[number], effects), campaign, engine.wavelength)
        shards.put(number, {**made, SECONDS: np.array(time.perf_counter() - start)})
        left = sum(len(places) for n, places in missing.items() if not shards.path(n).exists())
        rate = (at_first - left) / (time.perf_counter() - begin)  # of all processes
        log.info("%d of %d receivers, %.1f per s, %.0f s left", count - left, count, rate, left / rate)

    each_once(missing, shards.lock, there, work)
