"""`model=auto`: of several models the one, or the mixture, that errs least on rows left out as the test's."""

from __future__ import annotations

import contextlib
import copy
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from gsparc.auto.contest import LEAST_S, Contest, figure_of
from gsparc.auto.mixture import mixed
from gsparc.auto.trials import Course, Trial, course, products, variances
from gsparc.data.gaussian_cloud import GaussianCloud
from gsparc.data.inner_folds import cut_inside
from gsparc.data.instantiate import suggest
from gsparc.data.limits import POSITIVE, SettingError, check_arguments, or_null, whole
from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.methods import stacking
from gsparc.methods.method import FitContext, FitReport, HasGaussians, Method, Prediction
from gsparc.methods.registry import METHODS, method_class
from gsparc.methods.time_budget import less_repeatable
from gsparc.ops import Pose

log = logging.getLogger(__name__)

CANDIDATES = ("distance_law", "idw", "kriging", "gp", "complex_gp", "uplink", "gsparc")
"""Tried by default, the cheapest first; those whose seconds can be chosen come last in any order.

`array`, `moving_array`, `directional_gp` and `image_source_gp` are not among them: `gsparc` contains them,
and their trials would take seconds from it.
"""
FOLDS = ((2_000, 5), (8_000, 3))  # up to so many training rows, of more 2: they take longer and tell more
FEW = 3  # at most, with candidates whose seconds can be chosen


@dataclass(frozen=True)
class Member:
    """A candidate that was chosen.

    Attributes:
        name: of the candidate.
        weight: in the mixture.
        error: its left-out mean squared error in the judged unit, the variance of one that says none.
    """

    name: str
    weight: float
    error: float


class Auto(Method):
    """Candidates compared by their errors of training rows left out as the split leaves out its test rows.

    Args:
        candidates: names of models, or models; those that do not serve the data are left out.
        models: what these names mean, where it is not the model with its default settings.
        budget_s: seconds of everything, where the seconds of a candidate can be chosen [s].
        folds: that rows are left out in; None: 5, or 3 where the seconds of a candidate can be chosen or of
            many rows, and 2 of very many.
        name: as it appears in tables.

    Raises:
        ValueError: no candidate, one twice, or a name that no method has.
    """

    takes_budget = True

    def __init__(
        self,
        candidates: Sequence[str | Method] = CANDIDATES,
        models: Mapping[str, Method] | None = None,
        budget_s: float = 60.0,
        folds: int | None = None,
        name: str = "auto",
    ) -> None:
        check_arguments(locals(), budget_s=POSITIVE, folds=or_null(whole(2)))
        self.name, self.budget_s, self.folds = name, float(budget_s), folds
        self._models = dict(models or {})
        self.candidates: list[str] = []
        if isinstance(candidates, str):
            candidates = [candidates]
        for one in candidates:
            self.candidates.append(self._known(one))
        if not candidates:
            raise SettingError("candidates=[]: at least one model is needed")
        self.members: tuple[Member, ...] = ()
        self.scale = 1.0
        self._fitted: list[Method] = []

    def _known(self, one: str | Method) -> str:
        """The name under which a candidate is kept."""
        name = one.name if isinstance(one, Method) else str(one)
        if isinstance(one, Method):
            self._models[name] = one
        known = sorted({*METHODS, *self._models} - {"auto"})
        if name not in known:
            raise SettingError(f"candidates: no model is called {name!r}{suggest(name, known)}")
        if name in self.candidates:
            raise SettingError(f"candidates: {name} is named twice")
        return name

    def _fresh(self, name: str) -> Method:
        """A candidate that nothing was fitted to."""
        return copy.deepcopy(self._models[name]) if name in self._models else method_class(name)()

    @property
    def both_ends(self) -> bool:  # type: ignore[override]
        """Whether a candidate takes both ends for moving."""
        kinds = (type(self._models[n]) if n in self._models else method_class(n) for n in self.candidates)
        return any(kind.both_ends for kind in kinds)

    @property
    def own_budget_s(self) -> float | None:  # type: ignore[override]
        """Seconds of everything, where a candidate's can be chosen [s]."""
        return self.budget_s if any(self._fresh(n).takes_budget for n in self.candidates) else None

    @property
    def label(self) -> str:
        """With what was chosen: `auto (complex_gp .7 + gsparc .3)`."""
        return self.name if self.effects is None else f"{self.name} ({self.effects})"

    @property
    def effects(self) -> str | None:  # type: ignore[override]
        """What was chosen, with its weights."""
        if len(self.members) < 2:
            return self.members[0].name if self.members else None
        return " + ".join(f"{m.name} {_short(m.weight)}" for m in self.members)

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Try the candidates on inner folds, choose, and fit what was chosen to all training rows.

        Raises:
            ValueError: no candidate serves these data, or they are too few to leave any out.
        """
        started, site = time.perf_counter(), data.site
        able = [n for n in self.candidates if site.static_end is not None or self._fresh(n).both_ends]
        quick = [name for name in able if not self._fresh(name).takes_budget]
        timed = [name for name in able if name not in quick]
        problems = {name: self._fresh(name).problem(data) for name in timed}
        refused = [Trial(name, refusal=why) for name, why in problems.items() if why is not None]
        timed = [name for name in timed if problems[name] is None]  # seconds are shared by these alone
        seconds = self.budget_s if timed and context.budget_s is None else context.budget_s
        budget = context.time_budget(math.inf if seconds is None else seconds)
        count = self.folds or _folds(len(fold.train) + len(fold.val), FEW if timed else FOLDS[0][1])
        way = course(data, cut_inside(data, fold, context.split, count, context.seed), context.seed)
        contest = Contest(way, replace(context, budget_s=None), budget)
        for name in quick:
            contest.try_out(name, partial(self._fresh, name))
        for number, name in enumerate(timed):
            contest.try_out(name, partial(self._fresh, name), len(timed) - number)
        contest.trials += refused
        missing = [n for n in self.candidates if n not in able]
        missing += [trial.name for trial in contest.trials if trial.refusal is not None]
        if missing:
            log.info("%s: not for these data: %s", self.name, ", ".join(missing))
        usable = [trial for trial in contest.trials if trial.usable]
        if not usable:
            reasons = "; ".join(t.refusal for t in contest.trials if t.refusal is not None)
            raise ValueError(f"{self.name}: no candidate serves these data ({reasons or 'none was tried'})")
        note = self._choose(usable, way)
        log.info("%s", note)
        reports = self._fit_members(data, fold, context, contest, {t.name: t for t in usable}, timed)
        self.site = site
        limited = [trial.limited_by for trial in contest.trials] + [report.limited_by for report in reports]
        notes = [note, *(text for report in reports for text in report.notes)]
        found = less_repeatable(budget.clock if timed else budget.limited_by, *limited)
        return FitReport(time.perf_counter() - started, tuple(notes), found)

    def _choose(self, usable: list[Trial], way: Course) -> str:
        """Settle weights and the scale of the variance; returns what was found, one line.

        Where seconds ended the trials of some early, all are compared on the folds that these came to; once
        none of them is wanted, the others on all of theirs.
        """
        while True:
            folds = min(len(trial.residual) for trial in usable)
            gram = products(usable, way, folds)
            weights = stacking.choose(gram, way.units(folds))
            longer = [trial for trial in usable if len(trial.residual) > folds]
            wanted = {trial.name for trial, weight in zip(usable, weights, strict=True) if weight}
            if not longer or not wanted <= {trial.name for trial in longer}:
                break
            usable = longer
        errors = np.einsum("nkk->k", gram) / len(gram)
        said = variances(usable, list(errors), folds) @ weights + stacking.spread(weights, gram)
        left = stacking.squared(weights, gram)
        self.scale = stacking.variance_scale(left, said)
        chosen = [(t.name, float(w), float(e)) for t, w, e in zip(usable, weights, errors, strict=True) if w]
        self.members = tuple(Member(*one) for one in sorted(chosen, key=lambda one: -one[1]))
        shown = figure_of(way, float(left.mean()), folds)
        return f"{self.label}: {shown} left out ({folds} folds, split={way.inner.name})"

    def _fit_members(
        self, data: Measurements, fold: Fold, context: FitContext, contest: Contest,
        trials: Mapping[str, Trial], timed: Sequence[str],
    ) -> list[FitReport]:  # fmt: skip
        """Fit what was chosen, those whose seconds can be chosen last, with what is left of the budget.

        Where one's trial took so far beyond its seconds that none are left, what that trial learned from a
        part of the rows is kept.
        """
        reports, found = [], dict[str, Method]()
        names = sorted((member.name for member in self.members), key=lambda name: name in timed)
        for number, name in enumerate(names):
            trial, seconds, kept = trials[name], None, None
            if name in timed:
                seconds = contest.left() / (len(names) - number) - trial.over_s
                kept = trial.method if seconds < LEAST_S else None
            if kept is not None:
                known = len(contest.way.inner.folds[len(trial.residual) - 1].train)
                said = f"{name}: no seconds were left to learn from all rows; it knows {known} training rows"
                found[name] = kept
                reports.append(FitReport(0.0, (said,), context.budget_clock))
                continue
            own = context if len(names) == 1 else context.within(name)
            found[name] = self._fresh(name)
            reports.append(found[name].fit(data, fold, replace(own, budget_s=seconds)))
        self._fitted = [found[member.name] for member in self.members]
        return reports

    # -- answering ---------------------------------------------------------------------------------

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        return self._mixed([method.predict(tx, rx) for method in self._fitted])

    def answer(self, batch: Batch) -> Prediction:
        """See `Method.answer`; every chosen candidate's own."""
        return self._mixed([method.answer(batch) for method in self._fitted])

    def _mixed(self, parts: list[Prediction]) -> Prediction:
        if self.site is None:
            raise ValueError(f"{self.name}: fit or restore it first")
        weights, errors = zip(*((m.weight, m.error) for m in self.members), strict=True)
        return mixed(parts, weights, errors, self.scale, self.site.kind)

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What was chosen, and the states of that."""
        members = [
            {**vars(member), "state": method.state()}
            for member, method in zip(self.members, self._fitted, strict=True)
        ]
        return {"members": members, "scale": self.scale}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.scale, self._fitted = site, float(state["scale"]), []
        self.members = tuple(
            Member(str(m["name"]), float(m["weight"]), float(m["error"])) for m in state["members"]
        )
        for stored in state["members"]:
            method = self._fresh(str(stored["name"]))
            method.restore(site, stored["state"])
            self._fitted.append(method)

    @property
    def has_gaussians(self) -> bool:  # type: ignore[override]
        """Whether anything that was chosen has."""
        return any(method.has_gaussians for method in self._fitted)

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`: those of the heaviest that has Gaussians, and their number in all."""
        for method in self._fitted:
            if method.has_gaussians:
                count = sum(one.size() for one in self._fitted if one.has_gaussians)
                return {**method.facts(), "model/num_gaussians": count}
        return super().facts()

    def gaussians(self, tx: Tensor, rx: Pose) -> GaussianCloud:
        """See `HasGaussians`; those of the heaviest that renders any."""
        for method in self._fitted:
            if isinstance(method, HasGaussians):
                with contextlib.suppress(ValueError):  # this one did not, of these data
                    return method.gaussians(tx, rx)
        raise ValueError(f"{self.label}: nothing here is rendered from Gaussians")

    def objects(self) -> SiteObjects:
        """Those of the heaviest that found any."""
        every = (method.objects() for method in self._fitted)
        return next((found for found in every if len(found)), SiteObjects.of())

    def size(self) -> int:
        """That of all that was chosen."""
        return sum(method.size() for method in self._fitted)


def _folds(rows: int, most: int) -> int:
    """Folds for so many training rows."""
    return min(next((folds for limit, folds in FOLDS if rows <= limit), 2), most)


def _short(weight: float) -> str:
    """`.7`, or `.35`."""
    return f"{weight:.2f}".strip("0")
