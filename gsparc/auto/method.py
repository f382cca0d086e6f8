"""`model=gsparc`: the field with the effects that the site calls for, and nothing else computed."""

from __future__ import annotations

import copy
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from gsparc.array.moving.method import BearingField
from gsparc.auto.combine import (
    Companion,
    Rest,
    Told,
    learn_rest,
    left_out_nmse,
    restored,
    searched_beyond,
    weight_of,
)
from gsparc.auto.decide import (
    SPLAT,
    Decision,
    EffectSettings,
    contest_array,
    decide_array,
    decide_directions,
    decide_phase,
    probe_array,
    probe_phase,
)
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.response import ResponseSettings
from gsparc.methods.gp import GaussianProcess
from gsparc.methods.method import FitReport, Method, Prediction
from gsparc.multipath.directional_gp import DirectedSources
from gsparc.multipath.image_source_gp import VirtualSourceGP
from gsparc.ops import Pose
from gsparc.training.fit import Training
from gsparc.training.splatting import LearnedField

log = logging.getLogger(__name__)

# The say of directed sources above which nobody else is asked, below which they are not.
ALONE, UNHEARD = 0.9, 0.05
HOPELESS = 0.9  # NMSE of held-out channels from which on a short search promises nothing of a long one


class Gsparc(LearnedField):
    """The splatted field, or sources with carrier phase, or sources seen through an array.

    Args:
        effects: switches; `auto` decides from the site and a probe on training data.
        phase_model: what predicts where `phase` is on.
        phase_probe: the same with a small budget, for the probe.
        array_model: what predicts where `array` is on and the receiver is static.
        bearing_model: what predicts where `array` is on and the receiver moves.
        directed_model: what predicts, alone or with `phase_model`, where `directions` is on; checkpoints of
            before there was one have none.
        **field: see `LearnedField`.
    """

    def __init__(
        self,
        effects: EffectSettings,
        phase_model: Method,
        phase_probe: VirtualSourceGP,
        array_model: Method,
        bearing_model: Method,
        directed_model: DirectedSources | None = None,
        **field: Any,
    ) -> None:
        response = replace(
            field.pop("response", ResponseSettings()),
            array=effects.array == SPLAT,
            carrier=effects.phase == SPLAT,
        )
        super().__init__(response=response, **field)
        self.switches = effects
        self._models: dict[str, Method] = {"phase": phase_model, "array": array_model}
        self._directed, self._optimism = directed_model or DirectedSources(), 1.0
        self._models |= {"bearings": bearing_model, "directions": self._directed}
        self._followed = FitReport(0.0)
        self._probe = phase_probe
        self._chosen: str | None = None
        self._rest: Companion | None = None
        self.decisions: tuple[Decision, ...] = ()

    @property
    def effects(self) -> str:
        """The effects that are computed, for `summary.json`."""
        response = self.settings.response
        splatted = [name for name, on in (("array", response.array), ("phase", response.carrier)) if on]
        told, rest = ("+directions", self._rest.rest) if isinstance(self._rest, Told) else ("", self._rest)
        chosen = self._chosen or "+".join(f"{name} (splat)" for name in splatted) or "none"
        return chosen + told + ("" if rest is None else "+hybrid")

    @property
    def answering(self) -> tuple[Method, Companion | None]:
        """What computes the answers, itself when no effect is on, and what completes them."""
        return (self if self._chosen is None else self._models[self._chosen]), self._rest

    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Decide, then train what was decided on; the probe's time is part of the bill."""
        self.site = data.site
        self.decisions = self._decide(data, fold)
        for decision in self.decisions:
            log.info("%s", decision)
        others = (d.effect for d in self.decisions if d.on and getattr(self.switches, d.effect) != SPLAT)
        self._chosen = next(others, None)
        if self._chosen == "array" and data.site.static_end == "tx":
            self._chosen = "bearings"
        if self._chosen is None:
            report = super().fit(data, fold, run_dir)
        else:
            if (
                self._chosen != "directions"
            ):  # they were followed while deciding: nothing is left to go on with
                self._go_on(self._models[self._chosen])
            log.info("settings of the splatted field (emission, raster, trainer) are not used")
            chosen, budget_s = self._models[self._chosen], self.training.settings.budget_s
            if budget_s is not None:
                _limit(chosen, self.training, budget_s - sum(d.seconds for d in self.decisions))
            report = self._followed if self._chosen == "directions" else chosen.fit(data, fold, run_dir)
            decision, self._rest = learn_rest(self.switches.hybrid, self._models[self._chosen], data, fold)
            log.info("%s", decision)
            self.decisions = (*self.decisions, decision)
            self._listen()
        return FitReport(report.seconds + sum(d.seconds for d in self.decisions), report.notes)

    def _listen(self) -> None:
        """Weigh sources of measured directions beside searched ones."""
        told = any(d.effect == "directions" and d.on for d in self.decisions)
        searched = None if self._chosen is None else self._models[self._chosen]
        if not told or not isinstance(searched, VirtualSourceGP):
            return
        weight = weight_of(self._directed, searched, self._optimism)
        log.info("effects.directions: %.0f%% of the say, by left-out channels", 100 * weight)
        if weight > ALONE:
            self._chosen, self._rest = "directions", None
        elif weight > UNHEARD:
            assert self._rest is None or isinstance(self._rest, Rest)
            self._rest = Told(self._directed, weight, self._rest)

    def _go_on(self, model: Method) -> None:
        """Hand over what an interrupted run has left."""
        if self.training.resume is None:
            return
        if not hasattr(model, "resume"):
            raise ValueError(
                f"ckpt_path: effects.{self._chosen} finds the vectors it has recovered by itself; "
                "start again without ckpt_path"
            )
        model.resume = self.training.resume

    def _decide(self, data: Measurements, fold: Fold) -> tuple[Decision, ...]:
        hidden = self.settings.emission.hidden
        splatting = f"emission.hidden={hidden}" if hidden else None
        antennas = data.target.shape[1] if data.site.kind == "csi" else 1
        phase = decide_phase(self.switches.phase, data.site, splatting, antennas)
        array = decide_array(self.switches.array, data.site, splatting)
        sources = phase.on and self.switches.phase != SPLAT
        directions = decide_directions(self.switches.directions, sources, data)
        if directions.on:
            directions = self._follow(data, fold)
        if directions.on and sources:
            phase = self._search_beside(data, fold)
        elif phase.on and self.switches.phase == "auto":
            phase = probe_phase(self._probe, GaussianProcess(), data, fold, self.training.seed)
        if array.on and self.switches.array == "auto":
            array = probe_array(data, fold, self.training.seed)
            if array.on and data.site.static_end == "rx":
                array = self._contest(array, data, fold)
        return phase, array, directions

    def _contest(self, array: Decision, data: Measurements, fold: Fold) -> Decision:
        """The array's vectors explain the spectra; whether they also foretell them."""
        trial = copy.deepcopy(self._models["array"])
        contest = contest_array(trial, GaussianProcess(), data, fold, self.training.seed)
        if contest.on:
            return replace(array, seconds=array.seconds + contest.seconds)
        return replace(contest, seconds=array.seconds + contest.seconds)

    def _search_beside(self, data: Measurements, fold: Fold) -> Decision:
        """Whether a search is worth its time beside measured directions."""
        started = time.perf_counter()
        error, self._optimism = searched_beyond(self._probe, data, fold.train, self.training.seed)
        reason = (
            f"short searches leave NMSE {error:.3f} of held-out channels, "
            f"{self._optimism:.1f} times what they promise"
        )
        on = error < HOPELESS or self.switches.phase is True
        return Decision("phase", on, reason, time.perf_counter() - started)

    def _follow(self, data: Measurements, fold: Fold) -> Decision:
        """Sources of measured directions, used where they predict left-out channels at all."""
        wanted = self.switches.directions is True
        try:
            report = self._directed.fit(data, fold, Path())
            self._followed = replace(report, seconds=0.0)  # the decision's own
        except ValueError as error:
            if wanted:
                raise
            return Decision("directions", False, str(error))
        nmse = left_out_nmse(self._directed, data)
        reason = f"{self._directed.size()} sources where rays meet leave NMSE {nmse:.3f} of left-out channels"
        return Decision("directions", wanted or nmse < 1, reason, report.seconds)

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the variance errs high by what a process beside it explains."""
        if self._chosen is None:
            return super().predict(tx, rx)
        said = self._models[self._chosen].predict(tx, rx)
        if self._rest is None:
            return said
        return replace(said, mean=self._rest.completed(said.mean, tx, rx))

    def state(self) -> dict[str, Any]:
        """What was chosen, and its state."""
        inner = super().state() if self._chosen is None else self._models[self._chosen].state()
        rest = None if self._rest is None else self._rest.state()
        return {"chosen": self._chosen, "inner": inner, "rest": rest}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self._chosen = site, state["chosen"]
        if self._chosen is None:
            super().restore(site, state["inner"])
        else:
            self._models[self._chosen].restore(site, state["inner"])
        rest = state.get("rest")
        self._rest = None if rest is None else restored(site, rest)

    def size(self) -> int:
        """Number of Gaussians or sources."""
        return super().size() if self._chosen is None else self._models[self._chosen].size()


def _limit(chosen: Method, training: Training, budget_s: float) -> None:
    """Leave a method that takes a budget what the probes have left of it [s]."""
    if isinstance(chosen, VirtualSourceGP):
        chosen.budget_s = budget_s
    elif isinstance(chosen, BearingField):
        chosen.training = Training(replace(training.settings, budget_s=max(budget_s, 1.0)), training.seed)
