"""Methods in closed form by the names that `init=` and mixtures have for them, unfitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from gsparc.data.walls import read_walls
from gsparc.field.initial import InitSettings
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.turned_rows import FullPowerGP, TurnedNeighbours
from gsparc.models.closed_form import ClosedForm
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.image_sources.known.method import KnownWallsGP
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import SearchSettings as BearingSearchSettings
from gsparc.models.powers.field import PowerField
from gsparc.models.powers.together.field import JointPowerField
from gsparc.training.context import FitContext

# `(init, clutter, context) -> method`: whether obstacles are sought.
Candidate = Callable[[InitSettings, bool, FitContext], ClosedForm]


def make_sources(init: InitSettings, clutter: bool, context: FitContext) -> ClosedForm:
    """Return image sources of several searches.

    Searches start where measured directions meet, where these were solved before.
    """
    method = ImageSourceGP(**_search_arguments(init, clutter, context))
    if "rays" in context.beside:
        method.start = context.beside["rays"].points_and_amplitudes()
    return method


def make_scene(init: InitSettings, clutter: bool, context: FitContext) -> ClosedForm:
    """Return images of the static end in the walls of `init.file`.

    Raises:
        DataError: no such file, or walls that cannot be.
    """
    return KnownWallsGP(read_walls(init.file), **_search_arguments(init, clutter, context))


def make_powers(init: InitSettings, clutter: bool, context: FitContext) -> ClosedForm:
    """Make losses in walls of a file (`init=scene`), and a process of the rest.

    Raises:
        DataError: `init=scene` without a file, or walls that cannot be.
    """
    walls = read_walls(init.file) if init.name == "scene" else None
    return PowerField(context.seed, walls, context.terms)


def make_joint_powers(init: InitSettings, clutter: bool, context: FitContext) -> ClosedForm:
    """Return powers of several stations in one process;
    without `clutter` they share their law alone.
    """
    return JointPowerField(clutter and init.name != "diffuse", context.seed, context.terms)


def make_bearings(
    init: InitSettings, clutter: bool, context: FitContext, **more: Any
) -> ClosedForm:
    """Return sources where bearings cross; `more` is of `MovingArrayField`."""
    search = replace(BearingSearchSettings(), sources=init.max_sources)
    return MovingArrayField(search, seed=context.seed, **more)


def _search_arguments(init: InitSettings, clutter: bool, context: FitContext) -> dict[str, Any]:
    """What `ImageSourceGP` takes, of the settings of an initialiser."""
    names = ("searches", "search_rows", "rows", "margin", "max_sources", "order")
    arguments = {name: getattr(init, name) for name in names}
    arguments["searches"] = max(round(context.effort * init.searches), 1)
    for name in ("search_rows", "rows"):
        # Factoring a covariance of n rows takes n^3.
        arguments[name] = max(round(context.effort ** (1 / 3) * getattr(init, name)), 8)
    return {**arguments, "clutter": clutter, "offsets": init.snapshot, "seed": context.seed}


CANDIDATES: dict[str, Candidate] = {
    "sources": make_sources,
    "scene": make_scene,
    "rays": lambda init, clutter, context: DirectionalGP(init.rows, context.seed, clutter),
    "diffuse": lambda *unused: ChannelField(),
    "powers": make_powers,
    "joint_powers": make_joint_powers,
    "bearings": make_bearings,
    "process": lambda *unused: GaussianProcess(),
    "aligned": lambda *unused: FullPowerGP(),
    "neighbours": lambda *unused: TurnedNeighbours(),
}
