"""A fitted method as a field, so that it is weighed against other solutions of the same rows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.channels.complex_gp import ComplexGP
from gsparc.models.conditional import ConditionalField, LeftOutRows
from gsparc.models.method import Method, Prediction
from gsparc.training.context import FitContext


class MethodField(ConditionalField):
    """What a method found; it chooses its settings anew where it is conditioned.

    Args:
        method: fitted, or restored.

    Attributes:
        makes: class of the method.
    """

    makes: ClassVar[type[Method]]

    def __init__(self, method: Any) -> None:
        self.method, self.site = method, method.site

    @property
    def count(self) -> int:
        """Gaussians, of the largest search."""
        return self.method.size()

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`."""
        self.method.fit(data, Fold(rows, rows[:0], rows[:0]), FitContext())

    def __call__(self, query: Query) -> Prediction:
        """See `ConditionalField`; Gaussians explain all, where the method does not say otherwise."""
        result: Prediction = self.method.predict(query)
        said = result.explained is not None or not self.count
        return result if said else replace(result, explained=result.mean)

    def left_out(self) -> LeftOutRows:
        """Not known: `ValueError`."""
        raise ValueError(f"{self.kind}: rows left out are not kept")

    def state(self) -> dict[str, Any]:
        """The method's."""
        return {"method": self.method.state()}

    @classmethod
    def restored(cls, site: Site, state: dict[str, Any]) -> Self:
        """The field whose `state()` this was."""
        method = cls.makes()
        method.restore(site, state["method"])
        return cls(method)


class ProcessField(MethodField):
    """`gp` without any Gaussians, so that others are weighed against it on the same rows."""

    kind = "process"
    makes: ClassVar[type[Method]] = GaussianProcess
    count = 0  # type: ignore[assignment]
    terms = ("residual",)  # type: ignore[assignment]


class AlignedField(ProcessField):
    """`complex_gp` of rows that were turned to each other."""

    kind = "aligned"
    makes = ComplexGP
