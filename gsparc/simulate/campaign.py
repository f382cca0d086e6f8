"""A simulated dataset from beginning to end: places, shards, convergence error, one file; of
`effects=auto` probes are traced with all of them, and what the tolerance does not need is dropped.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from skimage.metrics import structural_similarity

from gsparc.base.executor import run_each
from gsparc.data.schema import Measurements
from gsparc.physics.decibels import to_decibels
from gsparc.simulate import auto
from gsparc.simulate.assembly import (
    ROWS,
    SECONDS,
    ShardRows,
    Shards,
    assemble_dataset,
    join_shards,
    shard_arrays,
)
from gsparc.simulate.attribution import SurveyProbe
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.scenes.build import build_survey
from gsparc.simulate.scenes.receivers import nearest_rows
from gsparc.simulate.settings import CampaignSettings
from gsparc.simulate.spectrum import render_spectra
from gsparc.simulate.survey import Survey

NONE = np.zeros(0, dtype=np.int64)
# Receivers that take as long, with everything, as compiling the solver for other effects or rays:
# counted, as a measured time would let the load of a machine decide what is simulated.
COMPILING = 100
TRIAL = 2  # how much more fewer rays are to save than their trial costs, because it may fail


class Changed(NamedTuple):
    """Errors at held-back receivers from leaving out what the requirement does not need.

    Attributes:
        rows: (n,) of the survey.
        errors: (n,) of the deliverable, in the unit of its tolerance.
    """

    rows: np.ndarray
    errors: np.ndarray


@dataclass(frozen=True)
class Decision:
    """What `auto` decided.

    Attributes:
        choice: what the requirement needs.
        effects: what is simulated: that, or everything where few rows are left, whose saving would
            not pay for compiling the solver for other effects.
        samples: with how many rays of a call; None for those of the settings.
        changed: errors at held-back receivers; None where there are none.
    """

    choice: Choice
    effects: Effects
    samples: int | None = None
    changed: Changed | None = None

    @staticmethod
    def from_dict(note: Mapping[str, Any]) -> Decision:
        """Invert `dataclasses.asdict`, with arrays as lists."""
        changed = Changed(*map(np.array, note["changed"])) if note["changed"] else None
        effects = Effects(**note["effects"])
        return Decision(Choice.from_dict(note["choice"]), effects, note["samples"], changed)


class Decider:
    """Chooses the effects of one campaign; probes and held-back rows, rows of the file,
    have everything.
    """

    def __init__(self, campaign: CampaignSettings, settings: AutoSettings, survey: Survey) -> None:
        self.campaign, self.settings, self.survey = campaign, settings, survey
        self.full = survey.engine.supported_effects(settings.full)
        # Whether errors are shares of their error
        self.nearest = settings.required.kind == "spectrum"
        self.probes, self.held_back = self._groups()
        self.both = np.concatenate([self.probes, self.held_back])
        near = self._nearest(self.both) if self.nearest else NONE
        self.rows = np.unique(np.concatenate([self.both, near]))
        log.info(
            "auto: deciding on effects at %d receivers, traced with %s", len(self.rows), self.full
        )
        self.paths = survey.trace(self.rows, self.full)
        self.left = len(survey) - len(self.rows)

    def decide(self) -> Decision:
        """Decide by the probes, verify on held-back rows."""
        choice, changed = auto.choose_effects(self._probe(self.probes), self.settings), None
        if choice.effects != self.full:
            choice, changed = self._verified(choice, choice.effects)
            if choice.refused:
                log.info(
                    "auto: verification on held-back receivers failed; everything is simulated"
                )
                table = tuple(replace(row, kept=True) for row in choice.table)
                choice = replace(
                    choice, effects=self.full, refuted=str(choice.effects), table=table
                )
        # After the effects, as fewer rays are tried with those that were chosen.
        whole, thin = (
            auto.relative_cost(choice.effects, self.full, rays)
            for rays in (1.0, self.settings.rays)
        )
        saved, trial = self.left * (whole - thin), len(self.both) * thin + COMPILING
        if self.survey.engine.random and saved > TRIAL * trial:
            choice, changed = self._with_fewer_rays(choice, changed)
        effects, samples = choice.effects, choice.samples
        saved = self.left * (1 - (whole if samples is None else thin))
        if self.survey.engine.random and 0 < saved <= COMPILING:
            log.info(
                "auto: everything is simulated: for %d receivers, compiling costs more", self.left
            )
            effects, samples = self.full, None
        return Decision(choice, effects, samples, changed)

    def _groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Probes and held-back rows, both spread out."""
        wanted = self.settings.probes + self.settings.held_back
        chosen = self.survey.choose_distant_rows(wanted, self.campaign.scene.seed)
        share = self.settings.probes / wanted
        # Farthest-point order: taking every so many leaves both groups spread out.
        turn = np.floor(np.arange(1, len(chosen) + 1) * share) > np.floor(
            np.arange(len(chosen)) * share
        )
        return chosen[turn], chosen[~turn]

    def _nearest(self, rows: np.ndarray) -> np.ndarray:
        """The row of the nearest other place, with the same transmitter, of each of rows (n,)."""
        owner, place = np.divmod(rows, len(self.survey.places))
        return np.asarray(owner * len(self.survey.places) + nearest_rows(self.survey.places, place))

    def _paths_of_rows(self, rows: np.ndarray) -> TracedPaths:
        return self.paths.select_receivers(np.searchsorted(self.rows, rows))

    def _probe(self, rows: np.ndarray) -> SurveyProbe:
        near = self._paths_of_rows(self._nearest(rows)) if self.nearest else None
        campaign, wavelength = self.campaign, self.survey.engine.wavelength
        array, tones = campaign.csi.elements(wavelength), campaign.scene.frequency_hz
        return SurveyProbe(
            self._paths_of_rows(rows), self.full, tones, wavelength, array, campaign.spectrum, near
        )

    def _verified(self, choice: Choice, less: Effects | TracedPaths) -> tuple[Choice, Changed]:
        probe = self._probe(self.held_back)
        errors = probe.errors(less, self.settings.required)
        verified = auto.verify_choice(choice, self.settings, errors[probe.reached])
        return verified, Changed(self.held_back, errors)

    def _with_fewer_rays(
        self, choice: Choice, changed: Changed | None
    ) -> tuple[Choice, Changed | None]:
        """The choice with a share of the rays where that is enough.

        Fewer rays are drawn anew, so that attribution says nothing about them. Their paths are not
        written to the file, which has the same rows with all rays.
        """
        samples = max(round(self.settings.rays * self.campaign.sampling.samples), 1)
        log.info("auto: the same receivers with %d rays", samples)
        fewer = self.survey.with_samples(samples).trace(self.both, choice.effects)
        probe_index, check_index = np.split(np.arange(len(self.both)), [len(self.probes)])
        probe = self._probe(self.probes)
        thinned = auto.choose_rays(
            choice, self.settings, probe, fewer.select_receivers(probe_index), samples
        )
        if thinned.samples is None:
            return thinned, changed
        verified, errors = self._verified(thinned, fewer.select_receivers(check_index))
        if verified.refused:
            return replace(auto.keep_all_rays(thinned), verdict=choice.verdict), changed
        return verified, errors


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
        convergence: between two seeds, see `measure_convergence`.
        seconds: by stage [s].
    """

    data: Measurements
    facts: dict[str, float]
    rows: ShardRows
    survey: Survey
    effects: Effects
    decision: Decision | None
    convergence: dict[str, float]
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
    decision, left_out = None, NONE
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
    decider = Decider(campaign, settings, survey)
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
    return shards.read(0, ROWS)[ROWS] if shards.path(0).exists() else NONE


CHECKED = 0.25  # largest share of the rows that is traced again


def measure_convergence(
    campaign: CampaignSettings,
    survey: Survey,
    traced: Mapping[str, np.ndarray],
    left_out: np.ndarray,
) -> dict[str, float]:
    """Compare rows of a file with a second seed's; empty where none is asked for, or without rays.

    Args:
        campaign, survey: of the file.
        traced: its arrays, a row for each of the survey's.
        left_out: (n,) rows that were traced otherwise.

    Returns:
        Attributes of the file: `convergence_error` of the channels, sum |difference|^2 / sum
        |channel|^2; of spectra NMSE, PSNR [dB] and SSIM;
        `convergence_power_db`, 95th percentile of |difference| of the received power, of receivers
        that both reach; `convergence_receivers`, how many were traced twice.
    """
    count = min(campaign.check, int(CHECKED * len(survey)))
    if count == 0 or not survey.engine.random:
        return {}
    # So many that enough remain when those traced otherwise are taken out.
    rows = survey.choose_distant_rows(count + len(left_out), campaign.scene.seed + 1)
    rows = np.sort(rows[~np.isin(rows, left_out)][:count])
    again = survey.trace(rows, campaign.decided, campaign.sampling.seed + 1)
    csi, spectrum, power = (traced[name][rows] for name in ("csi", "spectrum", "received_power"))
    frequency, wavelength = campaign.scene.frequency_hz, survey.engine.wavelength
    other = again.responses(frequency, campaign.csi.elements(wavelength), wavelength)
    energy = max(float((np.abs(csi) ** 2).sum()), np.finfo(float).tiny)
    images = [spectrum / 255, render_spectra(again, campaign.spectrum, frequency, wavelength)[0]]
    squared = ((images[0] - images[1]) ** 2).mean((1, 2))
    similar = [structural_similarity(a, b, data_range=1.0) for a, b in zip(*images, strict=True)]
    twice = np.stack([power, again.received_power()])
    # Only receivers that both seeds reach have levels to compare.
    difference_db = np.abs(np.diff(to_decibels(twice[:, (twice > 0).all(0)]), axis=0))
    return {
        "convergence_error": float((np.abs(csi - other) ** 2).sum() / energy),
        "convergence_spectrum_nmse": float(squared.sum() / (images[0] ** 2).mean((1, 2)).sum()),
        "convergence_spectrum_psnr_db": -float(np.mean(to_decibels(np.maximum(squared, 1e-12)))),
        "convergence_spectrum_ssim": float(np.mean(similar)),
        "convergence_power_db": (
            float(np.quantile(difference_db, 0.95)) if difference_db.size else 0.0
        ),
        "convergence_receivers": len(squared),
    }
