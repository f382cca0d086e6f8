"""`model=gsparc`: the field with the effects that the site calls for, and nothing else computed."""

from __future__ import annotations

import copy
import logging
import time
from dataclasses import replace
from typing import Any

from torch import Tensor

from gsparc.auto import combine, decide
from gsparc.auto.combine import Companion, DirectionalEnsemble
from gsparc.auto.decide import SPLAT, Decision, EffectSettings
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.response import ResponseSettings
from gsparc.methods.method import (
    Differentiable,
    FitContext,
    FitReport,
    HasPaths,
    LeaveOneOut,
    Method,
    Prediction,
)
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import View, contributions, knobs, reduced
from gsparc.methods.registry import method_class
from gsparc.methods.time_budget import Clock, less_repeatable
from gsparc.ops import Pose
from gsparc.training.splatting import LearnedField

log = logging.getLogger(__name__)

# Weight of the directional model above which it predicts alone, below which it is not used.
ALONE, UNUSED = 0.9, 0.05
HOPELESS = 0.9  # NMSE of held-out channels from which on a short search promises nothing of a long one
LEAST_BUDGET_S = 1.0  # left to what was decided on, however long deciding took


class Gsparc(LearnedField):
    """The splatted field, or sources with carrier phase, or sources seen through an array.

    Args:
        effects: switches; `auto` decides from the site and a probe on training data.
        phase_model: what predicts where `phase` is on.
        phase_probe: the same with a small budget, for the probe.
        array_model: what predicts where `array` is on and the receiver is static.
        moving_array_model: what predicts where `array` is on and the receiver moves.
        directional_model: what predicts, alone or with `phase_model`, where `directions` is on; None in
            early checkpoints.
        **field: see `LearnedField`.
    """

    def __init__(
        self,
        effects: EffectSettings,
        phase_model: Method,
        phase_probe: Method,
        array_model: Method,
        moving_array_model: Method,
        directional_model: Method | None = None,
        **field: Any,
    ) -> None:
        splatted = {"array": effects.array == SPLAT, "carrier": effects.phase == SPLAT}
        response = replace(field.pop("response", ResponseSettings()), **splatted)
        super().__init__(response=response, **field)
        self.switches = effects
        self._models = {"phase": phase_model, "array": array_model, "moving_array": moving_array_model}
        self._models["directions"] = directional_model or method_class("directional_gp")()
        self._directional, self._ratio = self._models["directions"], 1.0
        self._directional_report = FitReport(0.0)
        self._probe = phase_probe
        self._chosen: str | None = None
        self._companion: Companion | None = None
        self.decisions: tuple[Decision, ...] = ()

    @property
    def takes_budget(self) -> bool:  # type: ignore[override]
        """Whether what was chosen does."""
        return self._chosen is None or self._models[self._chosen].takes_budget

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The effects that are computed, for `summary.json`."""
        response, companion, directions = self.settings.response, self._companion, ""
        splatted = [name for name, on in (("array", response.array), ("phase", response.carrier)) if on]
        if isinstance(companion, DirectionalEnsemble):
            directions, companion = "+directions", companion.rest
        chosen = self._chosen or "+".join(f"{name} (splat)" for name in splatted) or "none"
        return chosen + directions + ("" if companion is None else "+hybrid")

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Decide, then train what was decided on; the probe's time is part of the bill."""
        self.site, budget = data.site, context.time_budget()
        self.decisions = self._decide(data, fold, context)
        for decision in self.decisions:
            log.info("%s", decision)
        others = (d.effect for d in self.decisions if d.on and getattr(self.switches, d.effect) != SPLAT)
        self._chosen = self._named(next(others, None), data.site)
        if context.budget_s is not None:
            if budget.seconds - budget.spent < LEAST_BUDGET_S:
                log.warning("budget_s=%g: deciding took %.1f s of them", context.budget_s, budget.spent)
            context = replace(context, budget_s=max(budget.seconds - budget.spent, LEAST_BUDGET_S))
        if self._chosen is None:
            report = super().fit(data, fold, context)
        else:
            log.info("settings of the splatted field (emission, raster, trainer) are not used")
            report = self._fit_chosen(data, fold, context)
            model = self._models[self._chosen]
            decision, self._companion = combine.learn_companion(self.switches.hybrid, model, data, fold)
            log.info("%s", decision)
            self.decisions = (*self.decisions, decision)
            self._weigh_directional()
        limited = less_repeatable(report.limited_by, *(d.limited_by for d in self.decisions))
        seconds = report.seconds + sum(d.seconds for d in self.decisions)
        return replace(report, seconds=seconds, limited_by=limited)

    @staticmethod
    def _named(effect: str | None, site: Site) -> str | None:
        return "moving_array" if effect == "array" and site.static_end == "tx" else effect

    def _fit_chosen(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        chosen = self._models[self._chosen or ""]
        if chosen is self._directional:  # fitted while deciding
            return self._directional_report
        if context.resume is not None and not chosen.resumable:
            raise ValueError(
                f"ckpt_path: effects.{self._chosen} trains in one piece (recovered vectors are cached); "
                "start again without ckpt_path"
            )
        return chosen.fit(data, fold, context)

    def _weigh_directional(self) -> None:
        """Weigh sources of measured directions beside searched ones."""
        wanted = any(d.effect == "directions" and d.on for d in self.decisions)
        searched = None if self._chosen is None else self._models[self._chosen]
        if not wanted or searched is self._directional or not isinstance(searched, LeaveOneOut):
            return
        weight = combine.weight_of(self._directional, searched, self._ratio)  # type: ignore[arg-type]
        log.info("effects.directions: weight %.0f%%, by left-out channels", 100 * weight)
        if weight > ALONE:
            self._chosen, self._companion = "directions", None
        elif weight > UNUSED:
            self._companion = DirectionalEnsemble(self._directional, weight, self._companion)

    def _decide(self, data: Measurements, fold: Fold, context: FitContext) -> tuple[Decision, ...]:
        seed, clock = context.seed, context.budget_clock
        hidden = self.settings.emission.hidden
        splatting = f"emission.hidden={hidden}" if hidden else None
        antennas = data.target.shape[1] if data.site.kind == "csi" else 1
        phase = decide.decide_phase(self.switches.phase, data.site, splatting, antennas)
        array = decide.decide_array(self.switches.array, data.site, splatting)
        sources = phase.on and self.switches.phase != SPLAT
        directions = decide.decide_directions(self.switches.directions, sources, data)
        if directions.on:
            directions = self._fit_directional(data, fold)
        if directions.on and sources:
            phase = self._search_beside(data, fold, seed, clock)
        elif phase.on and self.switches.phase == "auto":
            phase = decide.probe_phase(self._probe, method_class("gp")(), data, fold, seed, clock)
        if array.on and self.switches.array == "auto":
            candidate = self._models[self._named("array", data.site) or ""]
            array = decide.probe_array(candidate, data, fold, seed)
            if array.on and data.site.static_end == "rx":
                array = self._contest(array, data, fold, seed)
        return phase, array, directions

    def _contest(self, array: Decision, data: Measurements, fold: Fold, seed: int) -> Decision:
        """The array's vectors explain the spectra; whether they predict held-out spectra."""
        trial = copy.deepcopy(self._models["array"])
        contest = decide.contest_array(trial, method_class("gp")(), data, fold, seed)
        seconds = array.seconds + contest.seconds
        return replace(array if contest.on else contest, seconds=seconds, limited_by=contest.limited_by)

    def _search_beside(self, data: Measurements, fold: Fold, seed: int, clock: Clock) -> Decision:
        """Whether a search is worth its time beside measured directions."""
        started = time.perf_counter()
        error, self._ratio, limited = combine.held_out_ratio(self._probe, data, fold.train, seed, clock)
        reason = (
            f"short searches leave NMSE {error:.3f} of held-out channels, "
            f"{self._ratio:.1f} times their leave-one-out error"
        )
        on = error < HOPELESS or self.switches.phase is True
        return Decision("phase", on, reason, time.perf_counter() - started, limited)

    def _fit_directional(self, data: Measurements, fold: Fold) -> Decision:
        """Sources of measured directions, used where they predict left-out channels at all."""
        wanted = self.switches.directions is True
        try:
            report = self._directional.fit(data, fold, FitContext())
            self._directional_report = replace(report, seconds=0.0)  # the decision's own
        except ValueError as error:
            if wanted:
                raise
            return Decision("directions", False, str(error))
        nmse = combine.left_out_nmse(self._directional, data)
        reason = f"{self._directional.size()} triangulated sources leave a leave-one-out NMSE of {nmse:.3f}"
        return Decision("directions", wanted or nmse < 1, reason, report.seconds)

    # -- answering ---------------------------------------------------------------------------------

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the variance errs high by what a companion explains."""
        if self._chosen is None:
            return super().predict(tx, rx)
        found = self._models[self._chosen].predict(tx, rx)
        if self._companion is None:
            return found
        return replace(found, mean=self._companion.completed(found.mean, tx, rx))

    def mean_at(self, tx: Tensor, rx: Pose) -> Tensor:
        """See `Differentiable`; of what was chosen, where that has gradients, without a companion."""
        if self._chosen is None:
            return super().mean_at(tx, rx)
        chosen = self._models[self._chosen]
        if not isinstance(chosen, Differentiable):
            raise ValueError(f"{chosen.name}: its mean has no gradients by position")
        return chosen.mean_at(tx, rx)

    def paths(self, tx: Tensor, rx: Pose) -> tuple[Tensor, Tensor, Tensor, float]:
        """See `HasPaths`; of what was chosen, without a companion."""
        chosen = None if self._chosen is None else self._models[self._chosen]
        if not isinstance(chosen, HasPaths):
            raise ValueError("its channels are not made of paths")
        return chosen.paths(tx, rx)

    def trainer_options(self) -> bool:
        """See `TrainsByGradient`: where no effect but splatted ones was chosen."""
        return self._chosen is None

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`; `hybrid=false` is without the companion."""
        own = super().knobs() if self._chosen is None else knobs(self._models[self._chosen])
        return own if self._companion is None else (*own, "hybrid")

    def contributions(self, data: Measurements, rows: Any) -> dict[str, Tensor]:
        """See `Reducible`."""
        if self._chosen is None:
            return super().contributions(data, rows)
        return contributions(self._models[self._chosen], data, rows)

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`."""
        own = {knob: value for knob, value in settings.items() if knob != "hybrid"}
        chosen = None if self._chosen is None else self._models[self._chosen]
        found = super().reduced(own, measured) if chosen is None else reduced(chosen, own, measured)
        keep = self._companion is not None and settings.get("hybrid", True)
        return Completed(found, self._companion) if keep else found  # type: ignore[arg-type]

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What was chosen, and its state."""
        inner = super().state() if self._chosen is None else self._models[self._chosen].state()
        companion = None if self._companion is None else self._companion.state()
        return {"chosen": self._chosen, "inner": inner, "rest": companion}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self._chosen = site, {"bearings": "moving_array"}.get(state["chosen"], state["chosen"])
        if self._chosen is None:
            super().restore(site, state["inner"])
        else:
            self._models[self._chosen].restore(site, state["inner"])
        companion = state.get("rest")
        self._companion = None if companion is None else combine.restored(site, companion)

    def size(self) -> int:
        """Number of Gaussians or sources."""
        return super().size() if self._chosen is None else self._models[self._chosen].size()


class Completed(View):
    """A reduced method with the companion of the whole one."""

    def __init__(self, inner: Method, companion: Companion) -> None:
        super().__init__(inner)
        self.companion = companion

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        found = self.inner.predict(tx, rx)
        return replace(found, mean=self.companion.completed(found.mean, tx, rx))
