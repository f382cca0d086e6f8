"""What some methods can do besides predicting, as protocols that a caller asks for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.site_objects import GaussianCloud

if TYPE_CHECKING:
    from gsparc.processes.powers import PowerProcess, PowerRows


@runtime_checkable
class HasProcess(Protocol):
    """A Gaussian process on powers says what it does not know."""

    def process(self) -> PowerProcess | None:
        """Return the process; None where what was fitted has none."""


@runtime_checkable
class HasMembers(Protocol):
    """A mean of several methods, which can do without some of them."""

    def members_data(self, data: Measurements) -> Measurements:
        """Return measurements as its members see them."""

    def keep_members(self, kept: Sequence[Any]) -> None:
        """Answer by these alone, at least one of its own."""


class JointLevels(NamedTuple):
    """Levels of k places or stations and their errors; tensors, or a `Predictor`'s arrays.

    Attributes:
        mean: (G, k) of measurements [dB].
        covariance: (G, k, k) [dB^2].
        noise: (k,) variance of a measurement's noise [dB^2].
    """

    mean: Any
    covariance: Any
    noise: Any


@runtime_checkable
class HasJoint(Protocol):
    """Levels of several stations, or at several places, with their covariance."""

    def predict_joint(self, moving: Tensor, stations: Tensor) -> JointLevels:
        """See `gsparc.models.powers.together.field.JointPowerField.predict_joint`."""
        ...

    def add_station(self, place: np.ndarray, sectors: Tensor, like: int | None = None) -> HasJoint:
        """See `gsparc.models.powers.together.field.JointPowerField.add_station`."""
        ...


@runtime_checkable
class AddsLinks(Protocol):
    """It learns from rows of stations at new places, with its settings as they are."""

    @property
    def linked_stations(self) -> list[int] | None:
        """Numbers of stations with rows; None: of others it cannot learn."""

    def add_links(self, rows: PowerRows) -> Any:
        """See `gsparc.models.powers.together.field.JointPowerField.add_links`."""


@runtime_checkable
class AddsCarriers(Protocol):
    """It answers at carriers that nobody measured."""

    def add_carrier(self, frequency_hz: float) -> Any:
        """Return the same method whose site has one station more; see `Stations.add_carrier`.

        Raises:
            ValueError: what was fitted here knows its own carriers alone.
        """


class QueryPaths(NamedTuple):
    """Paths to B places and A antennas of the moving end.

    Attributes:
        gain: (B, A, N) complex64 at the carrier, in stored units.
        delay: (B, A, N) float64 [s].
        unit: (B, N, 3) from the middle of the antennas to where a path comes from.
        carrier_hz: of the gains [Hz].
    """

    gain: Tensor
    delay: Tensor
    unit: Tensor
    carrier_hz: float


@runtime_checkable
class HasPaths(Protocol):
    """Its channels are sums of propagation paths."""

    def paths(self, query: Query) -> QueryPaths:
        """Return gains (B, A, N), delays (B, A, N) [s], directions (B, N, 3) of arrival,
        the carrier [Hz].

        Raises:
            ValueError: what was fitted here has none.
        """


@runtime_checkable
class HasGaussians(Protocol):
    """What it renders are Gaussians in space."""

    def gaussians(self, query: Query) -> GaussianCloud:
        """Return all of them, with what they emit: the root mean square over these queries.

        Raises:
            ValueError: what was fitted here has none.
        """
