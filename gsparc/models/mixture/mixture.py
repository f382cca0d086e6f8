"""Several solutions of one problem as one method: their mean, weighed by rows held out."""

from __future__ import annotations

import copy
import logging
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gsparc.base.limits import check_arguments, number, or_null, switch
from gsparc.data.inner_folds import cut_folds
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.field.initial import InitSettings
from gsparc.models.abilities import HasPaths, HasProcess, QueryPaths
from gsparc.models.channels.initial import estimate_run_factors
from gsparc.models.closed_form import (
    ClosedForm,
    LeftOutRows,
    method_from_state,
    method_state,
    rows_left_out,
)
from gsparc.models.image_sources.frame import merge_equal_paths
from gsparc.models.method import Method, Prediction
from gsparc.models.mixture import fit_candidates
from gsparc.models.mixture.candidates import Candidate
from gsparc.models.mixture.each_or_together import LearnsTogether
from gsparc.models.predicting import factors_to_measured
from gsparc.models.reduced import View
from gsparc.models.refined_places import move_rows, position_errors, refine_places
from gsparc.models.run_factors import RunFactors
from gsparc.models.stack import explained_variance, to_real_entries
from gsparc.models.terms import EffectSettings
from gsparc.physics.decibels import TINY_POWER
from gsparc.processes.averages import mixture_moments
from gsparc.processes.powers import PowerProcess
from gsparc.processes.uncertainty import variance_factor
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)
QUERY_CHUNK = 1024  # memory; stations at one place share most of their work, see `ChannelField`
# Of fields, in words.
PARTS = {"power": "a trend over distance", "residual": "a Gaussian process of the rest"}


class Mixture(LearnsTogether, ClosedForm):
    """The weighed mean of solutions whose weights follow from the rows:
    no single one need be the right one.

    Initialisers find them, held-out groups weigh them.
    Subclasses say what is solved for which kind of site.

    Args:
        effects: switches of terms, of which `visibility` and `residual` are heeded.
        position_std: of each coordinate of training positions [m]; None: as the data say.
        init: where sources come from, and how many searches find them.
        residual_alone: whether no sources are asked for.
    """

    has_gaussians = resumable = True

    def __init__(
        self,
        effects: EffectSettings = EffectSettings(),
        position_std: float | None = None,
        init: InitSettings | None = None,
        residual_alone: bool = False,
    ) -> None:
        check_arguments(locals(), position_std=or_null(number(0)), residual_alone=switch())
        self.switches, self.init = effects, init or InitSettings()
        self.position_std, self.residual_alone = position_std, residual_alone
        # Of channels, learned in the phase and level of the largest run
        self.runs = RunFactors.identity()
        self.members: list[ClosedForm] = []
        self.weights: tuple[float, ...] = ()  # (M,) of the mean, of sum 1
        self.started = ""  # names of members
        self.doubt = 1.0  # times the members' variances, as validation rows of channels say
        # Share of the variance of validation rows, by Gaussians
        self.explained: float | None = None
        self.init_s: float | None = None

    @abstractmethod
    def list_candidates(self, data: Measurements) -> Mapping[str, Candidate]:
        """Return candidates by name, weighed where they are several."""

    @abstractmethod
    def why_not(self, data: Measurements) -> str | None:
        """Return why this cannot be solved for such measurements; None where it can."""

    @property
    def adds_process(self) -> bool:
        """Whether a plain process may stand in, or beside."""
        return self.switches.residual is not False

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Initialise, weigh, and solve for all rows; where places have errors,
        again where they rather are.

        Raises:
            ValueError: these measurements are of another kind, or the only initialiser cannot solve
                this.
        """
        self.site, self.runs = data.site, RunFactors.identity()
        if (why := self.why_not(data)) is not None:
            raise ValueError(f"{self.name}: {why}")
        parts = self.list_candidates(data)
        named = self.init.name in ("auto", "diffuse", *parts)
        if not named:  # an initialiser of another kind of site
            log.warning(
                "init=%s has no effect here: what is tried is %s",
                self.init.name,
                " and ".join(parts),
            )
        name = "diffuse" if self.residual_alone else self.init.name if named else "auto"
        init = replace(self.init, name=name)
        if "scene" in parts:
            read_walls(self.init.file)  # its errors come before anything is computed
        # Places are refined by slopes of predictions: of one end that moves,
        # with phases that rows share.
        site, phases = data.site, data.site.phase_reference != "neighbours"
        heeds = not (site.target.is_image or site.paired) and phases
        fit_rows = fold.learned()
        if (std := position_errors(data, fit_rows, self.position_std, heeds)) is not None:
            return self._fit_twice(parts, init, data, fold, context, std)
        return self._solve(parts, init, data, fold, context)

    def _fit_twice(
        self,
        parts: Mapping[str, Candidate],
        init: InitSettings,
        data: Measurements,
        fold: Fold,
        context: FitContext,
        std: np.ndarray,
    ) -> FitReport:
        """First where rows were measured, then where they rather were."""
        watch = Stopwatch()
        # Files of the folder are of the second pass, which an interrupted run goes on with.
        first = replace(context, run_dir=Path(), resume=None)
        report = self._solve(parts, init, data, fold, first)
        rows, by, note = refine_places(self, self.runs.remove_factors(data), std)
        log.info("%s", note)
        if not by.any():
            return replace(report, notes=(note, *report.notes))
        spent = watch.seconds
        report = self._solve(parts, init, move_rows(data, rows, by), fold, context)
        cost = replace(report.cost, stages={"measured places": spent, **report.cost.stages})
        notes = (note, *report.notes)
        return replace(report, seconds=spent + report.seconds, notes=notes, cost=cost)

    def _solve(
        self,
        parts: Mapping[str, Candidate],
        init: InitSettings,
        data: Measurements,
        fold: Fold,
        context: FitContext,
    ) -> FitReport:
        """Fit candidates, weigh several by rows held out, and condition them on all rows.

        Channels of several runs are learned in the phase and level of one.

        Raises:
            ValueError: the only candidate, or the one asked for, cannot solve this.
        """
        watch = Stopwatch()
        log.info("training in closed form: init=%s", " and ".join(parts))
        fit_rows, several = np.sort(fold.learned()), len(parts) > 1
        self.runs = _estimate_run_factors(data, fit_rows, context)
        data = self.runs.remove_factors(data)
        stages = {"factors of runs": watch.seconds} if len(self.runs) > 1 else {}
        cut = (
            cut_folds(data, fold, context.split, fit_candidates.GROUPS, context.seed)
            if several
            else None
        )
        fitted, reports = fit_candidates.fit_candidates(
            parts, init, self.switches, data, fold, context, watch, cut
        )
        chosen = fit_candidates.weigh_candidates(fitted, data, fold.val, cut)
        self.members, self.weights = [fitted[name] for name in chosen], tuple(chosen.values())
        self.started = "+".join(chosen)
        self.site, self.init_s = data.site, watch.seconds
        self.doubt = self._measure_doubt(data, fold.val) if several else 1.0
        self.explained = self._explained_share(data, fold, several)
        if several or self.explained is not None:  # else it is of these rows already
            self.condition(data, fit_rows)
        log.info("%d Gaussians from init=%s", self.count_gaussians, self.description)
        seconds = watch.seconds
        stages |= {name: report.seconds for name, report in reports.items()}
        # Not below 0: searches of a resumed run count what they took before.
        stages["weighing"] = max(self.init_s - sum(stages.values()), 0.0)
        stages["final weights"] = seconds - self.init_s
        unused = {
            name: spent for name, spent in stages.items() if name in reports and name not in chosen
        }
        notes = [note for name in chosen for note in reports[name].notes]
        return FitReport(seconds, tuple(notes)).with_cost(Cost(stages, unused))

    def _measure_doubt(self, data: Measurements, val: np.ndarray) -> float:
        """What variances of channels are to be multiplied by, from rows that members left out."""
        if not (data.site.target.is_complex and len(val)):
            return 1.0
        said = self._mix_predictions(data.batch(val))
        rows, mean, variance = val, said.mean, cast(Tensor, said.variance).double()
        if len(others := rows_left_out(self.members)):
            held = [member.held for member in self.members if member.held is not None]
            parts = [
                (weight, answers.mean_at(others), answers.variance_at(others))
                for weight, answers in zip(self.weights, held, strict=True)
            ]
            both = zip((mean, variance), mixture_moments(parts), strict=True)
            rows, (mean, variance) = np.r_[val, others], (torch.cat(pair) for pair in both)
        if data.site.unknown_factor != "none":
            mean = mean * factors_to_measured(mean, data, rows)
        target = data.batch(rows).target
        missed = to_real_entries(mean - target).square().sum(1) / mean[0].numel()
        ratios = missed / variance.clamp_min(TINY_POWER)
        return variance_factor(ratios.numpy())

    def _explained_share(
        self, data: Measurements, fold: Fold, is_conditioned: bool
    ) -> float | None:
        """What Gaussians explain of validation rows; conditions on training rows,
        unless apart already.
        """
        if not (len(fold.val) and self.count_gaussians):
            return None
        if not is_conditioned:
            self.condition(data, fold.train)
        batch = data.batch(fold.val)
        result = self.predict(batch).explained
        assert result is not None
        prediction, target = (
            data.site.target.in_error_unit(values) for values in (result, batch.target)
        )
        return explained_variance(prediction, target, not data.site.target.is_complex)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Condition every member on the same rows."""
        for member in self.members:
            member.condition(data, rows)

    def members_data(self, data: Measurements) -> Measurements:
        """See `HasMembers`; in the phase and level of the largest run."""
        return self.runs.remove_factors(data)

    def keep_members(self, kept: Sequence[ClosedForm]) -> None:
        """See `HasMembers`; their weights keep their ratios."""
        chosen = [number for number, member in enumerate(self.members) if member in kept]
        names, weights = self.started.split("+"), np.array(self.weights)[chosen]
        self.members, self.started = (
            [self.members[i] for i in chosen],
            "+".join(names[i] for i in chosen),
        )
        self.weights = tuple((weights / weights.sum()).tolist())

    def copy_conditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of fields whose parameters are few, such as those of powers."""
        if not all(member.forgets for member in self.members):
            return None
        # Deep, as members are conditioned in place and those of this method must stay as they are.
        result = copy.deepcopy(self)
        result.condition(data, rows)
        return result

    # -- answering ---------------------------------------------------------------------------------

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; what members disagree about is added to their variances."""
        self.require_fitted(self.members or None)
        prediction = self._mix_predictions(query)
        if prediction.variance is not None and self.doubt != 1:
            prediction = replace(prediction, variance=prediction.variance * self.doubt)
        return self.runs.apply_factors(prediction, query.run)

    def _mix_predictions(self, query: Query) -> Prediction:
        """In the phase and level of the largest run, with the members' own variances."""
        return Prediction.joined([self._mix_part(part) for part in query.split(QUERY_CHUNK)])

    def _mix_part(self, query: Query) -> Prediction:
        result = [member.predict(query) for member in self.members]
        if len(result) == 1:
            return result[0]
        pairs = list(zip(self.weights, result, strict=True))
        if any(prediction.variance is None for prediction in result):  # reduced
            means = [weight * prediction.mean for weight, prediction in pairs]
            return Prediction(torch.stack(means).sum(0))
        # Members are in closed form, and state both.
        moments = [(weight, pair.mean, cast(Tensor, pair.variance)) for weight, pair in pairs]
        mean, variance = mixture_moments(moments)
        unknown = torch.stack(
            [weight * cast(Tensor, prediction.unknown) for weight, prediction in pairs]
        ).sum(0)
        parts = [
            weight * prediction.explained
            for weight, prediction in pairs
            if prediction.explained is not None
        ]
        variance, unknown = (each.to(mean.real.dtype) for each in (variance, unknown))
        return Prediction(mean, variance, unknown, torch.stack(parts).sum(0) if parts else None)

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """Return the mean of all; what they disagree about is part of its variance."""
        result = [member.left_out(rows) for member in self.members]
        if len({answers.mean.shape for answers in result}) > 1:
            raise ValueError(
                f"{self.name}: of several tones or antennas one is kept of rows left out"
            )
        parts = [
            (weight, answers.mean, answers.variance)
            for weight, answers in zip(self.weights, result, strict=True)
        ]
        mean, variance = mixture_moments(parts)
        return LeftOutRows(result[0].rows, mean, variance * self.doubt)

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        return self.member.process() if isinstance(self.member, HasProcess) else None

    def paths(self, query: Query) -> QueryPaths:
        """See `HasPaths`; of solutions that are made of paths each source once,
        by their weights in the mean.

        What other solutions and the residual add to channels is in no path.
        """
        members = [
            (weight, weighted_member)
            for weight, weighted_member in self.weighted_members()
            if isinstance(weighted_member, HasPaths)
        ]
        if not members:
            raise ValueError("its channels are not made of paths")
        gains, delays, units, carriers = zip(
            *(method.paths(query) for _, method in members), strict=True
        )
        gain = torch.cat(
            [weight * part for (weight, _), part in zip(members, gains, strict=True)], dim=2
        )
        delay, unit, carrier = torch.cat(delays, dim=2), torch.cat(units, dim=1), carriers[0]
        return merge_equal_paths(QueryPaths(gain, delay, unit, carrier))

    # -- what it is made of ------------------------------------------------------------------------

    @property
    def member(self) -> ClosedForm | None:
        """Return the member, where it is one."""
        return self.members[0] if len(self.members) == 1 else None

    def reduction_settings(self) -> tuple[str, ...]:
        """See `Method.reduction_settings`; those of any member."""
        named = (name for member in self.members for name in member.reduction_settings())
        return tuple(dict.fromkeys(named))

    def reduce(self, settings: Mapping[str, Any], measured: dict[str, Tensor]) -> Method:
        """See `Method.reduce`; each member, by what it has of the settings."""
        if not settings:
            return self
        result = copy.copy(self)
        known = [set(member.reduction_settings()).intersection(settings) for member in self.members]
        pairs = zip(self.members, known, strict=True)
        lean = [member.reduce({name: settings[name] for name in has}, {}) for member, has in pairs]
        result.members = cast(list[ClosedForm], lean)  # they answer, and are asked nothing else
        return View(result)

    def weighted_members(self) -> Iterator[tuple[float, ClosedForm]]:
        """See `ClosedForm`."""
        yield from zip(self.weights, self.members, strict=True)

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        return (
            self.name
            if self.member is None
            else self.member.label.replace(self.member.name, self.name, 1)
        )

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms of any member."""
        return tuple(dict.fromkeys(term for member in self.members for term in member.terms))

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The terms that are computed, for `summary.json`."""
        return "+".join(self.terms) or "residual"

    @property
    def description(self) -> str:
        """See `Method`."""
        terms = ", ".join(PARTS.get(term, term) for term in self.terms) or PARTS["residual"]
        return f"{self.started.replace('+', ' + ')} in closed form, with {terms}"

    def count_components(self) -> int:
        """Return the number of Gaussians of all members."""
        return sum(member.count_gaussians for member in self.members)

    def objects(self) -> SiteObjects:
        """Return those of the heaviest member that found any."""
        result = [self.members[i].objects() for i in np.argsort(self.weights)[::-1]]
        return next((listed for listed in result if len(listed)), result[0])

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`."""
        return super().facts() | {
            "model/init": self.started,
            "model/variance_explained": self.explained,
            "model/steps": 0,
            "model/steps_taken": 0,
            "time/init_s": self.init_s,
        }

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {
            "members": [method_state(member) for member in self.members],
            "weights": list(self.weights),
            "started": self.started,
            "explained": self.explained,
            "doubt": self.doubt,
            "runs": self.runs.state(),
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.started, self.explained = site, str(state["started"]), state["explained"]
        self.members = [method_from_state(site, member) for member in state["members"]]
        self.weights, self.runs = tuple(state["weights"]), RunFactors.read(state["runs"])
        self.doubt = float(state.get("doubt", 1.0))


def _estimate_run_factors(data: Measurements, known: np.ndarray, context: FitContext) -> RunFactors:
    """Factors of several runs of channels, by the waves that explain rows (n,); else none."""
    if not RunFactors.has_several_runs(data, known):
        return RunFactors.identity()
    # Validation rows too: candidates are weighed by them in the phase of the same run.
    result = estimate_run_factors(data, known, context.counts)
    log.info(
        "channels of %d runs: the factor of each was estimated by waves of all runs", len(result)
    )
    return result
