"""A field of whatever a plan calls for: rendered, or solutions in closed form that are weighed.

Where Gaussians are rendered it is trained by rendering (`LearnedField`). Where weights follow from the rows
in closed form (`ConditionalField`), initialisers find the Gaussians, and held-out rows weigh what they found.
"""

from __future__ import annotations

import copy
import logging
from abc import abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from gsparc.data import heeded
from gsparc.data.limits import check_arguments, number, or_null
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.models import stations
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.conditional import ConditionalField
from gsparc.models.fields import restored, stored
from gsparc.models.method import HasPaths, Method, Prediction
from gsparc.models.mixture import solutions
from gsparc.models.mixture.closed_forms import solve, with_cost
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.pareto import Settings
from gsparc.models.reduced import Blended, averaged, contributions, knobs, mean_alone, reduced
from gsparc.models.refined_places import displaced, refined
from gsparc.models.run_factors import RunFactors
from gsparc.models.splat.auto_settings import resolve
from gsparc.models.splat.method import QUERY_CHUNK, LearnedField
from gsparc.models.terms import EffectSettings, Plan
from gsparc.processes.posterior import approximated
from gsparc.processes.powers import PowerProcess
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.module import GaussianModule
from gsparc.training.time_budget import less_repeatable

log = logging.getLogger(__name__)


class PlannedField(LearnedField):
    """A Gaussian field of the terms of a plan.

    Args:
        effects: switches of terms.
        position_std: of each coordinate of training positions [m]; None: as the data say.
        **field: see `LearnedField`.
    """

    both_ends = True

    @abstractmethod
    def planned(self, data: Measurements) -> Plan:
        """What is trained for these measurements."""

    def __init__(
        self, effects: EffectSettings = EffectSettings(), position_std: float | None = None, **field: Any
    ) -> None:
        check_arguments(locals(), position_std=or_null(number(0)))
        super().__init__(**field)
        self.position_std = position_std
        self.switches = effects
        self.field: ConditionalField | None = None
        self.plan: Plan | None = None
        self.explained: float | None = None
        self.started = ""  # initialisers of what was fitted
        self._average: tuple[GaussianProcess, float] | None = None  # a process and its weight in the mean
        self._average_mean: Method | None = None  # that process without its variance, made when first asked
        self.runs = RunFactors.none()  # of channels, learned in the phase and level of the largest run

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        process = getattr(self.field, "process", None)
        return approximated(self.name, getattr(process, "posterior", None))

    @property
    def threads_pay(self) -> bool:  # type: ignore[override]
        """See `Method`."""
        return self.field is None and super().threads_pay

    @property
    def takes_budget(self) -> bool:  # type: ignore[override]
        """Always: steps or searches."""
        return True

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The terms that are computed, for `summary.json`."""
        if self.field is not None:
            return "+".join(self.field.terms) or "residual"
        if self._alone:
            return "residual"
        base = "array" if self.settings.response.array else "image"
        return base + ("+residual" if self._average is not None else "")

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose the terms, initialise, weigh; take the steps that pay where Gaussians are rendered."""
        self.site, self.field, self._average, self._average_mean = data.site, None, None, None
        self.runs = RunFactors.none()
        with heeded.apart():
            self.plan = self.planned(data)
        heeded.count(*self.plan.options)
        for reason in self.plan.reasons:
            log.info("%s", reason)
        if "scene" in self.plan.parts:
            read_walls(self.init.file)  # its errors come before anything is computed
        with heeded.apart() as asked:
            std = data.position_std if self.position_std is None else np.full(len(data), self.position_std)
        if std is not None and std[np.concatenate([fold.train, fold.val])].any():
            site, phases = data.site, data.site.phase_reference != "neighbours"
            if (
                not self.plan.rasterized
                and site.kind != "spectrum"
                and site.static_end is not None
                and phases
            ):
                heeded.count(*asked)
                return self._fit_refined(self.plan, data, fold, context, std)
            what = "channels with phases of the carrier and powers, of one end that moves"
            log.warning("position_std is not used: it is for %s", what)
        if self.plan.rasterized:
            return self._fit_rasterized(data, fold, context)
        return self._fit_conditional(self.plan, data, fold, context)

    def _fit_refined(
        self, chosen: Plan, data: Measurements, fold: Fold, context: FitContext, std: np.ndarray
    ) -> FitReport:
        """First where rows were measured, then where they rather were."""
        budget = context.time_budget()
        first = replace(context, run_dir=Path(), resume=None)
        report = self._fit_conditional(chosen, data, fold, first)
        assert self.field is not None
        rows, by, note = refined(self.field, self.runs.aligned(data), std)
        if by.any() and budget.over():
            note = f"{note}, but the seconds are over: they stay as measured"
        log.info("%s", note)
        if not by.any() or budget.limited:
            return replace(report, notes=(note, *report.notes))
        limited, spent = report.limited_by, budget.counted.wall
        rest = replace(context, budget_s=budget.left_s)
        report = self._fit_conditional(chosen, displaced(data, rows, by), fold, rest)
        limited = less_repeatable(limited, report.limited_by)
        cost = replace(report.cost, stages={"measured places": spent, **report.cost.stages})
        notes = (note, *report.notes)
        return replace(report, seconds=spent + report.seconds, notes=notes, limited_by=limited, cost=cost)

    def _fit_rasterized(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        assert self.plan is not None
        with heeded.apart():  # what these decide, `Plan.options` says
            response = replace(self.settings.response, array=self.plan.array)
            self.settings = replace(self.settings, response=response)
            if not self.settings.field.count:
                self.most_steps = 0
            choices, _ = resolve(self.settings, self.init.name, data.site)
            log.info(
                "training %s by rendering: %d Gaussians, terms %s, init=%s; callbacks %s",
                GaussianModule.__name__, self.settings.field.count, self.effects, choices.init,
                ", ".join(type(callback).__name__ for callback in context.callbacks()) or "none",
            )  # fmt: skip
        with heeded.apart() as read:
            report = super().fit(data, fold, context)
        if not self._alone:
            heeded.count(*read)
        self.started = self.choices.init if self.choices is not None else ""
        spent = dict(self.spent)
        if self._average is not None:
            method = self._average[0]
            known = np.sort(np.concatenate([fold.train, fold.val]))
            more = method.fit(data, Fold(known, known[:0], known[:0]), FitContext())
            report = replace(report, seconds=report.seconds + more.seconds)
            spent["averaged process"] = more.seconds
        spent["weighing"] = max(report.seconds - sum(spent.values()), 0.0)
        log.info("%s: %s", self.name, self.made)
        unused = {} if self.steps else {name: s for name, s in spent.items() if name.startswith("gradient")}
        if self._alone:
            unused = {name: s for name, s in spent.items() if name != "averaged process"}
        return with_cost(report, Cost(spent, unused))

    @property
    def _alone(self) -> bool:
        """Whether the averaged process has all the weight."""
        return self._average is not None and self._average[1] >= 1

    def _pays(self) -> bool:
        """Whether the rendered field is worth another stage."""
        return not self._alone

    def _weigh_process(self, data: Measurements, fold: Fold) -> None:
        if self.plan is not None and self.plan.plain:
            self._average, explained = solutions.weigh(self, data, fold, self._left_out, self._apart)
            self.explained = self.explained if explained is None else explained

    def _fit_conditional(
        self, chosen: Plan, data: Measurements, fold: Fold, context: FitContext
    ) -> FitReport:
        with heeded.apart():  # what these decide, `Plan.options` says
            known = self.init.name if self.init.name in ("diffuse", *chosen.parts) else "auto"
            init = replace(self.init, name=known if self.settings.field.count else "diffuse")
        solved = solve(chosen.parts, init, self.switches, data, fold, context)
        self.field, self.started, self.runs = solved.field, solved.started, solved.runs
        self.explained, self.init_s, self.steps = solved.explained, solved.init_s, 0
        return solved.report

    def best_stations(
        self, data: Measurements, fold: Fold, context: FitContext
    ) -> tuple[Literal["each", "together"], str]:
        """See `Method.best_stations`."""
        if not self.shares(data.site) or self.init.name == "scene":
            return "each", ""
        return stations.best(data, fold, context)

    # -- answering ---------------------------------------------------------------------------------

    def objects(self) -> SiteObjects:
        """Those of the field with closed-form weights."""
        return SiteObjects.of() if self.field is None else self.field.objects()

    def shares(self, site: Site) -> bool:
        """Received powers, and channels of a known carrier."""
        waves = site.kind == "csi" and site.wavelength is not None and site.static_end is not None
        return (waves and site.phase_reference != "neighbours") or site.kind == "rssi"

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        if self.field is not None:
            told = Prediction.joined([self.field(part) for part in query.split(QUERY_CHUNK)])
            return self.runs.restored(told, query.run)
        if self._average is not None and not self.size():
            return self._average[0].predict(query)
        own = super().predict(query)
        if self._average is None:
            return own
        if self._average_mean is None:
            self._average_mean = mean_alone(self._average[0])
        method, weight = self._average
        if query.tx.dtype == torch.float64:
            return replace(own, mean=own.mean.lerp(method.mean_at(query), weight))
        return replace(own, mean=own.mean.lerp_(self._average_mean.predict(query).mean, weight))

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        result = getattr(self.field, "process", None)
        return None if result is None else result.exact()

    def reconditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of fields whose parameters are few, such as those of powers without fringes."""
        if self.field is None or not self.field.forgets:
            return None
        result = copy.copy(self)
        result.field = copy.deepcopy(self.field)
        result.field.condition(data, rows)
        return result

    def gradient_problem(self) -> str | None:
        """See `Method.gradient_problem`; fields in closed form and a process alone have gradients."""
        process_only = self._average is not None and not self.size()
        return None if self.field is not None or process_only else super().gradient_problem()

    def paths(self, query: Query) -> tuple[Tensor, Tensor, Tensor, float]:
        """See `HasPaths`; those of every solution that is made of paths, by its weight in the mean.

        What other solutions and the residual add to channels is in no path.
        """
        parts: list[tuple[float, Any]] = [(1.0, self.field)]
        if isinstance(self.field, Mixture):
            parts = list(self.field.parts())
        made = [(w, one.method) for w, one in parts if isinstance(getattr(one, "method", None), HasPaths)]
        if not made:
            raise ValueError("its channels are not made of paths")
        result = [(weight, method.paths(query)) for weight, method in made]
        gain = torch.cat([weight * one[0] for weight, one in result], dim=2)
        delay = torch.cat([one[1] for _, one in result], dim=2)
        return gain, delay, torch.cat([one[2] for _, one in result], dim=1), result[0][1][3]

    def trainer_options(self) -> bool:
        """See `TrainsByGradient`."""
        return True

    def _method(self) -> Method | None:
        """The method inside the only solution, where there is one."""
        parts = [*self.field.parts()] if isinstance(self.field, Mixture) else [(1.0, self.field)]
        return getattr(parts[0][1], "method", None) if len(parts) == 1 else None

    # -- reductions --------------------------------------------------------------------------------

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`."""
        if self.field is None:
            return super().knobs()
        method = self._method()
        return () if method is None else knobs(method)

    def contributions(self, data: Measurements, rows: Any) -> dict[str, Tensor]:
        """See `Reducible`."""
        if self.field is None:
            return super().contributions(data, rows)
        method = self._method()
        return {} if method is None else contributions(method, data, rows)

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`."""
        if self.field is None:
            twin = copy.copy(self)
            twin._average = None
            result = LearnedField.reduced(twin, settings, measured)
            return result if self._average is None else averaged(result, *self._average)
        method, whole = self._method(), self.field
        if method is None:
            return self
        result = reduced(method, settings, measured)
        if isinstance(whole, Mixture) and whole.residual is not None:
            return Blended(result, whole.residual, whole.share)
        return result

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Field, averaged process, and what was found out."""
        beside = None
        if self._average is not None:
            method, weight = self._average
            beside = {"state": method.state(), "weight": weight}
        return {
            "inner": super().state() if self.field is None else None,
            "field": None if self.field is None else stored(self.field),
            "beside": beside,
            "facts": {"explained": self.explained, "steps": self.steps},
            "init": self.started,
            "array": self.settings.response.array,
            "runs": self.runs.state(),
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.field, self._average, self._average_mean = site, None, None, None
        response = replace(self.settings.response, array=bool(state["array"]))
        self.settings = replace(self.settings, response=response)
        if state["field"] is not None:
            self.field = restored(site, state["field"])
        else:
            super().restore(site, state["inner"])
        if state["beside"] is not None:
            method = GaussianProcess()
            method.restore(site, state["beside"]["state"])
            self._average = method, float(state["beside"]["weight"])
        self.explained, self.steps = state["facts"]["explained"], int(state["facts"]["steps"])
        self.started, self.runs = str(state["init"]), RunFactors.read(state["runs"])

    def size(self) -> int:
        """Number of Gaussians."""
        if self._alone:
            return 0
        return super().size() if self.field is None else self.field.count

    @property
    def made(self) -> str:
        """See `Method`."""
        if self.field is not None:
            terms = ", ".join(self.field.terms) or "a process alone"
            return f"{self.started.replace('+', ' + ')} in closed form: {terms}"
        weight = 0.0 if self._average is None else self._average[1]
        return super().made + (
            f"; a plain process weighs {weight:.2g}" if self.plan and self.plan.plain else ""
        )

    def field_alone(self) -> Method | None:
        """See `Method.field_alone`."""
        if self._average is None or not super().size():
            return None
        alone = copy.copy(self)
        alone._average, alone._doubled = None, None
        return alone

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`."""
        own = {**super().facts(), "model/init": self.started, "model/variance_explained": self.explained}
        return own if self.field is None else {**own, "model/choices": None}
