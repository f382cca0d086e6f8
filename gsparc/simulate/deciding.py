"""How a run comes to its effects: looked up, or by probes until it is clear, which are rows of the file."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.files import platform_cache, whole_file
from gsparc.simulate import auto, priors
from gsparc.simulate.attribution import Probe
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import Paths, join
from gsparc.simulate.scenes.placement import neighbours
from gsparc.simulate.settings import Campaign
from gsparc.simulate.survey import Survey

log = logging.getLogger(__name__)

NONE = np.zeros(0, dtype=np.int64)
TRIAL = 2  # how much more fewer rays are to save than their trial costs, because it may fail
OWN = ("name", "num_receivers", "test_share", "seed")  # of a scene's settings: not of what is decided


@dataclass(frozen=True)
class Changed:
    """Errors by what the requirement does not need, at held-back receivers.

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
        paths: of these rows, with `effects`.
    """

    choice: Choice
    effects: Effects
    samples: int | None = None
    changed: Changed | None = None
    rows: np.ndarray | None = None
    paths: Paths | None = None

    @property
    def as_chosen(self) -> bool:
        """Whether the choice is what is simulated."""
        return (self.effects, self.samples) == (self.choice.effects, self.choice.samples)

    def note(self) -> dict[str, Any]:
        """What a resumed run reads; without paths, which are in a shard."""
        changed = None if self.changed is None else [v.tolist() for v in vars(self.changed).values()]
        about = {"choice": asdict(self.choice), "effects": asdict(self.effects)}
        return {**about, "samples": self.samples, "changed": changed}

    @staticmethod
    def of(note: Mapping[str, Any]) -> Decision:
        """Inverse of `note`."""
        rows, errors = note["changed"] or ([], [])
        changed = Changed(np.array(rows, dtype=int), np.array(errors)) if rows else None
        effects = Effects(**note["effects"])
        return Decision(Choice.from_dict(note["choice"]), effects, note.get("samples"), changed)


class Traced:
    """Rows traced with everything, each once, and what they cost.

    Args:
        survey, effects: what is traced.
        ahead: rows in the order in which they may be asked for.
        size: rows of a call, which is filled up with those.

    Attributes:
        cold: CPU seconds of the first group, which compiles; None before.
        warm: of a row afterwards; None where there was one group only.
        compiling: of compiling, by the difference; None likewise.
    """

    def __init__(self, survey: Survey, effects: Effects, ahead: np.ndarray = NONE, size: int = 1) -> None:
        self.survey, self.effects, self._ahead, self._size = survey, effects, ahead, size
        self.rows = np.zeros(0, dtype=np.int64)
        self._parts: list[Paths] = []
        self.cold: float | None = None
        self._first = self._later = 0
        self._spent = 0.0

    def paths(self, rows: np.ndarray) -> Paths:
        """Paths of rows (n,); those not traced before are."""
        missing = np.setdiff1d(rows, self.rows)
        if len(missing):
            waiting = self._ahead[~np.isin(self._ahead, np.concatenate([self.rows, missing]))]
            missing = np.concatenate([missing, waiting[: -len(missing) % self._size]])
            begin = busy_s()
            self._parts.append(self.survey.trace(missing, self.effects))
            self.rows, cost = np.concatenate([self.rows, missing]), busy_s() - begin
            if self.cold is None:
                self.cold, self._first = cost, len(missing)
            else:
                self._spent, self._later = self._spent + cost, self._later + len(missing)
        at = np.argsort(self.rows)
        return join(self._parts).take(at[np.searchsorted(self.rows[at], rows)])

    @property
    def warm(self) -> float | None:
        """CPU seconds of a row once compiled."""
        return self._spent / self._later if self._later else None

    @property
    def compiling(self) -> float | None:
        """CPU seconds of the first group beyond those of its rows; 0 of an engine that compiles nothing."""
        if self.warm is None or self.cold is None:
            return None
        return max(self.cold - self._first * self.warm, 0.0) if self.survey.engine.random else 0.0


def busy_s() -> float:
    """CPU seconds of this process, without the system's.

    These are mostly of the first use of the solver's memory, which would pass for compiling.
    """
    return time.process_time() - os.times().system


def pays(choice: Choice, rows: int, saved: float) -> bool:
    """Whether a share of the time of so many rows, saved, pays for compiling the solver for other effects.

    Where rows were traced with the choice before, its kernels are in Dr.Jit's cache. In a later run those of
    everything are, of both sizes of a call, and all of the choice's are to be compiled.
    """
    if choice.row_chosen is not None or choice.row_all is None or choice.compiling is None:
        return rows > 0
    return rows * choice.row_all * saved > (2 if choice.reused else 1) * choice.compiling


def decide(campaign: Campaign, settings: AutoSettings, survey: Survey) -> Decision:
    """Look the decision up, or take it and store it."""
    begin = time.perf_counter()
    stored = platform_cache() / "scenes" / f"{_key(campaign, settings, survey)}.json"
    full = survey.engine.supported(settings.full)
    probes, held = _groups(survey, settings, campaign.scene.seed)
    if settings.reuse and stored.exists():
        choice = Choice.from_dict(json.loads(stored.read_text(encoding="utf-8")))
        asked = len(probes) + len(held)
        if not (choice.untried and _may_pay(choice, settings, full, len(survey) - asked, asked)):
            log.info("auto: as decided before for this scene and requirement: %s", choice.effects)
            choice = replace(choice, reused=True, seconds=time.perf_counter() - begin)
            return Decision(choice, *_simulated(campaign, choice, full, len(survey)))
    size = campaign.sampling.part if survey.engine.random else 1
    traced = Traced(survey, full, np.concatenate([probes, held]), size)
    choice, changed = _look(campaign, settings, survey, traced, probes), None
    if choice.effects == full:
        log.info("auto: every effect is needed")
    else:
        log.info("auto: %s; verifying on held-back receivers", choice.effects)
        choice, changed = _verify(campaign, settings, traced, choice, held)
        if choice.verdict is not None and not choice.verdict.kept:
            log.info("auto: held-back receivers refute it; everything is needed")
            choice = auto.everything(choice, full)
    if settings.rays < 1 and survey.engine.random:
        choice, changed = _fewer_rays(campaign, settings, traced, choice, changed, probes, held)
    choice = replace(choice, row_all=traced.warm, compiling=traced.compiling)
    effects, samples = _simulated(campaign, choice, full, len(survey) - len(traced.rows))
    choice = replace(choice, seconds=time.perf_counter() - begin)
    _remember(stored, choice)
    rows = np.sort(traced.rows)
    return Decision(choice, effects, samples, changed, rows, traced.paths(rows).under(effects))


def _simulated(campaign: Campaign, choice: Choice, full: Effects, rows: int) -> tuple[Effects, int | None]:
    """Effects and rays of the choice, or everything where that is cheaper for so many rows."""
    rays = 1.0 if choice.samples is None else choice.samples / campaign.sampling.samples
    price = auto.price(choice.effects, full, rays)
    if (choice.effects == full and rays == 1) or pays(choice, rows, 1 - price):
        return choice.effects, choice.samples
    log.info("auto: everything is simulated: for %d receivers, compiling anew costs more", rows)
    return full, None


def _may_pay(choice: Choice, settings: AutoSettings, full: Effects, rows: int, asked: int) -> bool:
    """Whether trying fewer rays on rows that were asked can pay on so many others."""
    if choice.row_all is None or choice.compiling is None:
        return False
    all_, fewer = (auto.price(choice.effects, full, rays) for rays in (1.0, settings.rays))
    trial = asked * fewer * choice.row_all + choice.compiling
    return rows * (all_ - fewer) * choice.row_all > TRIAL * trial


def remember(campaign: Campaign, settings: AutoSettings, survey: Survey, choice: Choice) -> None:
    """Store a decision anew, with what rows were measured to cost."""
    _remember(platform_cache() / "scenes" / f"{_key(campaign, settings, survey)}.json", choice)


def _groups(survey: Survey, settings: AutoSettings, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Probes and held-back rows, both spread out, the first of each spread out as well."""
    wanted = settings.probes + settings.held_back
    chosen = survey.spread(wanted, seed)
    share = settings.probes / wanted
    # Farthest-point order: taking every so many leaves both groups spread out.
    turn = np.floor(np.arange(1, len(chosen) + 1) * share) > np.floor(np.arange(len(chosen)) * share)
    return chosen[turn], chosen[~turn]


def _look(
    campaign: Campaign, settings: AutoSettings, survey: Survey, traced: Traced, probes: np.ndarray
) -> Choice:
    """The first look and, where it leaves something open, the last."""
    materials = survey.engine.materials()
    choice = None
    for count in (auto.first_look(len(probes)), len(probes)):
        rows = probes[:count]
        log.info("auto: %d probes with %s", count, traced.effects)

        def why(probe: Probe, rows: np.ndarray = rows) -> dict[str, str]:
            return priors.reasons(probe, survey.distances()[rows], materials)

        choice = auto.decide(_probe(campaign, traced, rows), settings, why, last=count == len(probes))
        if choice is not None:
            return choice
    raise AssertionError("the last look decides")


def _fewer_rays(
    campaign: Campaign, settings: AutoSettings, traced: Traced, choice: Choice, changed: Changed | None,
    probes: np.ndarray, held: np.ndarray,
) -> tuple[Choice, Changed | None]:  # fmt: skip
    """Whether a share of the rays is enough: probes, then held-back rows, traced with the choice and those.

    Rays that are fewer are other rays, so that no attribution tells. What was traced so is no row of the
    file: the same rows are there with all rays.
    """
    survey, part = traced.survey, campaign.sampling.part
    if len(survey) - len(traced.rows) > campaign.sampling.batch:
        traced.paths(held[: auto.first_look(len(held))])  # rows of the file, which say what one costs
    choice = replace(choice, row_all=traced.warm, compiling=traced.compiling)
    if not _may_pay(choice, settings, traced.effects, len(survey) - len(traced.rows), len(traced.rows)):
        return replace(choice, untried=True), changed
    samples = max(round(settings.rays * campaign.sampling.samples), 1)
    log.info("auto: probes with %d rays", samples)
    fewer = Traced(survey.thinned(samples), choice.effects, np.concatenate([probes, held]), part)
    for count in (auto.first_look(len(probes)), len(probes)):
        rows, last = probes[:count], count == len(probes)
        probe = _probe(campaign, traced, rows)
        found = auto.fewer_rays(choice, settings, probe, fewer.paths(rows), samples, last)
        if found is not None:
            break
    assert found is not None  # the last look decides
    if found.samples is None:
        return found, changed
    verified, errors = _verify(campaign, settings, traced, found, held, fewer)
    if verified.verdict is not None and not verified.verdict.kept:
        return replace(auto.without_fewer_rays(found), verdict=choice.verdict), changed
    return verified, errors


def _verify(
    campaign: Campaign, settings: AutoSettings, traced: Traced, choice: Choice, held: np.ndarray,
    fewer: Traced | None = None,
) -> tuple[Choice, Changed]:  # fmt: skip
    """On the first half of the held-back rows, and on all where that does not prove the requirement."""
    for count in (auto.first_look(len(held)), len(held)):
        probe = _probe(campaign, traced, held[:count])
        kept = None if fewer is None else fewer.paths(held[:count])
        choice = auto.verify(choice, settings, probe, kept)
        errors = probe.errors(choice.effects if kept is None else kept, settings.required)
        failed = int((errors[probe.reached] > settings.required.tolerance).sum())
        heard = int(probe.reached.sum())
        early, _ = auto.allowed_failures(heard, len(held), settings.quantile, settings.confidence)
        if failed <= early:
            break
    return choice, Changed(held[:count], errors)


def _probe(campaign: Campaign, traced: Traced, rows: np.ndarray) -> Probe:
    """Rows traced with everything, and their nearest others where the requirement is about spectra."""
    survey, nearest = traced.survey, None
    if isinstance(campaign.effects, AutoSettings) and campaign.effects.required.kind == "spectrum":
        owner, place = np.divmod(rows, len(survey.places))
        nearest = traced.paths(owner * len(survey.places) + neighbours(survey.places, place))
    wavelength = survey.engine.wavelength
    elements, frequency = campaign.csi.elements(wavelength), campaign.scene.frequency_hz
    return Probe(
        traced.paths(rows), traced.effects, frequency, wavelength, elements, campaign.spectrum, nearest
    )


def _key(campaign: Campaign, settings: AutoSettings, survey: Survey) -> str:
    """Hash of geometry, materials, transmitters, where receivers are, band, solver and requirement."""
    scene = {name: value for name, value in asdict(campaign.scene).items() if name not in OWN}
    asked = {name: value for name, value in asdict(settings).items() if name != "reuse"}
    about: dict[str, Any] = {
        "geometry": survey.engine.fingerprint(), "transmitters": survey.transmitters.tolist(),
        "materials": survey.engine.materials(), "versions": survey.engine.versions(), "scene": scene,
        "asked": asked, "antennas": [getattr(e, "antenna", None) for e in survey.engines], 
        "samples": campaign.sampling.samples, "names": survey.names, "inputs": campaign.inputs(),
    }  # fmt: skip
    if settings.required.kind != "coverage":
        about |= {"csi": asdict(campaign.csi), "spectrum": asdict(campaign.spectrum)}
    return hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()[:32]


def _remember(stored: Path, choice: Choice) -> None:
    with whole_file(stored) as partial:
        partial.write_text(json.dumps(asdict(choice), indent=1), encoding="utf-8")
