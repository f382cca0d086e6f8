"""Sources that a moving array sees as the Gaussians of a field: places by gradient, powers in closed form.

A Gaussian here is a source at the place where bearings from many receivers cross; what steps of gradient move
are the places. Powers, their trends over the receiver's place and the residual process follow from the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.models.method_field import MethodField
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.ops import Pose
from gsparc.training.conditional import LeftOutRows, Posterior

LEAST_POWER = 1e-6  # of a pixel in the loss: a square root has no slope at zero


class BearingField(MethodField):
    """The sources of one or several searches.

    A transmitter whose place is known stays there; its images and all others are parameters.

    Args:
        method: fitted, or restored.
        rows: (n,) of the measurements it was fitted on, in its order; none where it was restored.
    """

    kind = "bearings"
    makes = MovingArrayField
    rates: ClassVar[dict[str, float]] = {"places": 0.01}  # [m]

    def __init__(self, method: MovingArrayField, rows: Sequence[int] | np.ndarray = ()) -> None:
        super().__init__(method)
        self.rows = np.asarray(rows, np.int64)
        self._fixed = 0 if self.site.static_position is None else 1
        self.places = nn.ParameterList([trend.sources[self._fixed :].clone() for trend in method.trends])

    @property
    def terms(self) -> tuple[str, ...]:
        """Sources seen through the array, and a residual where one is fitted."""
        return ("moving_array", "residual") if len(self.method.residual.axes) else ("moving_array",)

    def _sources(self) -> list[Tensor]:
        """Places (K, 3) [m] of every search, the transmitter's first where it is known."""
        pairs = zip(self.method.trends, self.places, strict=True)
        return [torch.cat([trend.sources[: self._fixed], free]) for trend, free in pairs]

    def loss(self, batch: Batch) -> Tensor:
        """Negative log density (B,) [nats per pixel] of images rendered from the sources alone.

        The powers of a row are those that the trends predict from all other rows it was conditioned on, so
        that a source gains nothing from a place that explains this row only; they are constants here, as is
        the variance, the left-out mean square error of the sources' images.
        """
        self._need_rows()
        where = batch.rx.position.reshape(-1, 3).expand(len(batch), 3)
        array, images = self.method.array(), []
        for sources, power in zip(self._sources(), self._powers(batch.index.numpy(), where), strict=True):
            images.append(array.render(sources, where, power, LEAST_POWER))
        missed = (torch.stack(images).mean(0) - batch.target).square()
        if batch.mask is not None:
            missed = torch.where(batch.mask, missed, 0.0)
        variance = self.method.trend_error
        return (missed.mean((1, 2)) / variance + np.log(variance)) / 2

    @torch.no_grad()
    def _powers(self, index: np.ndarray, where: Tensor) -> list[Tensor]:
        """Powers (B, K) per search that the others predict of rows (B,) at places (B, 3) [m]."""
        order = np.argsort(self.rows)
        slot = np.searchsorted(self.rows, index, sorter=order).clip(max=len(order) - 1)
        position = torch.from_numpy(order[slot])
        known = torch.from_numpy(self.rows[order[slot]] == index)[:, None]
        far = torch.cdist(where, torch.from_numpy(self.method.positions).float())
        pairs = zip(self.method.trends, self.method.left_powers, strict=True)
        return [torch.where(known, left[position], trend.powers(far)) for trend, left in pairs]

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; kernels stay those of the search."""
        self.rows = self.method.condition(data, rows, [sources.detach() for sources in self._sources()])

    def forward(self, tx: Tensor, rx: Pose) -> Posterior:
        """See `ConditionalField`; without gradients."""
        return self.method.posterior(tx, rx)

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`."""
        self._need_rows()
        return self.method.left_out(self.rows)

    def _need_rows(self) -> None:
        """`ValueError` where a restored field was not conditioned again: left-out rows are not stored."""
        if not len(self.rows):
            raise ValueError(
                "bearings: condition the field on rows first, a stored one has none to leave out"
            )

    def state(self) -> dict[str, Any]:
        """The method's, and the places."""
        return {**super().state(), "places": [place.detach() for place in self.places]}

    @classmethod
    def restored(cls, site: Site, state: dict[str, Any]) -> Self:
        """The field whose `state()` this was; it answers, and can be conditioned again."""
        field = super().restored(site, state)
        for place, stored in zip(field.places, state["places"], strict=True):
            place.data.copy_(stored)
        return field
