"""Fields whose weights are known in closed form once Gaussians and covariances are: conditioned on rows.

What is learned by gradient are places, sizes and covariance parameters; the weights follow from the training
rows as in a Gaussian process (Rasmussen and Williams 2006, section 2.2), of which such a field is one: its
covariance is a sum of terms, one of them the Gaussians'. Without Gaussians it is the plain process.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.ops import Pose
from gsparc.processes.conditioned import Conditioned


@dataclass(frozen=True)
class Posterior:
    """What a field says about B queries, in the units of the stored targets.

    Attributes:
        mean: (B, ...) of all terms.
        variance: (B,) float32, expected squared error per entry of the mean.
        explained: (B, ...) the share of the mean that its Gaussians predict; None where it has none.
        unknown: (B,) float32 in [0, 1], the posterior's variance relative to the prior's; 1 far away.
    """

    mean: Tensor
    variance: Tensor
    explained: Tensor | None
    unknown: Tensor


@dataclass(frozen=True)
class LeftOutRows:
    """Training rows predicted from all others (Rasmussen and Williams 2006, eq. 5.12).

    Attributes:
        rows: (n,) of the measurements.
        mean: (n, ...) predictions, stored units.
        variance: (n,) expected squared error per entry.
    """

    rows: np.ndarray
    mean: Tensor
    variance: Tensor


class ConditionalField(nn.Module, ABC):
    """Parameters by gradient, weights in closed form.

    `parameters()` are what gradient steps move; `condition` sets everything else.

    Attributes:
        kind: the initialiser that makes it, see `gsparc.models.fields.INITIALISERS`; none of composed ones.
        site: what the dataset declares; set where the field is made.
        held: rows of groups, predicted by searches that left their group out; None where none did.
        rates: Adam's rate by the beginning of a parameter's name; what is not named has `RATE`.
    """

    kind: ClassVar[str] = ""
    site: Site
    held: LeftOutRows | None = None
    reads_rows: ClassVar[bool] = False  # whether `answer` knows more than `forward`
    RATE: ClassVar[float] = 0.01  # of logarithms of lengths and variances
    rates: ClassVar[dict[str, float]] = {}

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of Gaussians; 0 where the residual process is all there is."""

    @property
    def forgets(self) -> bool:
        """Whether `condition` on other rows leaves nothing of earlier ones but a few parameters."""
        return False

    @property
    @abstractmethod
    def terms(self) -> tuple[str, ...]:
        """Terms that are computed, as in `model.effects`: `phase`, `power`, `residual` and so on."""

    @abstractmethod
    def loss(self, batch: Batch) -> Tensor:
        """Loss per row (B,), differentiable in the parameters.

        The negative log density [nats per real entry] of each row given the others of the batch: the
        leave-one-out predictive density.
        """

    @abstractmethod
    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Set the weights from rows (n,) with the parameters as they are; no gradients."""

    @abstractmethod
    def forward(self, tx: Tensor, rx: Pose) -> Posterior:
        """Answer at tx (B, 3) [m] and one shared or B receiver poses, local coordinates."""

    def answer(self, batch: Batch) -> Posterior:
        """Answer rows, whose stations and runs may matter."""
        found: Posterior = self(batch.tx, batch.rx)
        return found

    def objects(self) -> SiteObjects:
        """What it found to stand in the site."""
        return SiteObjects.of()

    @abstractmethod
    def left_out(self) -> LeftOutRows:
        """The rows it was conditioned on, each predicted from the others."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Tensors, numbers and strings from which it is made again."""


class StackedField(ConditionalField):
    """Several solutions of one problem, averaged: no single one need be the right one.

    Args:
        members: at least one.
        weights: (M,) of the mean, of sum 1.
    """

    def __init__(self, members: Sequence[ConditionalField], weights: Sequence[float]) -> None:
        super().__init__()
        self.members: nn.ModuleList = nn.ModuleList(members)
        self.weights = tuple(float(weight) for weight in weights)

    @property
    def count(self) -> int:
        """Gaussians of all members."""
        return sum(member.count for member in self._fields())

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms of any member."""
        return tuple(dict.fromkeys(term for member in self._fields() for term in member.terms))

    @property
    def heaviest(self) -> ConditionalField:
        """The member of largest weight."""
        return self._fields()[int(np.argmax(self.weights))]

    def objects(self) -> SiteObjects:
        """Those of the heaviest member that found any."""
        found = [self._fields()[i].objects() for i in np.argsort(self.weights)[::-1]]
        return next((one for one in found if len(one)), found[0])

    def _fields(self) -> list[ConditionalField]:
        return list(self.members)  # type: ignore[arg-type]

    def loss(self, batch: Batch) -> Tensor:
        """Weighted losses of those members that have parameters."""
        learning = [(w, m) for w, m in zip(self.weights, self._fields(), strict=True) if learns(m)]
        return torch.stack([weight * member.loss(batch) for weight, member in learning]).sum(0)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Every member on the same rows."""
        for member in self._fields():
            member.condition(data, rows)

    def forward(self, tx: Tensor, rx: Pose) -> Posterior:
        """The mean of all; what they disagree about is added to their variances."""
        found = [member(tx, rx) for member in self._fields()]
        pairs = list(zip(self.weights, found, strict=True))
        mean = sum(weight * one.mean for weight, one in pairs)
        assert isinstance(mean, Tensor)
        apart = [(one.mean - mean).abs().square().flatten(1).mean(1) for one in found]
        variance = sum(w * (one.variance + a) for (w, one), a in zip(pairs, apart, strict=True))
        parts = [weight * one.explained for weight, one in pairs if one.explained is not None]
        explained = torch.stack(parts).sum(0) if parts else None
        unknown = sum(weight * one.unknown for weight, one in pairs)
        assert isinstance(variance, Tensor) and isinstance(unknown, Tensor)
        return Posterior(mean, variance.float(), explained, unknown.float())

    def left_out(self) -> LeftOutRows:
        """The mean of all."""
        found = [member.left_out() for member in self._fields()]
        pairs = list(zip(self.weights, found, strict=True))
        mean = torch.stack([weight * one.mean for weight, one in pairs]).sum(0)
        variance = torch.stack([weight * one.variance for weight, one in pairs]).sum(0)
        return LeftOutRows(found[0].rows, mean, variance)

    def state(self) -> dict[str, Any]:
        """That of none: members are stored by their kinds."""
        return {"weights": list(self.weights)}


class CompletedField(ConditionalField):
    """A field, and a process on what it leaves of its rows, each predicted from the others.

    Args:
        field: explains what it can.
        residual: a field without Gaussians.
        weight: of the residual's mean in [0, 1].
    """

    def __init__(self, field: ConditionalField, residual: ConditionalField, weight: float) -> None:
        super().__init__()
        self.field, self.residual, self.weight = field, residual, float(weight)
        self.held = field.held

    @property
    def count(self) -> int:
        """Gaussians of the field."""
        return self.field.count

    @property
    def terms(self) -> tuple[str, ...]:
        """The field's, and the residual."""
        return (*self.field.terms, "residual")

    def objects(self) -> SiteObjects:
        """The field's."""
        return self.field.objects()

    def loss(self, batch: Batch) -> Tensor:
        """The field's; the residual's settings follow from its likelihood."""
        return self.field.loss(batch)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """The field on the rows, then the process on their residuals."""
        self.field.condition(data, rows)
        self.residual.condition(residuals(self.field, data), self.field.left_out().rows)

    def forward(self, tx: Tensor, rx: Pose) -> Posterior:
        """The sum; the variance errs high by what the residual explains."""
        found, more = self.field(tx, rx), self.residual(tx, rx)
        return Posterior(found.mean + self.weight * more.mean, found.variance, found.explained, found.unknown)

    def left_out(self) -> LeftOutRows:
        """The sum of both."""
        found, more = self.field.left_out(), self.residual.left_out()
        return LeftOutRows(found.rows, found.mean + self.weight * more.mean, found.variance)

    def state(self) -> dict[str, Any]:
        """That of neither: parts are stored by their kinds."""
        return {"weight": self.weight}


def learns(field: nn.Module) -> bool:
    """Whether there is anything that gradient steps move."""
    return any(parameter.requires_grad for parameter in field.parameters())


def residuals(field: ConditionalField, data: Measurements) -> Measurements:
    """The measurements with what a conditioned field leaves of its rows, left out one by one, as targets."""
    left = field.left_out()
    target = np.zeros_like(data.target)
    target[left.rows] = data.target[left.rows] - left.mean.numpy().reshape(-1, *data.target.shape[1:])
    return replace(data, target=target)


def leave_one_out_density(covariance: Tensor, target: Tensor) -> Tensor:
    """Negative log density (n,) [nats per real entry] of each row given the others.

    Rasmussen and Williams (2006), eq. 5.10 to 5.12; circular where complex; up to a constant.

    Args:
        covariance: (n, n) real or complex, noise included.
        target: (n, R).
    """
    residual, variance = Conditioned.of(covariance, target).left_out()
    return (residual.abs().square() / variance[:, None] + variance.log()[:, None]).mean(1) / 2
