"""A rasterized field averaged with a Gaussian process on whole targets: its weight, and reduced versions."""

from __future__ import annotations

import logging
from dataclasses import replace

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
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.mixture.weights import LEAST_HELD, Rows, comparable
from gsparc.models.pareto import Settings
from gsparc.models.reduced import View
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
        why = (
            f"{len(fold.val)} held-out rows do not tell whether Gaussians gain"
            if field.size()
            else "no Gaussians"
        )
        log.info("%s: a Gaussian process alone", why)
        return (process, 1.0), None
    held, explained = [], None
    val = fold.val[:: -(-len(fold.val) // MOST_HELD)] if len(fold.val) else fold.val
    if len(val):
        batch = data.batch(val)
        target = comparable(batch.target, data.site)
        own, plain = (
            comparable(found.mean, data.site)
            for found in (field.predict(batch.tx, batch.rx), process.predict(batch.tx, batch.rx))
        )
        held.append((own, plain, target))
        explained = solution_weights.explained(own, target, data.site.kind != "csi")
    if spectra:
        rows = [Rows(*(_flat(values) for values in triple)) for triple in held]
        rows += [] if left is None else [_left_out(left, distance)]
        weight = solution_weights.share_of_second(rows)
    else:
        weight = solution_weights.weights(list(held[0][:2]), held[0][2], np.arange(len(val)))[1]
    log.info(
        "held out, %d rows and %d of training without their neighbours: a Gaussian process weighs %.2f",
        len(val), 0 if left is None else len(left.centres), weight,
    )  # fmt: skip
    return ((process, weight) if weight > 0 else None), explained


class Averaged(View):
    """The field's answer with a mean that lies between its own and the process's.

    Args:
        inner: answers for the field; its confidence and variance stay.
        process: fitted, of the same targets.
        weight: of the process, in [0, 1].
    """

    def __init__(self, inner: Method, process: Method, weight: float) -> None:
        super().__init__(inner)
        self.process, self.weight = process, weight

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        found = self.inner.predict(tx, rx)
        return replace(found, mean=torch.lerp(found.mean, self.process.predict(tx, rx).mean, self.weight))


def mean_alone(process: Method, settings: Settings | None = None) -> Method:
    """The process without its variance, which costs most of its answer and which the field has of its own."""
    spared = {"confidence": False, **(settings or {})}
    return process.reduced(spared, {}) if isinstance(process, GaussianProcess) else process


def averaged(own: Method, process: Method, weight: float) -> Method:
    """A reduced field averaged with as many pixels of the process.

    Interpolation is linear: the mean is taken on the coarse grid, and filled in once.

    Args:
        own: the field, reduced; `Filled` where it answers on a coarser grid.
        process: fitted.
        weight: of the process.
    """
    if not isinstance(own, Filled):
        return Averaged(own, mean_alone(process), weight)
    lean = mean_alone(process, {"stride": own.stride})
    if isinstance(lean, Filled):
        return Filled(Averaged(own.inner, lean.inner, weight), own.grid, own.stride)
    return Averaged(own, lean, weight)


class Summed(View):
    """A reduced field with the residual of the whole one."""

    def __init__(self, inner: Method, whole: Mixture) -> None:
        super().__init__(inner)
        self.whole = whole

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        found = self.inner.predict(tx, rx)
        if self.whole.residual is None:
            return found
        return replace(found, mean=found.mean + self.whole.share * self.whole.residual(tx, rx).mean)


def _flat(values: Tensor) -> np.ndarray:
    return values.detach().double().flatten(1).numpy()


def _left_out(left: LeftOut, distance: float | None) -> Rows:
    """Training rows as far from what is left as held-out rows are, as field and process predict them."""
    gap = left.as_far_as(distance)
    own, target = left.at(gap, left.predicted)
    return Rows(own, left.at(gap, left.by_process())[0], target)
