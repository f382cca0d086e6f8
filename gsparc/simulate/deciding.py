"""Choose the effects of a run: trace probes with all of them,
drop what the tolerance does not need.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gsparc.simulate import auto
from gsparc.simulate.attribution import SurveyProbe
from gsparc.simulate.auto import AutoSettings, Choice
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.scenes.receivers import nearest_rows
from gsparc.simulate.settings import CampaignSettings
from gsparc.simulate.survey import Survey

log = logging.getLogger(__name__)

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
