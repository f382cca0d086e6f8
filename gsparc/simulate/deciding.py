"""Choose the effects of a run: trace probes with all of them, drop what the tolerance does not need."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import numpy as np

from gsparc.simulate import auto
from gsparc.simulate.attribution import Probe
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.effects import PropagationEffects
from gsparc.simulate.paths import Paths, join
from gsparc.simulate.scenes.receivers import neighbours
from gsparc.simulate.settings import Campaign
from gsparc.simulate.survey import Survey

log = logging.getLogger(__name__)
Judgement = TypeVar("Judgement")

NONE = np.zeros(0, dtype=np.int64)
TRIAL = 2  # how much more fewer rays are to save than their trial costs, because it may fail


@dataclass(frozen=True)
class Changed:
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
        effects: what is simulated: that, or everything where few rows are left, whose saving would not pay
            for compiling the solver for other effects.
        samples: with how many rays of a call; None for those of the settings.
        changed: errors at held-back receivers; None where there are none.
        rows: (n,) of the survey, those that were traced.
        paths: of these rows, with `effects`; None in a resumed run, which has them in a shard.
    """

    choice: Choice
    effects: PropagationEffects
    samples: int | None = None
    changed: Changed | None = None
    rows: np.ndarray | None = None
    paths: Paths | None = None

    @property
    def as_chosen(self) -> bool:
        """Tell whether the choice is what is simulated."""
        return (self.effects, self.samples) == (self.choice.effects, self.choice.samples)

    def note(self) -> dict[str, Any]:
        """Return what a resumed run reads; without paths, which are in a shard."""
        changed = None if self.changed is None else [v.tolist() for v in vars(self.changed).values()]
        about = {"choice": asdict(self.choice), "effects": asdict(self.effects)}
        return {**about, "samples": self.samples, "changed": changed}

    @staticmethod
    def of(note: Mapping[str, Any]) -> Decision:
        """Invert `note`."""
        rows, errors = note["changed"] or ([], [])
        changed = Changed(np.array(rows, dtype=int), np.array(errors)) if rows else None
        effects = PropagationEffects(**note["effects"])
        return Decision(Choice.from_dict(note["choice"]), effects, note.get("samples"), changed)


class Traced:
    """Rows traced with some effects, each once; calls of `size` are filled up with what is needed `ahead`."""

    def __init__(
        self, survey: Survey, effects: PropagationEffects, ahead: np.ndarray = NONE, size: int = 1
    ) -> None:
        self.survey, self.effects, self._ahead, self._size = survey, effects, ahead, size
        self.rows = NONE
        self._parts: list[Paths] = []
        self._costs: list[float] = []  # CPU seconds of each part

    def paths(self, rows: np.ndarray) -> Paths:
        """Return paths of rows (n,), tracing those that were not traced before."""
        missing = np.setdiff1d(rows, self.rows)
        if len(missing):
            # A call that is half full costs as much: it is filled up with rows that follow anyway.
            waiting = self._ahead[~np.isin(self._ahead, np.concatenate([self.rows, missing]))]
            missing = np.concatenate([missing, waiting[: -len(missing) % self._size]])
            begin = busy_s()
            self._parts.append(self.survey.trace(missing, self.effects))
            self._costs.append(busy_s() - begin)
            self.rows = np.concatenate([self.rows, missing])
        at = np.argsort(self.rows)
        return join(self._parts).take(at[np.searchsorted(self.rows[at], rows)])

    def timed(self, choice: Choice) -> Choice:
        """Return the choice with CPU seconds of a row, and of compiling, which the first part does."""
        # One part alone does not tell compiling from tracing.
        if len(self._parts) < 2:
            return replace(choice, row_all=None, compiling=None)
        first = len(self._parts[0])
        # The first part compiles: what it took beyond its rows at the others' pace is compiling.
        row_s = sum(self._costs[1:]) / (len(self.rows) - first)
        compiling = max(self._costs[0] - first * row_s, 0.0) if self.survey.engine.random else 0.0
        return replace(choice, row_all=row_s, compiling=compiling)


def busy_s() -> float:
    """Return CPU seconds of this process, without the system's.

    These are mostly of the first use of the solver's memory, which would pass for compiling.
    """
    return time.process_time() - os.times().system


def pays(choice: Choice, rows: int, saved: float) -> bool:
    """Tell whether a share of the time of so many rows pays for compiling the solver anew."""
    if choice.row_all is None or choice.compiling is None:
        return rows > 0
    return rows * choice.row_all * saved > choice.compiling


class Decider:
    """Chooses the effects of one campaign, whose survey is traced with all rays."""

    def __init__(self, campaign: Campaign, settings: AutoSettings, survey: Survey) -> None:
        self.campaign, self.settings, self.survey = campaign, settings, survey
        self.full = survey.engine.supported(settings.full)
        self.probes, self.held_back = self._groups()

    def decide(self) -> Decision:
        """Measure probes, decide, verify."""
        begin, both = time.perf_counter(), np.concatenate([self.probes, self.held_back])
        # A call costs the same full or not, as kernels are compiled for its number of receivers.
        size = self.campaign.sampling.part if self.survey.engine.random else 1
        traced = Traced(self.survey, self.full, both, size)
        choice, changed = self._choose(traced), None
        if choice.effects == self.full:
            log.info("auto: every effect is needed")
        else:
            log.info("auto: %s; verifying on held-back receivers", choice.effects)
            choice, changed = self._verify(traced, choice)
            if choice.verdict is not None and not choice.verdict.kept:
                log.info("auto: verification on held-back receivers failed; everything is simulated")
                choice = auto.everything(choice, self.full)
        # After the effects, as fewer rays are tried with those that were chosen.
        if self.settings.rays < 1 and self.survey.engine.random:
            choice, changed = self._fewer_rays(traced, choice, changed)
        choice = traced.timed(choice)
        effects, samples = self._simulated(choice, len(self.survey) - len(traced.rows))
        choice = replace(choice, seconds=time.perf_counter() - begin)
        rows = np.sort(traced.rows)
        return Decision(choice, effects, samples, changed, rows, traced.paths(rows).under(effects))

    def _simulated(self, choice: Choice, rows: int) -> tuple[PropagationEffects, int | None]:
        """Effects and rays of the choice, or everything where that is cheaper for so many rows."""
        rays = 1.0 if choice.samples is None else choice.samples / self.campaign.sampling.samples
        price = auto.price(choice.effects, self.full, rays)
        if (choice.effects == self.full and rays == 1) or pays(choice, rows, 1 - price):
            return choice.effects, choice.samples
        log.info("auto: everything is simulated: for %d receivers, compiling anew costs more", rows)
        return self.full, None

    def _may_pay(self, choice: Choice, rows: int, trial_rows: int) -> bool:
        """Whether trying fewer rays on some rows can pay on so many others."""
        if choice.row_all is None or choice.compiling is None:
            return False
        all_, fewer = (auto.price(choice.effects, self.full, rays) for rays in (1.0, self.settings.rays))
        trial = trial_rows * fewer * choice.row_all + choice.compiling
        return rows * (all_ - fewer) * choice.row_all > TRIAL * trial

    def _groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Probes and held-back rows, both spread out, the first of each spread out as well."""
        wanted = self.settings.probes + self.settings.held_back
        chosen = self.survey.spread(wanted, self.campaign.scene.seed)
        share = self.settings.probes / wanted
        # Farthest-point order: taking every so many leaves both groups spread out.
        turn = np.floor(np.arange(1, len(chosen) + 1) * share) > np.floor(np.arange(len(chosen)) * share)
        return chosen[turn], chosen[~turn]

    def _choose(self, traced: Traced) -> Choice:
        """By the first look and, where it leaves something open, the last."""

        def judge(rows: np.ndarray, last: bool) -> Choice | None:
            log.info("auto: deciding on effects at %d receivers, traced with %s", len(rows), traced.effects)
            return auto.decide(self._probe(traced, rows), self.settings, last)

        return _until_clear(self.probes, judge)

    def _fewer_rays(
        self, traced: Traced, choice: Choice, changed: Changed | None
    ) -> tuple[Choice, Changed | None]:
        """Whether a share of the rays is enough: probes, then held-back rows, with the choice and those.

        Fewer rays are drawn anew, so that attribution says nothing about them. Their paths are not written to
        the file, which has the same rows with all rays.
        """
        survey, sampling = self.survey, self.campaign.sampling
        if len(survey) - len(traced.rows) > sampling.batch:  # rows of the file, which say what one costs
            traced.paths(self.held_back[: auto.first_look(len(self.held_back))])
        choice = traced.timed(choice)
        if not self._may_pay(choice, len(survey) - len(traced.rows), len(traced.rows)):
            return choice, changed
        samples = max(round(self.settings.rays * sampling.samples), 1)
        log.info("auto: probes with %d rays", samples)
        both = np.concatenate([self.probes, self.held_back])
        fewer = Traced(survey.thinned(samples), choice.effects, both, sampling.part)

        def judge(rows: np.ndarray, last: bool) -> Choice | None:
            probe = self._probe(traced, rows)
            return auto.fewer_rays(choice, self.settings, probe, fewer.paths(rows), samples, last)

        thinned = _until_clear(self.probes, judge)
        if thinned.samples is None:
            return thinned, changed
        verified, errors = self._verify(traced, thinned, fewer)
        if verified.verdict is not None and not verified.verdict.kept:
            return replace(auto.without_fewer_rays(thinned), verdict=choice.verdict), changed
        return verified, errors

    def _verify(self, traced: Traced, choice: Choice, fewer: Traced | None = None) -> tuple[Choice, Changed]:
        """On the first half of the held-back rows, and on all where that does not prove the requirement."""
        required = self.settings.required

        def judge(rows: np.ndarray, last: bool) -> tuple[Choice, Changed] | None:
            probe = self._probe(traced, rows)
            errors = probe.errors(choice.effects if fewer is None else fewer.paths(rows), required)
            heard = errors[probe.reached]
            early, _ = self.settings.allowed_failures(len(heard), last=False)
            if not last and (heard > required.tolerance).sum() > early:
                return None
            return auto.verify(choice, self.settings, heard), Changed(rows, errors)

        return _until_clear(self.held_back, judge)

    def _probe(self, traced: Traced, rows: np.ndarray) -> Probe:
        """Rows traced with everything, and their nearest others where the requirement is about spectra."""
        campaign, survey, nearest = self.campaign, traced.survey, None
        if self.settings.required.kind == "spectrum":
            owner, place = np.divmod(rows, len(survey.places))
            # The nearest other place, with the same transmitter.
            nearest = traced.paths(owner * len(survey.places) + neighbours(survey.places, place))
        wavelength, frequency = survey.engine.wavelength, campaign.scene.frequency_hz
        array = campaign.csi.elements(wavelength)
        paths = traced.paths(rows)
        return Probe(paths, traced.effects, frequency, wavelength, array, campaign.spectrum, nearest)


def _until_clear(rows: np.ndarray, judge: Callable[[np.ndarray, bool], Judgement | None]) -> Judgement:
    """What is judged by the first rows, or by all of them where those leave something open."""
    first = auto.first_look(len(rows))
    judgement = judge(rows[:first], first == len(rows))
    if judgement is None:
        judgement = judge(rows, True)
    assert judgement is not None  # the last look decides
    return judgement
