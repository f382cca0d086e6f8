"""Trained methods that answer faster: with which settings, and as what."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NoReturn

import numpy as np
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.data.site_objects import SiteObjects
from gsparc.models.method import Method, Prediction, Reducible
from gsparc.models.pareto import Settings
from gsparc.ops import Pose

log = logging.getLogger(__name__)

AS_TRAINED = {"keep": 1.0, "stride": 1, "confidence": True}  # else: None
Measured = dict[str, Tensor]


def knobs(method: Method) -> tuple[str, ...]:
    """Names of the settings that mean something to a method; none where it is not `Reducible`."""
    return method.knobs() if isinstance(method, Reducible) else ()


def contributions(method: Method, data: Measurements, rows: np.ndarray) -> Measured:
    """What must be known of training rows (n,) to reduce a method; stored with the model."""
    return method.contributions(data, rows) if isinstance(method, Reducible) else {}


def reduced(method: Method, settings: Settings, measured: Measured) -> Method:
    """The method with `settings`; itself when there are none."""
    return method.reduced(settings, measured) if settings and isinstance(method, Reducible) else method


def combinations(
    method: Method, grid: Mapping[str, Sequence[Any] | None], singles: Mapping[str, Sequence[Any]]
) -> Iterator[dict[str, Any]]:
    """Settings: none, each of `singles` alone, and every combination in `grid`, of the knobs the method has.

    Strides must divide the columns, others are left out with a warning.
    """
    known = knobs(method)
    alone = [{knob: value} for knob, values in singles.items() if knob in known for value in values]
    axes = {knob: values for knob, values in grid.items() if knob in known and values is not None}
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
    grid = None if method.site is None else method.site.grid
    if grid is None:
        return list(strides)
    fitting = [stride for stride in strides if grid.width % stride == 0]
    if len(fitting) < len(strides):
        none = ", ".join(str(stride) for stride in strides if stride not in fitting)
        log.warning("stride=%s: does not divide the %d columns of the grid, left out", none, grid.width)
    return fitting or [1]


class View(Method):
    """Answers for `inner`; the whole method is what is trained and stored.

    Args:
        inner: fitted.
    """

    def __init__(self, inner: Method) -> None:
        self.inner, self.name = inner, inner.name

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        return self.inner.predict(tx, rx)

    def size(self) -> int:
        """As the inner method's."""
        return self.inner.size()

    def objects(self) -> SiteObjects:
        """As the inner method's."""
        return self.inner.objects()

    def fit(self, *unused: Any, **named: Any) -> NoReturn:
        """Refused: `TypeError`."""
        raise TypeError("a view of a trained method is neither trained nor stored")

    state = restore = fit


class MeanOnly(View):
    """Leaves confidence and variance out of the answer."""

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the mean alone."""
        return Prediction(self.inner.predict(tx, rx).mean)
