"""Views of a method that knows all stations: asked about one of them, or about all at once."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsparc.data.query import Query
from gsparc.models.abilities import HasJoint
from gsparc.models.method import Method, Prediction
from gsparc.models.reduced import View


class OneStationView(View):
    """A method that knows all stations, asked about one: several may stand at one place."""

    def __init__(self, inner: Method, number: int) -> None:
        super().__init__(inner)
        self.number = number

    def joint_method(self) -> HasJoint | None:
        """See `Method.joint_method`."""
        method = getattr(self.inner, "member", None)
        return method if isinstance(method, HasJoint) else None

    def gradient_problem(self) -> str | None:
        """Return that of all stations."""
        return self.inner.gradient_problem()

    def of_station(self, query: Query) -> Query:
        """Return a query as the inner method is asked."""
        return replace(query, station=torch.full((len(query),), self.number))

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        return self.inner.predict(self.of_station(query))


class AnywhereView(View):
    """A method that knows all stations, asked about whoever stands where a query says."""

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        return self.inner.predict(replace(query, station=None))
