"""What a Gaussian process on whole targets can spare: principal components, pixels, its variance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsparc.methods.coarse_grid import Filled
from gsparc.methods.method import Method, Prediction
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import View
from gsparc.methods.target_rows import from_real
from gsparc.ops import Pose

if TYPE_CHECKING:
    from gsparc.methods.gp import GaussianProcess


def reduced(method: GaussianProcess, settings: Settings) -> Method:
    """The mean of the process with the strongest components (`keep`, a share) on fewer pixels (`stride`)."""
    assert method.site is not None
    if set(settings) <= {"confidence"} and settings.get("confidence", True):
        return method
    stride, grid = int(settings.get("stride", 1)), method.site.grid
    count = max(1, math.ceil(float(settings.get("keep", 1.0)) * len(method.axes)))
    kept = method.weights.square().sum(0).topk(min(count, len(method.axes))).indices
    mean, axes, shape = method.mean, method.axes[kept], method.shape
    if stride > 1:
        assert grid is not None
        parts = [part.unflatten(-1, shape)[..., ::stride, ::stride] for part in (mean, axes)]
        shape = tuple(parts[0].shape)
        mean, axes = (part.flatten(-2).contiguous() for part in parts)
    lean = Mean(method, mean, axes, method.weights[:, kept], shape)
    return Filled(lean, grid, stride) if stride > 1 and grid is not None else lean


class Mean(View):
    """The mean of a Gaussian process, without its variance.

    Args:
        inner: fitted.
        mean, axes: (P,) and (C, P), the basis of targets.
        weights: (n, C), so that scores are `kernel(query, places) @ weights`.
        shape: of a target.
    """

    def __init__(
        self, inner: GaussianProcess, mean: Tensor, axes: Tensor, weights: Tensor, shape: tuple[int, ...]
    ) -> None:
        super().__init__(inner)
        assert inner.site is not None
        self._kind, self._end, self._shape = inner.site.kind, inner.site.moving_end, shape
        self._mean, self._axes, self._weights = mean, axes, weights.float().contiguous()
        self._middle = torch.from_numpy(inner.positions.mean(0)).float()
        self._scale = math.sqrt(3) / inner.kernel.length
        self._places = (torch.from_numpy(inner.positions).float() - self._middle) * self._scale

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; Matern-3/2 as in `gsparc.methods.gp.Kernel`, in float32."""
        where = tx if self._end == "tx" else rx.position.reshape(-1, 3).expand(len(tx), 3)
        query = (where - self._middle) * self._scale
        far = torch.linalg.vector_norm(query[:, None] - self._places, dim=-1)  # cdist: three times slower
        scores = ((1 + far) * torch.exp(-far)) @ self._weights
        return Prediction(from_real(torch.addmm(self._mean, scores, self._axes), self._kind, self._shape))

    def size(self) -> int:
        """Components kept."""
        return len(self._axes)
