"""Solutions in closed form as methods: initialisers find them, held-out groups weigh them.

The named ones at the end say what is solved for which kind of site.
"""

from __future__ import annotations

import copy
import logging
from abc import abstractmethod
from collections.abc import Sequence
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
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.field.initial import InitSettings
from gsparc.models.channels.field import ChannelField
from gsparc.models.method import HasPaths, HasProcess, Method, Prediction
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.pareto import Settings
from gsparc.models.powers.own_terms import columns_of
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


class NamedMixture(LearnsTogether, Mixture):
    """Solutions whose weights follow from the rows in closed form, weighed by held-out groups.

    Args:
        effects: switches of terms, of which `visibility` and `residual` are heeded.
        position_std: of each coordinate of training positions [m]; None: as the data say.
        init: where sources come from, and how many searches find them.
        residual_alone: whether no sources are asked for.
    """

    resumable = True
    stored_names: ClassVar[dict[str, str]] = {"position_std": ""}

    def __init__(
        self, effects: EffectSettings = EffectSettings(), position_std: float | None = None,
        init: InitSettings | None = None, residual_alone: bool = False,
    ) -> None:  # fmt: skip
        check_arguments(locals(), position_std=or_null(number(0)), residual_alone=switch())
        super().__init__(init or InitSettings(), effects)
        self.position_std, self.residual_alone = position_std, residual_alone
        self.runs = RunFactors.none()  # of channels, learned in the phase and level of the largest run

    @abstractmethod
    def tries(self, data: Measurements) -> tuple[str, ...]:
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
        return self.name if self.only is None else self.only.label.replace(self.only.name, self.name, 1)

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The terms that are computed, for `summary.json`."""
        return "+".join(self.terms) or "residual"

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
            parts = self.tries(data)
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
        rows, by, note = refined(self, self.runs.aligned(data), std)
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
        self.runs = _runs(data, known, context)
        aligning = budget.counted.wall if len(self.runs) > 1 else 0.0
        within = replace(context, budget_s=budget.left_s)
        report = self.fit_members(parts, init, self.runs.aligned(data), fold, within)
        if not aligning:
            return report
        cost = Cost({"factors of runs": aligning}) + report.cost
        return replace(report, seconds=report.seconds + aligning, cost=cost)

    # -- answering ---------------------------------------------------------------------------------

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        if not self.members:
            raise RuntimeError(f"{self.name} has not been trained: call fit() or load a checkpoint")
        told = Prediction.joined([super(NamedMixture, self).predict(q) for q in query.split(QUERY_CHUNK)])
        return self.runs.restored(told, query.run)

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        return self.only.process() if isinstance(self.only, HasProcess) else None

    def reconditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of fields whose parameters are few, such as those of powers without fringes."""
        if not self.forgets:
            return None
        result = copy.deepcopy(self)
        result.condition(data, rows)
        return result

    def paths(self, query: Query) -> tuple[Tensor, Tensor, Tensor, float]:
        """See `HasPaths`; those of every solution that is made of paths, by its weight in the mean.

        What other solutions and the residual add to channels is in no path.
        """
        made = [(weight, one) for weight, one in self.parts() if isinstance(one, HasPaths)]
        if not made:
            raise ValueError("its channels are not made of paths")
        result = [(weight, method.paths(query)) for weight, method in made]
        gain = torch.cat([weight * one[0] for weight, one in result], dim=2)
        delay = torch.cat([one[1] for _, one in result], dim=2)
        return gain, delay, torch.cat([one[2] for _, one in result], dim=1), result[0][1][3]

    # -- reductions --------------------------------------------------------------------------------

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`."""
        # What answers faster knows nothing of runs' factors.
        return () if self.only is None or len(self.runs) > 1 else knobs(self.only)

    def contributions(self, data: Measurements, rows: Any) -> dict[str, Tensor]:
        """See `Reducible`."""
        return {} if self.only is None else contributions(self.only, data, rows)

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`."""
        return self if self.only is None or not self.knobs() else reduced(self.only, settings, measured)

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {**super().state(), "runs": self.runs.state()}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        super().restore(site, state)
        self.runs = RunFactors.read(state["runs"])

    @property
    def made(self) -> str:
        """See `Method`."""
        terms = ", ".join(self.terms) or "a process alone"
        return f"{self.started.replace('+', ' + ')} in closed form: {terms}"

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`."""
        return super().facts() | {
            "model/init": self.started, "model/variance_explained": self.explained,
            "model/steps": 0, "model/steps_taken": 0, "time/init_s": self.init_s,
        }  # fmt: skip


def _runs(data: Measurements, known: np.ndarray, context: FitContext) -> RunFactors:
    """Factors of several runs of channels, by the waves that explain rows (n,); else none."""
    if not RunFactors.several(data, known):
        return RunFactors.none()
    waves = ChannelField()
    waves.fit(data, Fold(known, known[:0], known[:0]), context)
    log.info("channels of %d runs: the factor of each was estimated with the waves' field", len(waves.runs))
    return waves.runs


class ImageSources(NamedMixture):
    """Image sources, found by searches or along measured directions, beside a process of waves."""

    name = "image_sources"

    def tries(self, data: Measurements) -> tuple[str, ...]:
        """See `NamedMixture`."""
        searched = ("sources", "rays") if data.directions is not None else ("sources",)
        placed = searched if self.init.name == "auto" else (str(self.init.name),)
        # Offsets are known to sources alone.
        return (*placed, "diffuse") if self.plain and self.init.snapshot == "none" else placed

    def obstacle(self, data: Measurements) -> str | None:
        """See `NamedMixture`."""
        return no_phase(data)


class Channels(NamedMixture):
    """Leakage, a direct wave and waves from all around; where rows were turned to each other, a process."""

    name = "channels"

    def tries(self, data: Measurements) -> tuple[str, ...]:
        """See `NamedMixture`; no phase tells of paths where rows have phases of their own."""
        return ("aligned",) if data.site.phase_reference == "neighbours" else ("diffuse",)

    def obstacle(self, data: Measurements) -> str | None:
        """See `NamedMixture`."""
        return None if data.site.kind == "csi" else f"the target is {data.site.kind}, not channels"


class Powers(NamedMixture):
    """A process of decibels about a distance law; of several stations, about a law of the site.

    Args:
        *settings: of `NamedMixture`.
        terms: further terms of one station's powers, see `columns_of`.
        **named: see `settings`.
    """

    name = "powers"
    stored_names: ClassVar[dict[str, str]] = {**NamedMixture.stored_names, "terms": ""}

    def __init__(self, *settings: Any, terms: Sequence[Any] = (), **named: Any) -> None:
        super().__init__(*settings, **named)
        self.own_terms = tuple(columns_of(one) for one in terms)

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """See `NamedMixture`, with terms of the user's own."""
        return super().fit(data, fold, replace(context, terms=self.own_terms))

    def tries(self, data: Measurements) -> tuple[str, ...]:
        """See `NamedMixture`; `init=scene` knows walls."""
        several = data.site.stations is not None and len(data.site.stations) > 1
        return ("scene",) if self.init.name == "scene" else ("joint_powers",) if several else ("powers",)

    def obstacle(self, data: Measurements) -> str | None:
        """See `NamedMixture`."""
        if self.own_terms and data.site.stations is not None and len(data.site.stations) > 1:
            return "model.terms are of one station's model; say stations=each"
        return None if data.site.kind == "rssi" else f"the target is {data.site.kind}, not received powers"


class Bearings(NamedMixture):
    """Sources where bearings of a moving array cross, with processes of powers, beside the plain process."""

    name = "bearings"

    def tries(self, data: Measurements) -> tuple[str, ...]:
        """See `NamedMixture`."""
        return ("bearings", "process") if self.plain and len(data) <= PROCESS_ROWS else ("bearings",)

    def obstacle(self, data: Measurements) -> str | None:
        """See `NamedMixture`."""
        return no_array(data.site, "tx", "the receiver stands still")
