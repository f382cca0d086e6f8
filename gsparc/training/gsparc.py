"""`model=gsparc`: one Gaussian field whatever is measured; terms and initialiser follow from the site.

Where Gaussians are rendered it is trained by rendering (`LearnedField`). Where weights follow from the rows in
closed form (`ConditionalField`), initialisers find the Gaussians, held-out rows weigh what they found, and
steps of gradient refine it as long as validation gains.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.conditional import ConditionalField, Posterior, StackedField, learns
from gsparc.field.initial import InitSettings
from gsparc.field.response import ResponseSettings
from gsparc.methods.method import Differentiable, FitContext, FitReport, HasPaths, Method, Prediction
from gsparc.methods.pareto import Settings
from gsparc.methods.registry import field_initialiser, field_restored, method_class
from gsparc.methods.time_budget import Clock, TimeBudget, less_repeatable
from gsparc.ops import Pose
from gsparc.training import weighing
from gsparc.training.checkpoint_io import GsparcCheckpointIO
from gsparc.training.fit import run_stage, total_steps
from gsparc.training.keep_best import KeepBest
from gsparc.training.lightning_module import GaussianModule
from gsparc.training.splatting import QUERY_CHUNK, LearnedField
from gsparc.training.terms import EffectSettings, Plan, plan

log = logging.getLogger(__name__)

DEFAULT_BUDGET_S = 60.0  # where a search is open-ended
TRIAL_S, TRIAL_SHARE = 10.0, 0.2  # of a search whose worth is weighed on held-out rows, at most
TRIAL = {"searches": 1, "search_rows": 200, "max_sources": 8, "edges": False}
STEPS_SHARE = 0.1  # of the budget, kept for gradient steps
VALIDATE_EVERY = 5  # gradient steps of a conditional field: each factors a matrix
LEAST_HELD = 4  # rows, for weights to mean anything
OPEN_ENDED = ("sources", "bearings")  # initialisers that take what seconds they are given


class Gsparc(LearnedField):
    """A Gaussian field.

    Args:
        effects: switches of terms.
        init: where Gaussians come from.
        **field: see `LearnedField`.
    """

    def __init__(
        self, effects: EffectSettings | None = None, init: InitSettings | None = None, **field: Any
    ) -> None:
        super().__init__(**field)
        self.switches, self.init = effects or EffectSettings(), init or InitSettings()
        self.field: ConditionalField | None = None
        self.plan: Plan | None = None
        self.explained: float | None = None
        self._beside: tuple[Method, float] | None = None

    @property
    def takes_budget(self) -> bool:  # type: ignore[override]
        """Always: steps or searches."""
        return True

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The terms that are computed, for `summary.json`."""
        if self.field is not None:
            return "+".join(self.field.terms) or "residual"
        base = "array" if self.settings.response.array else "image"
        return base + ("+residual" if self._beside is not None else "")

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose the terms, initialise, weigh, take the steps that pay."""
        self.site, self.field, self._beside = data.site, None, None
        self.plan = plan(self.switches, self.init, data, self.settings.emission.hidden)
        for reason in self.plan.reasons:
            log.info("%s", reason)
        if self.plan.rasterized:
            return self._fit_rasterized(data, fold, context)
        return self._fit_conditional(self.plan, data, fold, context)

    def _fit_rasterized(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        assert self.plan is not None
        response = replace(self.settings.response, array=self.plan.array)
        self.settings = replace(self.settings, response=response)
        log.info(
            "training a rasterized Gaussian field: %d Gaussians, terms %s, init=%s, at most %d steps",
            self.settings.field.count, self.effects, self.init.name, total_steps(context),
        )  # fmt: skip
        report = super().fit(data, fold, context)
        if self._beside is not None:
            method, weight = self._beside
            known = np.sort(np.concatenate([fold.train, fold.val]))
            more = method.fit(data, Fold(known, known[:0], known[:0]), FitContext())
            report = replace(report, seconds=report.seconds + more.seconds)
        return report

    def _watched(self, data: Measurements, fold: Fold) -> None:
        """What a plain process on whole targets is worth beside the field, on validation rows."""
        if self.plan is None or not self.plan.plain or len(fold.val) < LEAST_HELD:
            return
        process = method_class("gp")()
        process.fit(data, Fold(fold.train, fold.val[:0], fold.val[:0]), FitContext())
        batch = data.batch(fold.val)
        target = _comparable(batch.target, data.site)
        own, plain = (
            _comparable(found.mean, data.site)
            for found in (super().predict(batch.tx, batch.rx), process.predict(batch.tx, batch.rx))
        )
        ours, theirs = weighing.weights([own, plain], target)
        self.explained = weighing.explained(own, target, data.site.kind != "csi")
        log.info(
            "held out: the field misses %.3f of the energy, a Gaussian process %.3f: weights %.2f and %.2f",
            weighing.error(own, target), weighing.error(plain, target), ours, theirs,
        )  # fmt: skip
        self._beside = (process, theirs) if theirs > 0 else None

    def _fit_conditional(
        self, chosen: Plan, data: Measurements, fold: Fold, context: FitContext
    ) -> FitReport:
        open_ended = any(part in OPEN_ENDED for part in chosen.parts)
        if context.budget_s is None and open_ended:
            context = replace(context, budget_s=DEFAULT_BUDGET_S)
        budget = context.time_budget()
        log.info(
            "training a Gaussian field with closed-form weights: init=%s, %s", "+".join(chosen.parts),
            "no end" if context.budget_s is None else f"{context.budget_s:g} s",
        )  # fmt: skip
        known = np.sort(np.concatenate([fold.train, fold.val]))
        parts, shares, limited = self._weigh(chosen.parts, data, fold, context, budget)
        members, notes = [], []
        for part in parts:
            left = max(budget.seconds * (1 - STEPS_SHARE) - budget.spent, 1.0)
            within = replace(context, budget_s=left if part in OPEN_ENDED else None)
            field, report = self._initialise(part, data, known, within)
            limited = less_repeatable(limited, report.limited_by)
            members.append(field)
            notes += report.notes
        self.field = members[0] if len(members) == 1 else StackedField(members, shares)
        self.field.site = data.site
        self.init_s = budget.counted.wall
        self.steps = self._take_steps(data, fold, context, budget)
        self.field.condition(data, known)
        seconds = budget.counted.wall
        log.info("initialisers %.1f s, %d gradient steps kept, %.1f s in all", self.init_s, self.steps, seconds)
        return FitReport(seconds, tuple(notes), limited)

    def _initialise(
        self, part: str, data: Measurements, rows: np.ndarray, context: FitContext
    ) -> tuple[ConditionalField, FitReport]:
        clutter = self.switches.visibility is not False
        return field_initialiser(part)(data, rows, self.init, clutter, context)

    def _weigh(
        self, parts: tuple[str, ...], data: Measurements, fold: Fold, context: FitContext, budget: TimeBudget
    ) -> tuple[list[str], list[float], Clock | None]:
        """The parts that held-out rows ask for, their weights, and the clock that limited a trial."""
        forced = self.switches.phase is True or self.init.name in parts
        if len(parts) == 1 or len(fold.val) < LEAST_HELD or (forced and len(parts) == 2):
            return [parts[0]], [1.0], None
        batch, predicted, limited = data.batch(fold.val), [], None
        target = _comparable(batch.target, data.site)
        for part in parts:
            short = replace(self.init, **TRIAL) if part in OPEN_ENDED else self.init
            trial_s = min(TRIAL_S, TRIAL_SHARE * budget.seconds) if part in OPEN_ENDED else None
            within = replace(context, run_dir=Path(), resume=None, budget_s=trial_s)
            try:
                field, report = field_initialiser(part)(data, fold.train, short, False, within)
            except ValueError as error:
                if forced:
                    raise
                log.info("init=%s is left out: %s", part, error)
                predicted.append(None)
                continue
            limited = less_repeatable(limited, report.limited_by)
            predicted.append(_comparable(field(batch.tx, batch.rx).mean, data.site))
        usable = [n for n, one in enumerate(predicted) if one is not None]
        found = weighing.weights([predicted[n] for n in usable], target)
        for n, weight in zip(usable, found, strict=True):
            log.info(
                "held-out rows: %s misses %.3f of the energy, weight %.2f",
                parts[n], weighing.error(predicted[n], target), weight,
            )  # fmt: skip
        kept = [(parts[n], weight) for n, weight in zip(usable, found, strict=True) if weight > 0]
        return [part for part, _ in kept], [weight for _, weight in kept], limited

    def _take_steps(
        self, data: Measurements, fold: Fold, context: FitContext, budget: TimeBudget
    ) -> int:
        """Gradient steps under Lightning, as many as validation gains by; their number."""
        field = self.field
        assert field is not None
        if not len(fold.val):
            log.info("gradient steps: none, there are no validation rows to say whether they pay")
            return 0
        field.condition(data, fold.train)
        batch = data.batch(fold.val)
        target, found = _comparable(batch.target, data.site), field(batch.tx, batch.rx)
        about_mean = data.site.kind != "csi"
        if found.explained is not None:
            own = _comparable(found.explained, data.site)
            self.explained = weighing.explained(own, target, about_mean)
        if not learns(field) or budget.over(1 - STEPS_SHARE / 2):
            log.info("gradient steps: none, %s", "no seconds are left" if learns(field) else "nothing to move")
            return 0
        folder = context.run_dir / "steps"
        module = GaussianModule(field, self.loss, self.rates, total_steps(context), folder)
        files = GsparcCheckpointIO(self, context.config_yaml, {"stage": "steps"})
        inner = replace(context, run_dir=folder, resume=None)
        budget.pause()
        ran = run_stage(module, data, fold, inner, files, budget, [KeepBest()], VALIDATE_EVERY)
        return ran.steps

    # -- answering ---------------------------------------------------------------------------------

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        if self.field is not None:
            parts = [
                self.field(tx[i : i + QUERY_CHUNK], rx[i : i + QUERY_CHUNK] if rx.batched else rx)
                for i in range(0, len(tx), QUERY_CHUNK)
            ]
            found = Posterior(*(_joined([getattr(p, name) for p in parts]) for name in vars(parts[0])))
            return Prediction(found.mean, (1 - found.unknown).clamp(0, 1), found.variance)
        own = super().predict(tx, rx)
        if self._beside is None:
            return own
        process, weight = self._beside
        other = process.predict(tx, rx)
        return replace(own, mean=torch.lerp(own.mean, other.mean, weight))
