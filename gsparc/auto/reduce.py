"""Which knobs a trained method has, and the method with some of them turned."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import product
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.auto.combine import Companion
from gsparc.auto.method import Gsparc
from gsparc.data.schema import Measurements
from gsparc.methods.method import Method, Prediction
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import View
from gsparc.ops import Pose

log = logging.getLogger(__name__)

FAMILIES = {  # the most special class first
    "gsparc.array.method.ArrayField": "gsparc.array.reduce",
    "gsparc.array.moving.method.BearingField": "gsparc.array.moving.reduce",
    "gsparc.multipath.image_source_gp.VirtualSourceGP": "gsparc.multipath.reduce",
    "gsparc.methods.gp.GaussianProcess": "gsparc.methods.gp_reduced",
    "gsparc.training.splatting.LearnedField": "gsparc.training.reduce",
}
AS_TRAINED = {
    "keep": 1.0,
    "stride": 1,
    "cutoff": 1,
    "confidence": True,
    "frozen": True,
    "hybrid": True,
}  # else: None
Measured = dict[str, Tensor]


def answering(method: Method) -> Method:
    """The method that computes the answers: what `model=gsparc` decided on, else itself."""
    return method.answering[0] if isinstance(method, Gsparc) else method


def _rest(method: Method) -> Companion | None:
    """What completes its answers."""
    return method.answering[1] if isinstance(method, Gsparc) else None


class WithRest(View):
    """Answers completed by what stands beside the physics."""

    def __init__(self, inner: Method, rest: Companion) -> None:
        super().__init__(inner)
        self.rest = rest

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        said = self.inner.predict(tx, rx)
        return replace(said, mean=self.rest.completed(said.mean, tx, rx))


def family(method: Method) -> ModuleType | None:
    """The module that knows what a method can spare; None when it can spare nothing."""
    names = {f"{base.__module__}.{base.__qualname__}" for base in type(answering(method)).__mro__}
    for name, module in FAMILIES.items():
        if name in names:
            return import_module(module)
    return None


def knobs(method: Method) -> tuple[str, ...]:
    """Names of the settings that mean something to a method."""
    known = family(method)
    own = () if known is None else known.knobs(answering(method))
    return own if _rest(method) is None else (*own, "hybrid")


def measure(method: Method, data: Measurements, rows: np.ndarray) -> Measured:
    """What must be known of training rows (n,) to turn the knobs; stored with the model."""
    known = family(method)
    return {} if known is None else known.measure(answering(method), data, rows)


def reduced(method: Method, settings: Settings, measured: Measured) -> Method:
    """The method with `settings`; itself when there are none."""
    known = family(method)
    if not settings or known is None:
        return method
    own = {knob: value for knob, value in settings.items() if knob != "hybrid"}
    found, rest = known.reduced(answering(method), own, measured), _rest(method)
    return WithRest(found, rest) if rest is not None and settings.get("hybrid", True) else found


def combinations(
    method: Method, grid: Mapping[str, Sequence[Any] | None], singles: Mapping[str, Sequence[Any]]
) -> Iterator[dict[str, Any]]:
    """Settings: none, each of `singles` alone, and every combination in `grid`, of the knobs the method has.

    A grid without values takes all that the method offers; strides must divide the columns, others are left
    out with a warning.
    """
    known = knobs(method)
    alone = [{knob: value} for knob, values in singles.items() if knob in known for value in values]
    offered: Mapping[str, Sequence[Any]] = getattr(family(method), "offered", lambda _: {})(answering(method))
    axes = {
        knob: offered.get(knob, ()) if values is None else values
        for knob, values in grid.items()
        if knob in known
    }
    if "stride" in axes:
        axes["stride"] = _dividing(axes["stride"], method)
    together = [
        {k: v for k, v in zip(axes, chosen, strict=True) if AS_TRAINED.get(k) != v}
        for chosen in product(*axes.values())
    ]
    seen: list[dict[str, Any]] = []
    for settings in ({}, *alone, *together):
        if settings not in seen:
            seen.append(settings)
            yield settings


def _dividing(strides: Sequence[int], method: Method) -> list[int]:
    grid = getattr(getattr(method, "site", None), "grid", None)
    if grid is None:
        return list(strides)
    fitting = [stride for stride in strides if grid.width % stride == 0]
    if len(fitting) < len(strides):
        none = ", ".join(str(stride) for stride in strides if stride not in fitting)
        log.warning("stride=%s: does not divide the %d columns of the grid, left out", none, grid.width)
    return fitting or [1]
