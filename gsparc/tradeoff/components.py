"""What a Gaussian process on whole targets can spare: principal components and pixels."""

from __future__ import annotations

import copy
import math

import numpy as np
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.method import Method
from gsparc.peers.gp import GaussianProcess
from gsparc.tradeoff.coarse import Filled
from gsparc.tradeoff.points import Settings


def knobs(method: GaussianProcess) -> tuple[str, ...]:
    """What can be turned."""
    assert method.site is not None
    return ("keep", "stride") if method.site.kind == "spectrum" else ("keep",)


def measure(method: GaussianProcess, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
    """Nothing: components are ordered by their share of the variance already."""
    return {}


def reduced(method: GaussianProcess, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """The process with the first components (`keep`, a share) on fewer pixels (`stride`)."""
    assert method.site is not None
    twin, stride = copy.copy(method), int(settings.get("stride", 1))
    count = max(1, math.ceil(float(settings.get("keep", 1.0)) * len(method.axes)))
    energy = method.weights.square().sum(0) if len(method.axes) else method.weights[:0]
    kept = energy.topk(min(count, len(method.axes))).indices
    twin.axes, twin.weights = method.axes[kept], method.weights[:, kept].contiguous()
    if stride == 1:
        return twin
    grid = method.site.grid
    assert grid is not None

    def fewer(rows: Tensor) -> Tensor:
        image = rows.unflatten(-1, (grid.height, grid.width))[..., ::stride, ::stride]
        twin.shape = tuple(image.shape[-2:])
        return image.flatten(-2).contiguous()

    twin.axes, twin.mean = fewer(twin.axes), fewer(method.mean)
    return Filled(twin, grid, stride)
