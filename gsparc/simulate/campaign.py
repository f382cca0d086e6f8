"""A simulated dataset from beginning to end: places, effects, shards, convergence error, one file."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from gsparc.data.files import each_once
from gsparc.simulate import deciding
from gsparc.simulate.assembly import SECONDS, Assembled, assemble, shard_arrays
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.convergence import Convergence, compare
from gsparc.simulate.deciding import Changed, Decision
from gsparc.simulate.effects import Effects
from gsparc.simulate.scenes.build import build
from gsparc.simulate.settings import Campaign
from gsparc.simulate.shards import ROWS, Shards, written_by
from gsparc.simulate.survey import Survey

log = logging.getLogger(__name__)

STAGES = ("build", "decide", "trace", "converge", "write")
PARTS = 3  # version of what a shard holds: those of another are refused
CHECKED = 0.25  # largest share of the rows that is traced again


@dataclass(frozen=True)
class Outcome:
    """A finished dataset and what it cost.

    Attributes:
        made: the file and facts about it.
        survey: its rows.
        effects: that were simulated.
        choice, changed: of `auto`; else None.
        convergence: between two seeds; None where there are no rays.
        seconds: by stage [s].
    """

    made: Assembled
    survey: Survey
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
    plan = {**asdict(campaign), "parts": PARTS, "inputs": campaign.inputs()}
    if out.exists():
        if shared and written_by(out, plan):
            return None
        raise ValueError(f"out={out} exists; remove it or choose another")
    laps = [time.perf_counter()]
    survey = build(campaign.scene, campaign.sampling)
    shards = Shards(out, plan)
    laps.append(time.perf_counter())
    decision, effects, decided_s = None, campaign.effects, 0.0
    if isinstance(effects, AutoSettings):
        decision = _choose(campaign, effects, survey, shards)
        if decision is None:
            return None
        effects, decided_s = decision.effects, decision.choice.seconds
    asked = campaign
    if decision is not None and decision.samples is not None:
        campaign = replace(campaign, sampling=replace(campaign.sampling, samples=decision.samples))
        survey = survey.thinned(decision.samples)
    effects = survey.engine.supported(effects)
    laps.append(time.perf_counter())
    row_s = _trace_all(campaign, survey, effects, shards)
    choice = None if decision is None else decision.choice
    if decision is not None and decision.as_chosen and row_s and isinstance(asked.effects, AutoSettings):
        choice = replace(decision.choice, row_chosen=row_s)
        deciding.Decider(asked, asked.effects, survey).remember(choice)
    laps.append(time.perf_counter())
    mine: list[Outcome] = []

    def finish(unused: str) -> None:
        convergence = _converge(campaign, survey, effects, shards, campaign.sampling != asked.sampling)
        laps.append(time.perf_counter())
        other_s = laps[1] - laps[0] + decided_s + laps[4] - laps[3]
        made = assemble(campaign, survey, effects, choice, convergence, other_s, shards)
        laps.append(time.perf_counter())
        seconds = dict(zip(STAGES, np.diff(laps).tolist(), strict=True))
        changed = None if decision is None else decision.changed
        mine.append(Outcome(made, survey, effects, choice, changed, convergence, seconds))

    each_once(["file"], shards.lock, lambda unused: out.exists(), finish)
    return mine[0] if mine else None


def _choose(campaign: Campaign, settings: AutoSettings, survey: Survey, shards: Shards) -> Decision | None:
    """The decision of `auto`, taken once; what it traced is the first shard.

    None where another process has written the file meanwhile.
    """
    mine: list[Decision] = []

    def work(note: str) -> None:
        # of a process that was killed before it noted by which decision it was made
        shards.path(0).unlink(missing_ok=True)
        decision = deciding.Decider(campaign, settings, survey).decide()
        if decision.rows is not None and decision.paths is not None:
            made = shard_arrays(decision.paths, campaign, survey.engine.wavelength)
            shards.put(0, {**made, ROWS: decision.rows, SECONDS: np.array(0.0)})  # they are in the decision's
        shards.write_note(note, decision.note())
        mine.append(decision)

    each_once(
        ["choice"], shards.lock, lambda note: shards.out.exists() or shards.read_note(note) is not None, work
    )
    if mine:
        return mine[0]
    stored = shards.read_note("choice")
    return None if stored is None else Decision.of(stored)


def _trace_all(campaign: Campaign, survey: Survey, effects: Effects, shards: Shards) -> float | None:
    """Every shard that is not there yet and that no other process is making, with progress in the log.

    Returns:
        CPU seconds of a row, once compiled; None where too few were traced here.
    """
    left = np.setdiff1d(np.arange(len(survey)), _decided_on(shards))
    starts = range(0, len(left), campaign.shard)
    parts = {n: left[i : i + campaign.shard] for n, i in enumerate(starts, 1)}
    missing = {n: rows for n, rows in parts.items() if not shards.path(n).exists()}
    if len(missing) < len(parts):
        log.info("%d of %d shards are there already", len(parts) - len(missing), len(parts))
    begin, count = time.perf_counter(), len(survey)
    at_first = sum(map(len, missing.values()))
    spent: list[tuple[float, int]] = []

    def there(number: int) -> bool:
        return shards.path(number).exists() or shards.out.exists()

    def work(number: int) -> None:
        rows, start, busy = missing[number], time.perf_counter(), deciding.busy_s()
        paths = survey.trace(rows, effects)
        spent.append((deciding.busy_s() - busy, len(rows)))
        made = shard_arrays(paths, campaign, survey.engine.wavelength)
        shards.put(number, {**made, ROWS: rows, SECONDS: np.array(time.perf_counter() - start)})
        todo = sum(len(rows) for n, rows in missing.items() if not shards.path(n).exists())
        rate = (at_first - todo) / (time.perf_counter() - begin)  # of all processes
        log.info("%d of %d receivers, %.1f per s, %.0f s left", count - todo, count, rate, todo / rate)

    each_once(missing, shards.lock, there, work)
    warm = spent[1:]
    return sum(s for s, _ in warm) / sum(n for _, n in warm) if warm else None


def _decided_on(shards: Shards) -> np.ndarray:
    """Rows (n,) that `auto` decided on, which have all rays."""
    with suppress(FileNotFoundError):  # none was decided on, or another process has written the file
        return shards.get(0, ROWS)[ROWS]
    return deciding.NONE


def _converge(
    campaign: Campaign, survey: Survey, effects: Effects, shards: Shards, fewer: bool
) -> Convergence | None:
    """The file's rows beside the same under a second seed; None for an engine without rays.

    Args:
        campaign, survey, effects, shards: what was traced.
        fewer: whether rows that `auto` decided on have more rays than the others: these alone are compared.
    """
    count = min(campaign.check, int(CHECKED * len(survey)))
    if count == 0 or not survey.engine.random:
        return None
    other = _decided_on(shards) if fewer else deciding.NONE
    rows = survey.spread(count + len(other), campaign.scene.seed + 1)
    rows = np.sort(rows[~np.isin(rows, other)][:count])
    again = survey.trace(rows, effects, campaign.check_seed)
    csi, images, peak, power = shards.of_rows(rows, "csi", "spectrum", "spectrum_peak", "received_power")
    return compare(csi, images, peak, power, again, campaign, survey.engine.wavelength)
