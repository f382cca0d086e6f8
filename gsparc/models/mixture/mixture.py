"""Several solutions of one problem as one method: their mean, weighed by rows held out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from gsparc.data import heeded
from gsparc.data.inner_folds import cut_inside
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.closed_form import ClosedForm, LeftOutRows, restored, stored
from gsparc.models.method import Prediction
from gsparc.models.mixture import solutions
from gsparc.models.mixture.weights import comparable, explained
from gsparc.models.terms import EffectSettings
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.time_budget import less_repeatable

log = logging.getLogger(__name__)


class Mixture(ClosedForm):
    """The weighed mean of members: no single one need be the right one.

    Args:
        init: settings of candidates.
        effects: switches of terms, of which `visibility` and `residual` are heeded.
    """

    has_gaussians = True

    def __init__(self, init: InitSettings, effects: EffectSettings) -> None:
        self.init, self.switches = init, effects
        self.members: list[ClosedForm] = []
        self.weights: tuple[float, ...] = ()  # (M,) of the mean, of sum 1
        self.started = ""  # names of members
        self.explained: float | None = None  # share of the variance of validation rows, by Gaussians
        self.init_s: float | None = None

    def fit_members(
        self, names: Sequence[str], init: InitSettings, data: Measurements, fold: Fold, context: FitContext
    ) -> FitReport:
        """Fit candidates by name, weigh several by rows held out, and condition them on all rows.

        Raises:
            ValueError: the only candidate, or the one asked for, cannot solve this.
        """
        budget = context.time_budget()
        end = "" if context.budget_s is None else f", within {context.budget_s:.3g} s"
        log.info("training a Gaussian field with closed-form weights: init=%s%s", " and ".join(names), end)
        known, several = np.sort(np.concatenate([fold.train, fold.val])), len(names) > 1
        cut = cut_inside(data, fold, context.split, solutions.GROUPS, context.seed) if several else None
        found, reports, read = solutions.find(
            tuple(names), init, self.switches, data, fold, context, budget, cut
        )
        chosen = solutions.weighed(found, data, fold, cut)
        heeded.count(*(path for name in chosen for path in read[name]))
        members, weights = zip(*chosen.values(), strict=True)
        self.members, self.weights, self.started = list(members), tuple(weights), "+".join(chosen)
        self.site, self.init_s = data.site, budget.counted.wall
        log.info(
            "%s of %d Gaussians from init=%s, terms %s", type(self).__name__, self.count,
            self.started, ", ".join(self.terms) or "none",
        )  # fmt: skip
        self.explained = self._explained(data, fold, several)
        if several or self.explained is not None:  # else it is of these rows already
            self.condition(data, known)
        seconds = budget.counted.wall
        if several:
            context.curve(seconds, "final")
        stages = {name: report.seconds for name, report in reports.items()}
        stages["weighing"] = max(self.init_s - sum(stages.values()), 0.0)
        stages["final weights"] = seconds - self.init_s
        unused = {name: spent for name, spent in stages.items() if name in reports and name not in chosen}
        notes = [note for name in chosen for note in reports[name].notes]
        limited = less_repeatable(budget.limited_by, *(report.limited_by for report in reports.values()))
        return FitReport(seconds, tuple(notes), limited).costing(Cost(stages, unused))

    def _explained(self, data: Measurements, fold: Fold, apart: bool) -> float | None:
        """What Gaussians explain of validation rows; conditions on training rows, unless `apart` already."""
        if not (len(fold.val) and self.count):
            return None
        if not apart:
            self.condition(data, fold.train)
        batch = data.batch(fold.val)
        result = self.predict(batch).explained
        assert result is not None
        own, target = (comparable(one, data.site) for one in (result, batch.target))
        return explained(own, target, data.site.kind != "csi")

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Every member on the same rows."""
        for member in self.members:
            member.condition(data, rows)

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; what members disagree about is added to their variances."""
        result = [member.predict(query) for member in self.members]
        if len(result) == 1:
            return result[0]
        pairs = list(zip(self.weights, result, strict=True))
        mean = torch.stack([weight * one.mean for weight, one in pairs]).sum(0)
        spreads, shares = [], []
        for weight, one in pairs:
            assert one.variance is not None and one.unknown is not None
            apart = (one.mean - mean).abs().square().flatten(1).mean(1)
            spreads.append(weight * (one.variance + apart))
            shares.append(weight * one.unknown)
        parts = [weight * one.explained for weight, one in pairs if one.explained is not None]
        variance, unknown = (torch.stack(each).sum(0).to(mean.real.dtype) for each in (spreads, shares))
        return Prediction(mean, variance, unknown, torch.stack(parts).sum(0) if parts else None)

    def left_out(self) -> LeftOutRows:
        """The mean of all."""
        result = [member.left_out() for member in self.members]
        if len({one.mean.shape for one in result}) > 1:
            raise ValueError(f"{self.name}: of several tones or antennas one is kept of rows left out")
        pairs = list(zip(self.weights, result, strict=True))
        mean = torch.stack([weight * one.mean for weight, one in pairs]).sum(0)
        variance = torch.stack([weight * one.variance for weight, one in pairs]).sum(0)
        return LeftOutRows(result[0].rows, mean, variance)

    @property
    def only(self) -> ClosedForm | None:
        """Return the member, where it is one."""
        return self.members[0] if len(self.members) == 1 else None

    @property
    def forgets(self) -> bool:  # type: ignore[override]
        """See `ClosedForm`."""
        return self.only is not None and self.only.forgets

    def parts(self) -> Iterator[tuple[float, ClosedForm]]:
        """See `ClosedForm`."""
        for weight, one in zip(self.weights, self.members, strict=True):
            yield from ((weight * more, part) for more, part in one.parts())

    @property
    def count(self) -> int:
        """Gaussians of all members."""
        return sum(member.count for member in self.members)

    def size(self) -> int:
        """See `count`."""
        return self.count

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms of any member."""
        return tuple(dict.fromkeys(term for one in self.members for term in one.terms))

    def objects(self) -> SiteObjects:
        """Those of the heaviest member that found any."""
        result = [self.members[i].objects() for i in np.argsort(self.weights)[::-1]]
        return next((one for one in result if len(one)), result[0])

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        members = [stored(member) for member in self.members]
        return {
            "members": members, "weights": list(self.weights), "started": self.started,
            "explained": self.explained,
        }  # fmt: skip

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.started, self.explained = site, str(state["started"]), state["explained"]
        self.members = [restored(site, member) for member in state["members"]]
        self.weights = tuple(state["weights"])
