"""Initialisers of conditional fields for channels: sources searched for, measured rays, none at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.field.conditional import CompletedField, ConditionalField, residuals
from gsparc.field.initial import InitSettings
from gsparc.methods.haste import factor_s
from gsparc.methods.method import FitContext, FitReport
from gsparc.methods.time_budget import TimeBudget, less_repeatable
from gsparc.multipath.directional_gp import DirectionalGP
from gsparc.multipath.image_source_gp import ImageSourceGP
from gsparc.multipath.known.method import KnownWallsGP
from gsparc.multipath.known.mirrors import counted
from gsparc.multipath.powers import field as power_field
from gsparc.multipath.powers.together import field as joint_field
from gsparc.multipath.source_field import RayField, SourceField
from gsparc.multipath.waves import initial as waves
from gsparc.multipath.waves.settings import ChannelSettings

COMPLETION_SHARE = 0.15  # of the seconds of sources, for that process
FACTORS = 4.0  # covariances of all rows that it needs at least
LEAST_GAIN = 0.03  # of the left-out residual's power, for a process on it


def sources(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Image sources of several searches, and a process on what they leave within the same seconds."""
    budget = context.time_budget()
    method = ImageSourceGP(
        searches=init.searches, search_rows=init.search_rows, rows=init.rows, margin=init.margin,
        max_sources=init.max_sources, order=init.order, clutter=clutter,
        offsets=init.snapshot, seed=context.seed,
    )  # fmt: skip
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), _searching(data, context))
    return _completed(SourceField(method), data, report, budget)


def scene(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Images of the static end in the walls of `init.file`; of powers, walls in the way of paths.

    Raises:
        DataError: no such file, or walls that cannot be.
    """
    if data.site.kind == "rssi":
        return powers(data, rows, init, clutter, context)
    budget = context.time_budget()
    method = KnownWallsGP(
        read_walls(init.file), search_rows=init.search_rows, rows=init.rows, max_sources=init.max_sources,
        order=init.order, clutter=clutter, offsets=init.snapshot, seed=context.seed,
    )  # fmt: skip
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), _searching(data, context))
    return _completed(SourceField(method), data, report, budget)


def rays(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Sources where measured directions meet."""
    method = DirectionalGP(rows=init.rows, seed=context.seed)
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    return RayField(method), report


def diffuse(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Leakage, a direct wave and waves from all around, without Gaussians."""
    budget = context.time_budget()
    field, notes = waves.initialise(data, rows, ChannelSettings(), budget)
    return field, FitReport(budget.counted.wall, notes, budget.limited_by)


def powers(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Coherent waves, or what the path loses in walls of a file (`init=scene`), and a process of the rest.

    Raises:
        DataError: `init=scene` without a file, or walls that cannot be.
    """
    budget = context.time_budget()
    known, site = None, data.site
    if init.name == "scene":
        known = counted(read_walls(init.file), site.origin, site.static_position)
    field, notes = power_field.initialise(data, rows, init.name != "diffuse", context.seed, budget, known)
    field.condition(data, rows)
    return field, FitReport(budget.counted.wall, notes, budget.limited_by)


def joint_powers(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Powers of several stations in one field; without `clutter` they share their law alone."""
    budget = context.time_budget()
    shared = clutter and init.name != "diffuse"
    field, notes = joint_field.initialise(data, rows, shared=shared, seed=context.seed, budget=budget)
    field.condition(data, rows)
    return field, FitReport(budget.counted.wall, notes, budget.limited_by)


def _searching(data: Measurements, context: FitContext) -> FitContext:
    """The seconds of a search: without those for `_completed`."""
    share = 1.0 if context.budget_s is None or data.target[0].size > 1 else 1 - COMPLETION_SHARE
    return replace(context, budget_s=None if context.budget_s is None else share * context.budget_s)


def _completed(
    field: ConditionalField, data: Measurements, report: FitReport, budget: TimeBudget
) -> tuple[ConditionalField, FitReport]:
    """With a process on what the sources leave, where leaving rows out says that it pays."""
    if data.target[0].size > 1:
        return field, report
    began = budget.counted.wall
    left = field.left_out()
    if budget.seconds - budget.spent < FACTORS * factor_s(len(left.rows)):
        budget.limited = True
        note = "no time for a process on what the sources leave"
        return field, replace(report, notes=(*report.notes, note), limited_by=budget.clock)
    remainder = residuals(field, data)
    settings = ChannelSettings(direct=False, constant=False)
    residual, _ = waves.initialise(remainder, left.rows, settings, budget)
    missed = torch.from_numpy(data.target[left.rows]).flatten() - left.mean.flatten()
    predicted = residual.left_out().mean.flatten()
    overlap = float((predicted.conj() * missed).real.sum())
    weight = min(max(overlap / max(float(predicted.abs().square().sum()), 1e-30), 0.0), 1.0)
    gain = 1 - float((missed - weight * predicted).abs().square().sum() / missed.abs().square().sum())
    note = f"a process explains {max(gain, 0):.0%} of what the sources leave, left out one by one"
    limited = less_repeatable(report.limited_by, budget.limited_by)
    seconds = report.seconds + budget.counted.wall - began
    report = FitReport(seconds, (*report.notes, note), limited)
    return (CompletedField(field, residual, weight) if gain >= LEAST_GAIN else field), report
