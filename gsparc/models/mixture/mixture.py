"""Several solutions of one problem as one field: their weighed mean, and a process on what they leave."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.site_objects import SiteObjects
from gsparc.models.conditional import ConditionalField, LeftOutRows
from gsparc.models.method import Prediction


class Mixture(ConditionalField):
    """The weighed mean of members: no single one need be the right one.

    Args:
        members: at least one.
        weights: (M,) of the mean, of sum 1.
        residual: a field without Gaussians, of what the mean leaves of its rows, each predicted from the
            others; None: there is none.
        share: of the residual's mean in [0, 1].
    """

    def __init__(
        self,
        members: Sequence[ConditionalField],
        weights: Sequence[float] = (1.0,),
        residual: ConditionalField | None = None,
        share: float = 0.0,
    ) -> None:
        self.members = list(members)
        self.weights = tuple(float(weight) for weight in weights)
        self.residual, self.share = residual, float(share)
        if len(members) == 1:
            self.held = members[0].held

    def parts(self) -> Iterator[tuple[float, ConditionalField]]:
        """See `ConditionalField`."""
        for weight, one in zip(self.weights, self.members, strict=True):
            yield from ((weight * more, part) for more, part in one.parts())

    @property
    def count(self) -> int:
        """Gaussians of all members."""
        return sum(member.count for member in self.members)

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms of any member, and the residual."""
        more = () if self.residual is None else ("residual",)
        return tuple(dict.fromkeys([*(term for one in self.members for term in one.terms), *more]))

    def objects(self) -> SiteObjects:
        """Those of the heaviest member that found any."""
        result = [self.members[i].objects() for i in np.argsort(self.weights)[::-1]]
        return next((one for one in result if len(one)), result[0])

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Every member on the same rows, then the process on what they leave."""
        for member in self.members:
            member.condition(data, rows)
        if self.residual is not None:
            left = self._mean_left_out()
            self.residual.condition(residuals(left, data), left.rows)

    def __call__(self, query: Query) -> Prediction:
        """The mean of all; what they disagree about is added to their variances.

        The variance errs high by what the residual explains.
        """
        result = [member(query) for member in self.members]
        pairs = list(zip(self.weights, result, strict=True))
        mean = torch.stack([weight * one.mean for weight, one in pairs]).sum(0)
        spreads, shares = [], []
        for weight, one in pairs:
            assert one.variance is not None and one.unknown is not None
            apart = (one.mean - mean).abs().square().flatten(1).mean(1)
            spreads.append(weight * (one.variance + apart))
            shares.append(weight * one.unknown)
        parts = [weight * one.explained for weight, one in pairs if one.explained is not None]
        if self.residual is not None:
            mean = mean + self.share * self.residual(query).mean
        variance, unknown = (torch.stack(each).sum(0).to(mean.real.dtype) for each in (spreads, shares))
        return Prediction(mean, variance, unknown, torch.stack(parts).sum(0) if parts else None)

    def left_out(self) -> LeftOutRows:
        """The mean of all."""
        result = self._mean_left_out()
        if self.residual is None:
            return result
        return replace(result, mean=result.mean + self.share * self.residual.left_out().mean)

    def _mean_left_out(self) -> LeftOutRows:
        result = [member.left_out() for member in self.members]
        pairs = list(zip(self.weights, result, strict=True))
        mean = torch.stack([weight * one.mean for weight, one in pairs]).sum(0)
        variance = torch.stack([weight * one.variance for weight, one in pairs]).sum(0)
        return LeftOutRows(result[0].rows, mean, variance)

    def state(self) -> dict[str, Any]:
        """That of none: members are stored by their kinds."""
        return {"weights": list(self.weights), "share": self.share}


def residuals(left: LeftOutRows, data: Measurements) -> Measurements:
    """The measurements with what is left of rows, left out one by one, as targets."""
    target = np.zeros_like(data.target)
    target[left.rows] = data.target[left.rows] - left.mean.numpy().reshape(-1, *data.target.shape[1:])
    return replace(data, target=target)
