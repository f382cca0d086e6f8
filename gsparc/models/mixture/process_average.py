"""A rasterized field averaged with a Gaussian process on whole targets: its weight, and reduced versions."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.coarse_grid import Filled
from gsparc.models.left_out_images import LeftOut
from gsparc.models.method import Method, Prediction
from gsparc.models.mixture import weights as solution_weights
from gsparc.models.mixture.weights import LEAST_HELD, Rows, comparable
from gsparc.models.pareto import Settings
from gsparc.models.reduced import View, reduced
from gsparc.ops import Pose
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

MOST_HELD = 1_000  # validation rows that the process is weighed on: memory


def weigh(
    field: Method, data: Measurements, fold: Fold, left: LeftOut | None, distance: float | None
) -> tuple[tuple[Method, float] | None, float | None]:
    """What a plain process on whole targets is worth next to a field, on rows that neither learned from.

    Those are validation rows and, of spectra, training rows that both predict without their neighbours:
    a dozen rows alone decide by chance.

    Args:
        field: fitted on the same rows, without a process.
        data: measurements.
        fold: training and validation rows.
        left: training rows of spectra as the field's start predicts them, before any step.
        distance: of validation rows from the nearest training row [m].

    Returns:
        The process with its weight in the mean, None where it gains nothing; and the share of the variance
        of validation rows that the field explains, where that was found.
    """
    spectra = data.site.kind == "spectrum"
    left = left if spectra else None
    process = GaussianProcess()
    process.fit(data, Fold(fold.train, fold.val[:0], fold.val[:0]), FitContext())
    if not field.size() or (left is None and len(fold.val) < LEAST_HELD):
        few = f"{len(fold.val)} held-out rows do not tell whether Gaussians gain"
        log.info("%s: a Gaussian process alone", few if field.size() else "no Gaussians")
        return (process, 1.0), None
    rows, explained, weight = [], None, 0.0
    val = fold.val[:: -(-len(fold.val) // MOST_HELD)] if len(fold.val) else fold.val
    if len(val):
        batch = data.batch(val)
        means = (method.predict(batch.tx, batch.rx).mean for method in (field, process))
        own, plain, target = (comparable(values, data.site) for values in (*means, batch.target))
        explained = solution_weights.explained(own, target, data.site.kind != "csi")
        if spectra:
            rows.append(Rows(*(part.detach().double().flatten(1).numpy() for part in (own, plain, target))))
        else:
            weight = solution_weights.weights([own, plain], target, np.arange(len(val)))[1]
    if left is not None:
        rows.append(_left_out(left, distance))
    if spectra:
        weight = solution_weights.share_of_second(rows)
    log.info(
        "held out, %d rows and %d of training without their neighbours: a Gaussian process weighs %.2f",
        len(val), 0 if left is None else len(left.centres), weight,
    )  # fmt: skip
    return ((process, weight) if weight > 0 else None), explained


class Blended(View):
    """A field's answer with a mean that another one's has a part in.

    Args:
        inner: answers for the field; its confidence and variance stay.
        other: what has the other mean, at tx (B, 3) [m] and receiver poses.
        weight: of the other mean.
        own: of the field's.
    """

    def __init__(
        self, inner: Method, other: Callable[[Tensor, Pose], Any], weight: float, own: float = 1.0
    ) -> None:
        super().__init__(inner)
        self.other, self.weight, self.own = other, weight, own

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        found = self.inner.predict(tx, rx)
        mean = self.own * found.mean + self.weight * self.other(tx, rx).mean
        return replace(found, mean=mean)


def mean_alone(process: Method, settings: Settings | None = None) -> Method:
    """The process without its variance, which costs most of its answer and which the field has of its own."""
    return reduced(process, {"confidence": False, **(settings or {})}, {})


def averaged(own: Method, process: Method, weight: float) -> Method:
    """A reduced field averaged with as many pixels of the process.

    Interpolation is linear: the mean is taken on the coarse grid, and filled in once.

    Args:
        own: the field, reduced; `Filled` where it answers on a coarser grid.
        process: fitted.
        weight: of the process.
    """
    lean = mean_alone(process, {"stride": own.stride} if isinstance(own, Filled) else None)
    if isinstance(own, Filled) and isinstance(lean, Filled):
        return Filled(Blended(own.inner, lean.inner.predict, weight, 1 - weight), own.grid, own.stride)
    return Blended(own, lean.predict, weight, 1 - weight)


def _left_out(left: LeftOut, distance: float | None) -> Rows:
    """Training rows as far from what is left as held-out rows are, as field and process predict them."""
    gap = left.as_far_as(distance)
    own, target = left.at(gap, left.predicted)
    return Rows(own, left.at(gap, left.by_process())[0], target)
