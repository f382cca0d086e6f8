"""Gaussians that are rendered, averaged with a plain process:
`array_process` and `image_process`.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from gsparc.base.limits import check_arguments, switch
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.method import Method, Prediction
from gsparc.models.reduced import Settings, average_with_process
from gsparc.models.splat.auto_settings import resolve_auto
from gsparc.models.splat.method import LearnedField
from gsparc.models.stack import LEAST_HELD, error_products, explained_variance, weigh
from gsparc.models.terms import array_obstacle
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost

log = logging.getLogger(__name__)
MOST_HELD = 1_000  # validation rows that the process is weighed on: memory
BEYOND = 1e-3  # of the variance of targets, that an averaged process leaves out


class ImageProcess(LearnedField):
    """Gaussians that emit images, trained by rendering,
    and a plain process by its weight in the mean.

    Args:
        plain: whether a plain process may stand in, or be averaged in.
        name: as it appears in tables.
        **field: see `LearnedField`.
    """

    def __init__(self, plain: bool = True, name: str = "image_process", **field: Any) -> None:
        check_arguments(locals(), plain=switch())
        super().__init__(name=name, **field)
        self.plain = plain
        self.explained: float | None = None
        # A process and its weight in the mean
        self._average: tuple[GaussianProcess, float] | None = None

    @property
    def effects(self) -> str:  # type: ignore[override]
        """The terms that are computed, for `summary.json`."""
        if self._is_process_alone:
            return "residual"
        base = "array" if self.settings.response.array else "image"
        return base + ("+residual" if self._average is not None else "")

    # -- learning ----------------------------------------------------------------------------------

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Train by rendering, and weigh a process against what came of it;
        see `LearnedField.fit`.
        """
        self._average = None
        array = self.settings.response.array
        why = array_obstacle(data.site, "rx", "the receiver moves") if array else None
        if why is not None:
            raise ValueError(f"{self.name}: {why}")
        choices, _ = resolve_auto(self.settings, self.init.name, data.site)
        log.info(
            "training by rendering: %d Gaussians, terms %s, init=%s; configured callbacks: %s",
            self.settings.field.count,
            self.effects,
            choices.init,
            ", ".join(type(callback).__name__ for callback in context.callbacks()) or "none",
        )
        report = super().fit(data, fold, context)
        spent = dict(self.spent)
        if self._average is not None:
            method = self._average[0]
            # It was weighed without validation rows, and answers with them.
            more = method.fit(data, Fold.of_all(np.sort(fold.learned())), FitContext())
            if not self._is_process_alone:  # components are most of a query
                self._average = method.with_strongest(BEYOND), self._average[1]
            report = replace(report, seconds=report.seconds + more.seconds)
            spent["averaged process"] = more.seconds
        spent["weighing"] = max(report.seconds - sum(spent.values()), 0.0)
        log.info("%s: %s", self.name, self.description)
        # Steps that no look kept, or all of the field: paid for, and not in the answer.
        unused = (
            {}
            if self.steps
            else {name: s for name, s in spent.items() if name.startswith("gradient")}
        )
        if self._is_process_alone:
            unused = {name: s for name, s in spent.items() if name != "averaged process"}
        return report.with_cost(Cost(spent, unused))

    @property
    def _is_process_alone(self) -> bool:  # type: ignore[override]
        """Whether the averaged process has all the weight."""
        return self._average is not None and self._average[1] >= 1

    def _weigh_process(self, data: Measurements, fold: Fold) -> None:
        """Weigh a process of the same rows by validation rows and, of spectra,
        training rows left out.
        """
        if not self.plain:
            return
        # A dozen validation rows decide by chance
        process, left_out = GaussianProcess(), self._left_out
        process.condition(data, fold.train)
        if not self.count_components() or (left_out is None and len(fold.val) < LEAST_HELD):
            few = f"{len(fold.val)} held-out rows do not tell whether Gaussians gain"
            log.info(
                "%s: a Gaussian process alone", few if self.count_components() else "no Gaussians"
            )
            self._average = process, 1.0
            return
        triples, val = [], fold.val[:: -(-len(fold.val) // MOST_HELD) or 1]
        if len(val):
            batch = data.batch(val)
            answers = (self.predict(batch).mean, process.predict(batch).mean, batch.target)
            triples.append([data.site.target.in_error_unit(answer).detach() for answer in answers])
        if left_out is not None:
            triples.append(
                [torch.from_numpy(values) for values in left_out.beside_process(self._apart)]
            )
        prediction, _, target = triples[0]
        self.explained = explained_variance(prediction, target, not data.site.target.is_complex)
        products = np.concatenate([error_products(both, target) for *both, target in triples])
        # Any gain counts: few rows, whose process is quick to ask, tell none surely.
        loss, slow = data.site.target.loss, (False, True)
        weight = float(weigh(products, np.arange(len(products)), loss, sure=0, slow=slow)[1])
        log.info(
            "%d held-out rows, %d training rows without their neighbours: weight of a Gaussian "
            "process %.2f",
            len(val),
            0 if left_out is None else len(left_out.centres),
            weight,
        )
        self._average = (process, weight) if weight else None

    # -- answering ---------------------------------------------------------------------------------

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        if self._average is not None and not self.count_components():
            return self._average[0].predict(query)
        field = super().predict(query)
        if self._average is None:
            return field
        # Its variance is most of its cost, and the field has one of its own
        process, weight = self._average
        return replace(
            field, mean=self.fitted_site.target.blend(field.mean, process.mean_at(query), weight)
        )

    def gradient_problem(self) -> str | None:
        """See `Method.gradient_problem`; a process alone has gradients."""
        process_only = self._average is not None and not self.count_components()
        return None if process_only else super().gradient_problem()

    def reduce(self, settings: Settings, measured: dict[str, Any]) -> Method:  # type: ignore[override]
        """See `Method.reduce`."""
        twin = copy.copy(self)
        twin._average = None
        result = LearnedField.reduce(twin, settings, measured)
        if self._average is None:
            return result
        process, weight = self._average
        return average_with_process(
            result, process, partial(self.fitted_site.target.blend, weight=weight)
        )

    def count_components(self) -> int:
        """Return the number of Gaussians."""
        return 0 if self._is_process_alone else super().count_components()

    @property
    def description(self) -> str:
        """See `Method`."""
        weight = 0.0 if self._average is None else self._average[1]
        return super().description + (
            f"; averaged with a plain Gaussian process of weight {weight:.2g}" if self.plain else ""
        )

    def without_process(self) -> Method | None:
        """See `Method.without_process`."""
        if self._average is None or not super().count_components():
            return None
        alone = copy.copy(self)
        alone._average, alone._doubled = None, None
        return alone

    def facts(self) -> dict[str, float | int | str | None]:
        """See `Method.facts`."""
        return {**super().facts(), "model/variance_explained": self.explained}

    # -- storing -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the field, averaged process, and what was found out."""
        beside = None
        if self._average is not None:
            method, weight = self._average
            beside = {"state": method.state(), "weight": weight}
        return {
            "inner": super().state(),
            "beside": beside,
            "facts": {"explained": self.explained, "steps": self.steps},
            "array": self.settings.response.array,
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self._average = None
        response = replace(self.settings.response, array=bool(state["array"]))
        self.settings = replace(self.settings, response=response)
        super().restore(site, state["inner"])
        if state["beside"] is not None:
            method = GaussianProcess()
            method.restore(site, state["beside"]["state"])
            self._average = method, float(state["beside"]["weight"])
        self.explained, self.steps = state["facts"]["explained"], int(state["facts"]["steps"])


class ArrayProcess(ImageProcess):
    """Gaussians that emit fields, which the static receiver's array images.

    Args:
        name: as it appears in tables.
        **field: see `ImageProcess`.
    """

    def __init__(self, name: str = "array_process", **field: Any) -> None:
        super().__init__(name=name, **field)
        self.settings = replace(self.settings, response=replace(self.settings.response, array=True))
