"""Solutions in closed form as methods: initialisers find them, held-out groups weigh them.

The named ones at the end say what is solved for which kind of site.
"""

from __future__ import annotations

import copy
import logging
from abc import abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from gsparc.data import heeded
from gsparc.data.limits import check_arguments, number, or_null, switch
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.field.initial import InitSettings
from gsparc.models.channels.field import ChannelField
from gsparc.models.method import HasPaths, HasProcess, Method, Prediction
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.pareto import Settings
from gsparc.models.reduced import contributions, knobs, reduced
from gsparc.models.refined_places import displaced, errors_of, refined
from gsparc.models.run_factors import RunFactors
from gsparc.models.splat.method import QUERY_CHUNK
from gsparc.models.stations import LearnsTogether
from gsparc.models.terms import EffectSettings, no_array, no_phase
from gsparc.processes.powers import PowerProcess
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.time_budget import less_repeatable

log = logging.getLogger(__name__)

PROCESS_ROWS = 1_000  # of a moving array, up to which sources may be worth less than the plain process


class ClosedForms(LearnsTogether):
    """Solutions whose weights follow from the rows in closed form, weighed by held-out groups.

    Args:
        effects: switches of terms, of which `visibility` and `residual` are heeded.
        position_std: of each coordinate of training positions [m]; None: as the data say.
        init: where sources come from, and how many searches find them.
        residual_alone: whether no sources are asked for.
    """

    has_gaussians = True
    resumable = True
    stored_names: ClassVar[dict[str, str]] = {"position_std": ""}
    solution: Mixture  # after `fit` or `restore`

    def __init__(
        self, effects: EffectSettings = EffectSettings(), position_std: float | None = None,
        init: InitSettings | None = None, residual_alone: bool = False,
    ) -> None:  # fmt: skip
        check_arguments(locals(), position_std=or_null(number(0)), residual_alone=switch())
        self.switches, self.position_std, self.init = effects, position_std, init or InitSettings()
        self.residual_alone = residual_alone
        self.runs = RunFactors.none()  # of channels, learned in the phase and level of the largest run

    @abstractmethod
    def parts(self, data: Measurements) -> tuple[str, ...]:
        """Names of candidates (`gsparc.models.mixture.candidates`), weighed where they are several."""

    @abstractmethod
    def obstacle(self, data: Measurements) -> str | None:
        """Why this cannot be solved for such measurements; None where it can."""

    @property
    def plain(self) -> bool:
        """Whether a plain process may stand in, or beside."""
        return self.switches.residual is not False

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        inner = self.solution.only if hasattr(self, "solution") else None
        return self.name if inner is None else inner.label.replace(inner.name, self.name, 1)

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The terms that are computed, for `summary.json`."""
        return "+".join(self.solution.terms) or "residual"

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Initialise, weigh, and solve for all rows; where places have errors, again where they rather are.

        Raises:
            ValueError: these measurements are of another kind, or the only initialiser cannot solve this.
        """
        self.site, self.runs = data.site, RunFactors.none()
        with heeded.apart():
            if (why := self.obstacle(data)) is not None:
                raise ValueError(f"{self.name}: {why}")
            parts = self.parts(data)
            named = self.init.name in ("auto", "diffuse", *parts)
            name = "diffuse" if self.residual_alone else self.init.name if named else "auto"
            init = replace(self.init, name=name)
        heeded.count(*["init.name"] * named, *["model.effects.residual"] * (data.site.kind != "rssi"))
        if "scene" in parts:
            read_walls(self.init.file)  # its errors come before anything is computed
        site, phases = data.site, data.site.phase_reference != "neighbours"
        heeds = site.kind != "spectrum" and site.static_end is not None and phases
        if (std := errors_of(data, fold, self.position_std, heeds)) is not None:
            return self._fit_refined(parts, init, data, fold, context, std)
        return self._solve(parts, init, data, fold, context)

    def _fit_refined(
        self, parts: tuple[str, ...], init: InitSettings, data: Measurements, fold: Fold,
        context: FitContext, std: np.ndarray,
    ) -> FitReport:  # fmt: skip
        """First where rows were measured, then where they rather were."""
        budget = context.time_budget()
        first = replace(context, run_dir=Path(), resume=None)
        report = self._solve(parts, init, data, fold, first)
        rows, by, note = refined(self.solution, self.runs.aligned(data), std)
        if by.any() and budget.over():
            note = f"{note}, but the seconds are over: they stay as measured"
        log.info("%s", note)
        if not by.any() or budget.limited:
            return replace(report, notes=(note, *report.notes))
        limited, spent = report.limited_by, budget.counted.wall
        rest = replace(context, budget_s=budget.left_s)
        report = self._solve(parts, init, displaced(data, rows, by), fold, rest)
        limited = less_repeatable(limited, report.limited_by)
        cost = replace(report.cost, stages={"measured places": spent, **report.cost.stages})
        notes = (note, *report.notes)
        return replace(report, seconds=spent + report.seconds, notes=notes, limited_by=limited, cost=cost)

    def _solve(
        self, parts: tuple[str, ...], init: InitSettings, data: Measurements, fold: Fold, context: FitContext
    ) -> FitReport:
        """Fit and weigh candidates `parts`, of channels of several runs in the phase and level of one."""
        budget, known = context.time_budget(), np.sort(np.concatenate([fold.train, fold.val]))
        self.runs, self.solution = _runs(data, known, context), Mixture(parts, init, self.switches)
        aligning = budget.counted.wall if len(self.runs) > 1 else 0.0
        report = self.solution.fit(self.runs.aligned(data), fold, replace(context, budget_s=budget.left_s))
        if not aligning:
            return report
        cost = Cost({"factors of runs": aligning}) + report.cost
        return replace(report, seconds=report.seconds + aligning, cost=cost)

    # -- answering ---------------------------------------------------------------------------------

    def objects(self) -> SiteObjects:
        """Those of the field with closed-form weights."""
        return self.solution.objects()

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        if not hasattr(self, "solution"):
            raise RuntimeError(f"{self.name} has not been trained: call fit() or load a checkpoint")
        told = Prediction.joined([self.solution.predict(part) for part in query.split(QUERY_CHUNK)])
        return self.runs.restored(told, query.run)

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        inner = self.solution.only
        return inner.process() if isinstance(inner, HasProcess) else None

    def reconditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of fields whose parameters are few, such as those of powers without fringes."""
        if not self.solution.forgets:
            return None
        result = copy.copy(self)
        result.solution = copy.deepcopy(self.solution)
        result.solution.condition(data, rows)
        return result

    def gradient_problem(self) -> str | None:
        """See `Method.gradient_problem`; fields in closed form have gradients."""
        return None

    def paths(self, query: Query) -> tuple[Tensor, Tensor, Tensor, float]:
        """See `HasPaths`; those of every solution that is made of paths, by its weight in the mean.

        What other solutions and the residual add to channels is in no path.
        """
        made = [(weight, one) for weight, one in self.solution.parts() if isinstance(one, HasPaths)]
        if not made:
            raise ValueError("its channels are not made of paths")
        result = [(weight, method.paths(query)) for weight, method in made]
        gain = torch.cat([weight * one[0] for weight, one in result], dim=2)
        delay = torch.cat([one[1] for _, one in result], dim=2)
        return gain, delay, torch.cat([one[2] for _, one in result], dim=1), result[0][1][3]

    # -- reductions --------------------------------------------------------------------------------

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`."""
        return () if self.solution.only is None else knobs(self.solution.only)

    def contributions(self, data: Measurements, rows: Any) -> dict[str, Tensor]:
        """See `Reducible`."""
        inner = self.solution.only
        return {} if inner is None else contributions(inner, data, rows)

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`."""
        inner = self.solution.only
        return self if inner is None or not knobs(inner) else reduced(inner, settings, measured)

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {"solution": self.solution.state(), "runs": self.runs.state()}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.runs, self.solution = site, RunFactors.read(state["runs"]), Mixture()
        self.solution.restore(site, state["solution"])

    def size(self) -> int:
        """Number of Gaussians."""
        return self.solution.count

    @property
    def made(self) -> str:
        """See `Method`."""
        terms = ", ".join(self.solution.terms) or "a process alone"
        return f"{self.solution.started.replace('+', ' + ')} in closed form: {terms}"

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`."""
        return super().facts() | {
            "model/init": self.solution.started, "model/variance_explained": self.solution.explained,
            "model/steps": 0, "model/steps_taken": 0, "time/init_s": self.solution.init_s,
        }  # fmt: skip


def _runs(data: Measurements, known: np.ndarray, context: FitContext) -> RunFactors:
    """Factors of several runs of channels, by the waves that explain rows (n,); else none."""
    if not RunFactors.several(data, known):
        return RunFactors.none()
    waves = ChannelField()
    waves.fit(data, Fold(known, known[:0], known[:0]), context)
    log.info("channels of %d runs: the factor of each was estimated with the waves' field", len(waves.runs))
    return waves.runs


class ImageSources(ClosedForms):
    """Image sources, found by searches or along measured directions, beside a process of waves."""

    name = "image_sources"

    def parts(self, data: Measurements) -> tuple[str, ...]:
        """See `ClosedForms`."""
        searched = ("sources", "rays") if data.directions is not None else ("sources",)
        placed = searched if self.init.name == "auto" else (str(self.init.name),)
        # Offsets are known to sources alone.
        return (*placed, "diffuse") if self.plain and self.init.snapshot == "none" else placed

    def obstacle(self, data: Measurements) -> str | None:
        """See `ClosedForms`."""
        return no_phase(data)


class Channels(ClosedForms):
    """Leakage, a direct wave and waves from all around; where rows were turned to each other, a process."""

    name = "channels"

    def parts(self, data: Measurements) -> tuple[str, ...]:
        """See `ClosedForms`; no phase tells of paths where rows have phases of their own."""
        return ("aligned",) if data.site.phase_reference == "neighbours" else ("diffuse",)

    def obstacle(self, data: Measurements) -> str | None:
        """See `ClosedForms`."""
        return None if data.site.kind == "csi" else f"the target is {data.site.kind}, not channels"


class Powers(ClosedForms):
    """A process of decibels about a distance law; of several stations, about a law of the site."""

    name = "powers"

    def parts(self, data: Measurements) -> tuple[str, ...]:
        """See `ClosedForms`; `init=scene` knows walls."""
        several = data.site.stations is not None and len(data.site.stations) > 1
        return ("scene",) if self.init.name == "scene" else ("joint_powers",) if several else ("powers",)

    def obstacle(self, data: Measurements) -> str | None:
        """See `ClosedForms`."""
        return None if data.site.kind == "rssi" else f"the target is {data.site.kind}, not received powers"


class Bearings(ClosedForms):
    """Sources where bearings of a moving array cross, with processes of powers, beside the plain process."""

    name = "bearings"

    def parts(self, data: Measurements) -> tuple[str, ...]:
        """See `ClosedForms`."""
        return ("bearings", "process") if self.plain and len(data) <= PROCESS_ROWS else ("bearings",)

    def obstacle(self, data: Measurements) -> str | None:
        """See `ClosedForms`."""
        return no_array(data.site, "tx", "the receiver stands still")
