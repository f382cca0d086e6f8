"""A method for channels, and a process on what it leaves of its rows where leaving rows out says it pays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.initial import ChannelSettings
from gsparc.models.closed_form import ClosedForm, LeftOutRows, restored, stored
from gsparc.models.method import Method, Prediction
from gsparc.models.reduced import Blended
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import less_repeatable

LEAST_GAIN = 0.03  # of the left-out residual's power, for a process on it


class Residual(ClosedForm):
    """The sum of a method and a share of a process, conditioned on left-out residuals.

    Of several tones or antennas there is no process: one of them is kept of rows left out.

    Args:
        method: of channels; None: `restore` is to follow.
    """

    method: ClosedForm

    def __init__(self, method: ClosedForm | None = None) -> None:
        if method is not None:
            self.method, self.name = method, method.name
        self.rest: ChannelField | None = None
        self.share = 0.0  # of the process's mean in [0, 1]

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Fit the method, then the process on its left-out residuals within the same seconds."""
        budget = context.time_budget()
        report = self.method.fit(data, fold, context)
        self.site, self.held, self.rest = data.site, self.method.held, None
        if data.target[0].size > 1:
            return report
        began = budget.counted.wall
        left = self.method.left_out()
        if budget.over():
            note = "no time for a process on what the sources leave"
            return replace(report, notes=(*report.notes, note), limited_by=budget.clock)
        # Direct wave and leakage are for the method: in what it leaves they would be fitted to its errors.
        process = ChannelField(ChannelSettings(direct=False, constant=False))
        fold = Fold(left.rows, left.rows[:0], left.rows[:0])
        within = process.fit(_residuals(left, data), fold, replace(context, budget_s=budget.left_s))
        missed = torch.from_numpy(data.target[left.rows]).flatten() - left.mean.flatten()
        predicted = process.left_out().mean.flatten()
        # Least squares share of left-out predictions: below 1 where the process is too sure.
        overlap = float((predicted.conj() * missed).real.sum())
        self.share = min(max(overlap / max(float(predicted.abs().square().sum()), 1e-30), 0.0), 1.0)
        gain = float((missed - self.share * predicted).abs().square().sum() / missed.abs().square().sum())
        if (gain := 1 - gain) >= LEAST_GAIN:
            self.rest = process
        note = f"a process explains {max(gain, 0):.0%} of what the sources leave, left out one by one"
        limited = less_repeatable(report.limited_by, within.limited_by)
        return FitReport(report.seconds + budget.counted.wall - began, (*report.notes, note), limited)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`."""
        self.method.condition(data, rows)
        if self.rest is not None:
            left = self.method.left_out()
            # Residuals of rows left out: of rows that the method knows they would be too small.
            self.rest.condition(_residuals(left, data), left.rows)

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; the variance errs high by what the process explains."""
        told = self.method.predict(query)
        if self.rest is None:
            return told
        return replace(told, mean=told.mean + self.share * self.rest.predict(query).mean)

    def left_out(self) -> LeftOutRows:
        """See `ClosedForm`."""
        result = self.method.left_out()
        if self.rest is None:
            return result
        return replace(result, mean=result.mean + self.share * self.rest.left_out().mean)

    def parts(self) -> Iterator[tuple[float, ClosedForm]]:
        """See `ClosedForm`; without the process."""
        yield from self.method.parts()

    @property
    def terms(self) -> tuple[str, ...]:
        """See `ClosedForm`."""
        return self.method.terms if self.rest is None else (*self.method.terms, "residual")

    def size(self) -> int:
        """Return the method's."""
        return self.method.size()

    def objects(self) -> SiteObjects:
        """Return the method's."""
        return self.method.objects()

    @property
    def reducible(self) -> Method:
        """See `Method.reducible`."""
        return self.method

    def reduced(self, settings: Mapping[str, Any], measured: dict[str, Tensor]) -> Method:
        """See `Method.reduced`; the process stays as it is."""
        result, share = super().reduced(settings, measured), self.share
        if self.rest is None:
            return result
        return Blended(result, self.rest.predict, lambda own, rest: torch.add(own, rest, alpha=share))

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        rest = None if self.rest is None else self.rest.state()
        return {"method": stored(self.method), "rest": rest, "share": self.share}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.method, self.share = site, restored(site, state["method"]), float(state["share"])
        self.name = self.method.name
        if state["rest"] is not None:
            self.rest = ChannelField()
            self.rest.restore(site, state["rest"])


def _residuals(left: LeftOutRows, data: Measurements) -> Measurements:
    """The measurements with what is left of rows, left out one by one, as targets."""
    target = np.zeros_like(data.target)
    target[left.rows] = data.target[left.rows] - left.mean.numpy().reshape(-1, *data.target.shape[1:])
    return replace(data, target=target)
