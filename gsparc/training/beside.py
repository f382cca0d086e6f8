"""A rasterized field averaged with a Gaussian process on whole targets, both as lean as asked for."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsparc.methods.coarse_grid import Filled
from gsparc.methods.gp import GaussianProcess
from gsparc.methods.method import Method, Prediction
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import View
from gsparc.ops import Pose


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


def averaged(own: Method, process: Method, weight: float, share: float) -> Method:
    """A reduced field averaged with as many pixels of `share` of the process's components.

    Interpolation is linear: the mean is taken on the coarse grid, and filled in once.

    Args:
        own: the field, reduced; `Filled` where it answers on a coarser grid.
        process: fitted.
        weight: of the process.
        share: of its components, the strongest, in (0, 1].
    """
    if not isinstance(own, Filled):
        return Averaged(own, mean_alone(process, {"keep": share}), weight)
    lean = mean_alone(process, {"keep": share, "stride": own.stride})
    if isinstance(lean, Filled):
        return Filled(Averaged(own.inner, lean.inner, weight), own.grid, own.stride)
    return Averaged(own, lean, weight)
