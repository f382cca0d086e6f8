"""Fields whose weights are in closed form: what makes each of measurements, and of a stored state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.field.initial import InitSettings
from gsparc.models.channels import field as channels
from gsparc.models.channels import initial as waves
from gsparc.models.channels.initial import ChannelSettings
from gsparc.models.conditional import ConditionalField
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.image_sources.known.images import counted
from gsparc.models.image_sources.known.method import KnownWallsGP
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.source_field import RayField, SourceField
from gsparc.models.method_field import AlignedField, MethodField, ProcessField
from gsparc.models.mixture.mixture import Mixture, residuals
from gsparc.models.moving_array.bearing_field import BearingField
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import SearchSettings
from gsparc.models.powers import field as power_field
from gsparc.models.powers.together import field as joint_field
from gsparc.models.target_rows import heard
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import less_repeatable

LEAST_GAIN = 0.03  # of the left-out residual's power, for a process on it


def sources(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Image sources of several searches, and a process on what they leave within the same seconds."""
    return _completed(ImageSourceGP(**_searched(init, clutter, context)), data, rows, context)


def scene(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Images of the static end in the walls of `init.file`; of powers, walls in the way of paths.

    Raises:
        DataError: no such file, or walls that cannot be.
    """
    if data.site.kind == "rssi":
        return powers(data, rows, init, clutter, context)
    method = KnownWallsGP(read_walls(init.file), **_searched(init, clutter, context))
    return _completed(method, data, rows, context)


def _searched(init: InitSettings, clutter: bool, context: FitContext) -> dict[str, Any]:
    """What `ImageSourceGP` takes, of the settings of an initialiser."""
    names = ("searches", "search_rows", "rows", "margin", "max_sources", "order")
    own = {name: getattr(init, name) for name in names}
    own["searches"] = max(round(context.effort * init.searches), 1)
    for name in ("search_rows", "rows"):
        own[name] = max(round(context.effort ** (1 / 3) * getattr(init, name)), 8)
    return {**own, "clutter": clutter, "offsets": init.snapshot, "seed": context.seed}


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


def bearings(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Sources where bearings cross, of at most `init.searches` searches.

    Searches end when the left-out error no longer falls. Of `init`, `searches` and `max_sources` are heeded;
    `clutter` means nothing to spectra.

    Raises:
        ValueError: not spectra of a moving receiver with a declared array that keeps its orientation.
    """
    search = replace(SearchSettings(), sources=init.max_sources)
    searches = max(round(init.searches * context.effort), 1)
    method = MovingArrayField(search=search, seed=context.seed, searches=searches)
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    return BearingField(method, heard(data, rows)), report


def _fitted_as(kind: type[MethodField]) -> Callable[..., tuple[ConditionalField, FitReport]]:
    """The method of a field on whole targets; `init` and `clutter` mean nothing to it."""

    def initialise(
        data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
    ) -> tuple[ConditionalField, FitReport]:
        method = kind.makes()
        report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
        return kind(method), report

    return initialise


def _completed(
    method: ImageSourceGP, data: Measurements, rows: np.ndarray, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """The sources, and a process on what they leave where leaving rows out says that it pays."""
    budget = context.time_budget()
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    field = SourceField(method)
    if data.target[0].size > 1:
        return field, report
    began = budget.counted.wall
    left = field.left_out()
    if budget.over():
        note = "no time for a process on what the sources leave"
        return field, replace(report, notes=(*report.notes, note), limited_by=budget.clock)
    remainder = residuals(left, data)
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
    return (Mixture([field], residual=residual, share=weight) if gain >= LEAST_GAIN else field), report


# `(data, rows, init, clutter, context) -> (field, report)` by name.
INITIALISERS: dict[str, Callable[..., tuple[ConditionalField, FitReport]]] = {
    "sources": sources,
    "scene": scene,
    "rays": rays,
    "diffuse": diffuse,
    "powers": powers,
    "joint_powers": joint_powers,
    "bearings": bearings,
    "process": _fitted_as(ProcessField),
    "aligned": _fitted_as(AlignedField),
}
# `(site, state) -> field` by the kind that a state names.
RESTORED: dict[str, Callable[[Site, dict[str, Any]], ConditionalField]] = {
    "sources": SourceField.restored,
    "rays": RayField.restored,
    "diffuse": channels.restored,
    "powers": power_field.restored,
    "joint_powers": joint_field.restored,
    "bearings": BearingField.restored,
    "process": ProcessField.restored,
    "aligned": AlignedField.restored,
}


def stored(field: ConditionalField) -> dict[str, Any]:
    """What `restored` reads."""
    if not isinstance(field, Mixture):
        return {"kind": field.kind, **field.state()}
    residual = None if field.residual is None else stored(field.residual)
    members = [stored(member) for member in field.members]
    return {"members": members, "residual": residual, **field.state()}


def restored(site: Site, state: dict[str, Any]) -> ConditionalField:
    """The field whose `stored` state this was."""
    if "members" in state:
        members = [restored(site, member) for member in state["members"]]
        residual = None if state["residual"] is None else restored(site, state["residual"])
        result: ConditionalField = Mixture(members, state["weights"], residual, state["share"])
    else:
        result = RESTORED[str(state["kind"])](site, state)
    result.site = site
    return result
