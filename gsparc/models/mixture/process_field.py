"""The plain process on whole targets as a field, so that others are weighed against it on the same rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.ops import Pose
from gsparc.training.conditional import ConditionalField, LeftOutRows, Posterior
from gsparc.training.context import FitContext, FitReport


class ProcessField(ConditionalField):
    """`gp` without any Gaussians; nothing in it is learned by gradient.

    Args:
        method: fitted, or restored.
    """

    kind = "process"

    def __init__(self, method: GaussianProcess) -> None:
        super().__init__()
        assert method.site is not None
        self.method, self.site = method, method.site

    @property
    def count(self) -> int:
        """None."""
        return 0

    @property
    def terms(self) -> tuple[str, ...]:
        """The process alone."""
        return ("residual",)

    def loss(self, batch: Batch) -> Tensor:
        """Of nothing that could be learned: `ValueError`."""
        raise ValueError("process: it has nothing that gradient steps move")

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Its settings are chosen anew: they follow from the rows."""
        self.method.fit(data, Fold(rows, rows[:0], rows[:0]), FitContext())

    def forward(self, tx: Tensor, rx: Pose) -> Posterior:
        """See `ConditionalField`."""
        found = self.method.predict(tx, rx)
        assert found.confidence is not None and found.variance is not None
        return Posterior(found.mean, found.variance, None, 1 - found.confidence)

    def left_out(self) -> LeftOutRows:
        """Not known: `ValueError`."""
        raise ValueError("process: rows left out are not kept")

    def state(self) -> dict[str, Any]:
        """That of the method."""
        return {"method": self.method.state()}


def initialise(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """The process on rows (n,); `init` and `clutter` mean nothing to it."""
    method = GaussianProcess()
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    return ProcessField(method), report


def restored(site: Site, state: dict[str, Any]) -> ProcessField:
    """The field whose `state()` this was."""
    method = GaussianProcess()
    method.restore(site, state["method"])
    return ProcessField(method)
