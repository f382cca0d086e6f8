"""Trained methods that answer faster or along with others: with which settings, and as what."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NoReturn

import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.site_objects import SiteObjects
from gsparc.models.method import Method, Prediction
from gsparc.ops import SphereGrid

log = logging.getLogger(__name__)

Settings = Mapping[str, Any]  # what is spared; a knob that is absent stays as trained
AS_TRAINED = {"keep": 1.0, "stride": 1, "confidence": True}  # else: None
ReductionInputs = dict[str, Tensor]  # see `Method.reduction_inputs`


def with_reduction(method: Method, settings: Settings, inputs: ReductionInputs) -> Method:
    """Return the method with `settings`; itself when there are none."""
    return method.reduce(settings, inputs) if settings else method


def list_settings(
    method: Method, grid: Mapping[str, Sequence[Any] | None]
) -> Iterator[dict[str, Any]]:
    """Yield settings: none, then all combinations in `grid` of knobs the method has.

    Strides must divide the columns, others are left out with a warning.
    """
    knobs = method.reduction_settings()
    axes = {knob: values for knob, values in grid.items() if knob in knobs and values is not None}
    if "stride" in axes:
        axes["stride"] = _dividing_strides(axes["stride"], method)
    together = [
        # A setting as trained changes nothing: dropped,
        # so that equal combinations are seen to be equal.
        {k: v for k, v in zip(axes, chosen, strict=True) if AS_TRAINED.get(k) != v}
        for chosen in product(*axes.values())
    ]
    seen: list[dict[str, Any]] = []
    for settings in ({}, *together):
        if settings not in seen:
            seen.append(settings)
            yield settings


def _dividing_strides(strides: Sequence[int], method: Method) -> list[int]:
    grid = None if method.site is None else method.site.grid
    if grid is None:
        return list(strides)
    fitting = [stride for stride in strides if grid.width % stride == 0]
    if len(fitting) < len(strides):
        none = ", ".join(str(stride) for stride in strides if stride not in fitting)
        log.warning(
            "stride=%s: does not divide the %d columns of the grid, left out", none, grid.width
        )
    # An empty axis would leave no combination at all.
    return fitting or [1]


class View(Method):
    """Answers for `inner`; the whole method is what is trained and stored.

    Args:
        inner: fitted.
    """

    no_gradient = "what answers faster does so in float32; load the whole model"

    def __init__(self, inner: Method) -> None:
        self.inner, self.name, self.threads_pay = inner, inner.name, inner.threads_pay
        self.uses_censored = inner.uses_censored

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        return self.inner.predict(query)

    def count_components(self) -> int:
        """Return the inner method's."""
        return self.inner.count_components()

    def objects(self) -> SiteObjects:
        """Return the inner method's."""
        return self.inner.objects()

    def fit(self, *unused: Any, **options: Any) -> NoReturn:
        """Refuse: `TypeError`."""
        raise TypeError("a view of a trained method is neither trained nor stored")

    # Refused as well: what is stored is the whole method.
    state = restore = fit


class MeanOnly(View):
    """Leaves confidence and variance out of the answer.

    Args:
        inner: fitted.
        mean_at: answers with its mean alone; None: it has no such thing.
    """

    def __init__(self, inner: Method, mean_at: Callable[[Query], Tensor] | None = None) -> None:
        super().__init__(inner)
        self._mean_at = mean_at

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; the mean alone."""
        return Prediction(self._mean_at(query) if self._mean_at else self.inner.predict(query).mean)


def coarsen_grid(grid: SphereGrid, stride: int) -> SphereGrid:
    """Return every `stride`-th pixel of the grid, the first row and column among them.

    Raises:
        ValueError: the columns cannot be divided so.
    """
    if grid.width % stride:
        raise ValueError(f"stride={stride} does not divide the {grid.width} columns of the grid")
    height, width = (grid.height - 1) // stride + 1, grid.width // stride
    steps = {
        "elevation_step": grid.elevation_step * stride,
        "azimuth_step": grid.azimuth_step * stride,
    }
    return replace(grid, height=height, width=width, **steps)


class Interpolated(View):
    """A method that answers on a coarser grid, its images interpolated to the full one.

    Args:
        inner: answers on `coarsen_grid(grid, stride)`.
        grid: the full one.
        stride: pixels per rendered pixel, along both axes.
    """

    def __init__(self, inner: Method, grid: SphereGrid, stride: int) -> None:
        super().__init__(inner)
        self.grid, self.stride = grid, stride
        self._height, few = grid.height, coarsen_grid(grid, stride)
        height, width = few.height, few.width
        # Rows past the last repeat it
        self._below = torch.arange(1, height + 1).clamp_max(height - 1)
        self._next = torch.arange(1, width + 1)
        # Across the seam of a full circle the first column follows the last.
        self._next[-1] = 0 if grid.periodic else width - 1
        self._between = torch.arange(stride) / stride

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; images (B, H, W) of the full grid."""
        result = self.inner.predict(query)
        return Prediction(self.upsample(result.mean), result.variance, result.unknown)

    def upsample(self, image: Tensor) -> Tensor:
        """Fill images (B, h, w) up to (B, H, W)."""
        beside = image.index_select(2, self._next)
        # (B, h, w, stride): flattened, the pixels filled in stand between their two columns.
        wide = torch.lerp(image[..., None], beside[..., None], self._between).flatten(2)
        below = wide.index_select(1, self._below)
        tall = torch.lerp(wide[:, :, None], below[:, :, None], self._between[:, None])
        # A height that the stride does not divide ends within the last step.
        return tall.flatten(1, 2)[:, : self._height]


class Blended(View):
    """A field's answer with a mean that another one's has a part in.

    Args:
        inner: answers for the field; its confidence and variance stay.
        other: what has the other mean.
        blend: makes one of the field's mean and the other.
    """

    def __init__(
        self,
        inner: Method,
        other: Callable[[Query], Prediction],
        blend: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        super().__init__(inner)
        self.other, self.blend = other, blend

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        result = self.inner.predict(query)
        mean = self.blend(result.mean, self.other(query).mean)
        return Prediction(mean, result.variance, result.unknown)


def average_with_process(
    own: Method, process: Method, blend: Callable[[Tensor, Tensor], Tensor]
) -> Method:
    """Return a reduced field averaged with as many pixels of the process.

    Interpolation is linear: the mean is taken on the coarse grid, and filled in once.

    Args:
        own: the field, reduced; `Interpolated` where it answers on a coarser grid.
        process: fitted.
        blend: makes one of the field's mean and the process's.
    """
    stride = own.stride if isinstance(own, Interpolated) else 1
    lean = process.reduce({"confidence": False, "stride": stride}, {})
    if isinstance(own, Interpolated) and isinstance(lean, Interpolated):
        return Interpolated(Blended(own.inner, lean.inner.predict, blend), own.grid, own.stride)
    return Blended(own, lean.predict, blend)
