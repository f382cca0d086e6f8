"""A simulated dataset from beginning to end: places, effects, shards, convergence error,
one file.
"""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.executor import run_each
from gsparc.data.schema import Measurements
from gsparc.simulate import deciding
from gsparc.simulate.assembly import SECONDS, ShardRows, assemble_dataset, join_shards, shard_arrays
from gsparc.simulate.auto import AutoSettings
from gsparc.simulate.convergence import Convergence, measure_convergence
from gsparc.simulate.deciding import Decision
from gsparc.simulate.effects import Effects
from gsparc.simulate.scenes.build import build_survey
from gsparc.simulate.settings import CampaignSettings
from gsparc.simulate.shards import ROWS, Shards
from gsparc.simulate.survey import Survey

log = logging.getLogger(__name__)

STAGES = ("build", "decide", "trace", "converge", "write")
PARTS = 6  # version of what a shard holds: those of another are refused


@dataclass(frozen=True)
class Outcome:
    """A finished dataset and what it cost.

    Attributes:
        data, facts: the file, and numbers about it, see `assemble_dataset`.
        rows: what it was made of, in its order.
        survey, effects: its rows, and what was simulated.
        decision: of `auto`; else None.
        convergence: between two seeds; None where there are no rays.
        seconds: by stage [s].
    """

    data: Measurements
    facts: dict[str, float]
    rows: ShardRows
    survey: Survey
    effects: Effects
    decision: Decision | None
    convergence: Convergence | None
    seconds: dict[str, float]


def simulate(campaign: CampaignSettings, out: Path) -> Outcome:
    """Make the dataset, or go on where an interrupted run stopped.

    Raises:
        ValueError: `out` exists, or parts beside it belong to another simulation, or bad settings.
        SimulatorMissing: the scene needs Sionna and it is not here.
    """
    if out.exists():
        raise ValueError(f"out={out} exists; remove it or choose another")
    # One more than there are stages: their differences are what each took.
    laps = [time.perf_counter()]
    survey = build_survey(campaign.scene, campaign.sampling)
    shards = Shards(out, {**asdict(campaign), "parts": PARTS, "inputs": campaign.inputs()})
    laps.append(time.perf_counter())
    decision, left_out = None, deciding.NONE
    if isinstance(campaign.effects, AutoSettings):
        decision = _decided(campaign, campaign.effects, survey, shards)
        campaign = replace(campaign, effects=decision.effects)
        if decision.samples is not None:
            campaign = replace(
                campaign, sampling=replace(campaign.sampling, samples=decision.samples)
            )
            survey = survey.with_samples(decision.samples)
            left_out = _decided_on(shards)  # these rows have more rays than the others
    campaign = replace(campaign, effects=survey.engine.supported_effects(campaign.decided))
    laps.append(time.perf_counter())
    _trace_all(campaign, survey, shards)
    laps.append(time.perf_counter())
    rows = join_shards(shards, len(survey))
    error = measure_convergence(campaign, survey, rows.arrays, left_out)
    laps.append(time.perf_counter())
    # Seconds of all but the shards, which keep their own over interruptions.
    other_s = laps[1] - laps[0] + laps[4] - laps[3]
    choice = None if decision is None else decision.choice
    data, facts = assemble_dataset(campaign, survey, choice, error, other_s, shards, rows)
    laps.append(time.perf_counter())
    seconds = dict(zip(STAGES, np.diff(laps).tolist(), strict=True))
    return Outcome(data, facts, rows, survey, campaign.decided, decision, error, seconds)


def _decided(
    campaign: CampaignSettings, settings: AutoSettings, survey: Survey, shards: Shards
) -> Decision:
    """The decision of `auto`, taken once; what it traced is the first shard."""
    stored = shards.read_note()
    if stored is not None:
        return Decision.from_dict(stored)
    begin = time.perf_counter()
    decider = deciding.Decider(campaign, settings, survey)
    decision = decider.decide()
    paths = decider.paths.keep_effects(decision.effects)
    arrays = shard_arrays(paths, campaign, survey.engine.wavelength)
    seconds = np.array(time.perf_counter() - begin)
    shards.write(0, {**arrays, ROWS: decider.rows, SECONDS: seconds})
    shards.write_note(asdict(decision))
    return decision


@dataclass
class _Tracing:
    """Traces and stores shards; where it is sent to, it builds the scene once,
    which cannot be pickled.
    """

    campaign: CampaignSettings
    shards: Shards
    survey: Survey | None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "survey": None}

    def __call__(self, shard: tuple[int, np.ndarray]) -> None:
        (number, rows), begin = shard, time.perf_counter()
        if self.shards.path(number).exists():
            return
        if self.survey is None:
            self.survey = build_survey(self.campaign.scene, self.campaign.sampling)
        paths = self.survey.trace(rows, self.campaign.decided)
        arrays = shard_arrays(paths, self.campaign, self.survey.engine.wavelength)
        self.shards.write(
            number, {**arrays, ROWS: rows, SECONDS: np.array(time.perf_counter() - begin)}
        )


def _trace_all(campaign: CampaignSettings, survey: Survey, shards: Shards) -> None:
    """Trace what is missing."""
    rest = np.setdiff1d(np.arange(len(survey)), _decided_on(shards))
    parts = [
        (n, rest[i : i + campaign.shard])
        for n, i in enumerate(range(0, len(rest), campaign.shard), 1)
    ]
    missing = [(n, rows) for n, rows in parts if not shards.path(n).exists()]
    if len(missing) < len(parts):
        log.info("%d of %d shards already done", len(parts) - len(missing), len(parts))
    work = _Tracing(campaign, shards, survey)
    for _ in run_each(work, missing, "shards", cost=lambda shard: len(shard[1])):
        pass


def _decided_on(shards: Shards) -> np.ndarray:
    """Rows (n,) that `auto` decided on, which have all rays."""
    return shards.read(0, ROWS)[ROWS] if shards.path(0).exists() else deciding.NONE
