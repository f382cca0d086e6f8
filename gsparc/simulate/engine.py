"""Protocol of all simulators: positions and switches in, paths out."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import Paths


@runtime_checkable
class HasTriangles(Protocol):
    """Its objects are triangles."""

    def triangles(self) -> np.ndarray:
        """(n, 3, 3) [m] of all objects."""


class Engine(Protocol):
    """A scene with one transmitter, ready to trace.

    Attributes:
        name: for provenance.
        transmitter: (3,) [m].
        wavelength: at the carrier [m].
        random: whether another seed gives another answer.
    """

    name: str
    transmitter: np.ndarray
    wavelength: float
    random: bool

    def supported(self, effects: Effects) -> Effects:
        """These switches without what the engine cannot compute."""

    def trace(self, receivers: np.ndarray, effects: Effects, seed: int | None = None) -> Paths:
        """Paths to receivers (R, 3) [m]; `seed` of the rays where there are any."""

    def thinned(self, samples: int) -> Engine:
        """The same with so many rays of a call, where there are any."""

    def versions(self) -> dict[str, str]:
        """Versions of the solver's packages."""

    def fingerprint(self) -> str:
        """Hash of the geometry, and of which material is where."""

    def materials(self) -> dict[str, dict[str, Any]]:
        """Material properties of the scene, for provenance and physical expectations."""
