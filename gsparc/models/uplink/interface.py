"""What all methods that read a fresh uplink share."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.models.method import Method, Prediction
from gsparc.physics.decibels import TINY_POWER


@runtime_checkable
class SeparatesPaths(Protocol):
    """Finds the propagation paths of an uplink."""

    def find_sources(self, uplink: Tensor) -> Any:
        """Return gains, delays and directions (B, N) of uplinks (B, U, L)."""

    def predict_from_uplink(
        self,
        uplink: Tensor,
        frequency_hz: Tensor,
        noise: Tensor | None = None,
        antennas: slice = slice(None),
    ) -> Prediction:
        """Return channels (B, A, K) of some antennas at frequencies (K,) [Hz]."""


def mean_power(channels: Tensor) -> Tensor:
    """Return the mean square (B,) of channels (B, antennas, tones), at least `TINY_POWER`."""
    return channels.abs().square().mean((1, 2)).clamp_min(TINY_POWER)


def root_mean_power(channels: Tensor) -> Tensor:
    """Return the root of the same."""
    return mean_power(channels).sqrt()


class UplinkMethod(Method):
    """A method that needs the snapshot's own uplink; a position alone is no question to it."""

    no_gradient = "predictions follow from an uplink, not from a position"

    def query_uplinks(self, query: Query) -> Tensor:
        """Return the uplinks (B, U, L) of a query.

        Raises:
            ValueError: there is none, or nothing was fitted.
        """
        self.require_fitted(self.site)
        if query.uplink is None:
            raise ValueError(
                f"{self.name}: reads a fresh uplink, and positions alone have none: uplink= is "
                "needed, or "
                "take model=gp"
            )
        return query.uplink

    def select_antennas(self, uplink: Tensor) -> Tensor:
        """Return those of uplinks (B, U, L) that are heard by the antennas that answer,
        (B, A, L).
        """
        return uplink[:, torch.from_numpy(np.asarray(self.fitted_site.antennas))]

    def _require_uplink(self, data: Measurements) -> Site:
        if not data.site.target.is_complex or data.uplink is None or data.site.antennas is None:
            raise ValueError(
                f"{self.name}: reads a fresh uplink, and {data.site.name} has none "
                "(dataset=argos does)"
            )
        return data.site
