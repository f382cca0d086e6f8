"""The protocol of simulators; every pair of a receiver and a transmitter of one scene:
the rows of a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np

from gsparc.data.georeference import Georeference
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import TracedPaths, join_receivers
from gsparc.simulate.scenes.receivers import choose_farthest_rows


@dataclass(frozen=True)
class Survey:
    """Row `t * R + r` is receiver r with transmitter t.

    Attributes:
        engines: (T,) one per transmitter, of the same scene.
        places: (R, 3) float64 [m] receivers, world.
        names: (T,) of the transmitters.
        time_s: (R,) when a receiver was at its place; None where that has no meaning.
        georeference: of the world's origin; None where the scene is nowhere on Earth.
    """

    engines: Sequence[TracingEngine]
    places: np.ndarray
    names: tuple[str, ...] = ("tx",)
    time_s: np.ndarray | None = None
    georeference: Georeference | None = None

    def __len__(self) -> int:
        return len(self.engines) * len(self.places)

    @property
    def engine(self) -> TracingEngine:
        """Return that of the first transmitter, for what all share."""
        return self.engines[0]

    @property
    def transmitters(self) -> np.ndarray:
        """Return places (T, 3) [m]."""
        return np.stack([engine.transmitter for engine in self.engines])

    @property
    def station(self) -> np.ndarray:
        """Return the transmitter (S,) of each row."""
        return np.repeat(np.arange(len(self.engines)), len(self.places))

    @property
    def receivers(self) -> np.ndarray:
        """Return the receiver's place (S, 3) [m] of each row."""
        return np.tile(self.places, (len(self.engines), 1))

    def with_samples(self, samples: int) -> Survey:
        """Return the same with so many rays of a call."""
        return replace(self, engines=[engine.with_samples(samples) for engine in self.engines])

    def choose_distant_rows(self, count: int, seed: int) -> np.ndarray:
        """Choose at most `count` rows far apart, transmitters by turns."""
        order, turns = (
            choose_farthest_rows(self.places, min(count, len(self.places)), seed),
            len(self.engines),
        )
        # Place i with transmitter i, then every place with the next one: all have their turn.
        rounds = [
            order + (np.arange(len(order)) + shift) % turns * len(self.places)
            for shift in range(turns)
        ]
        return np.concatenate(rounds)[:count]

    def trace(self, rows: np.ndarray, effects: Effects, seed: int | None = None) -> TracedPaths:
        """Trace paths of rows (n,), in their order."""
        owner, place = np.divmod(rows, len(self.places))
        # Stable: rows of a transmitter stay in the order in which they are traced.
        order = np.argsort(owner, kind="stable")
        parts = [
            self.engines[t].trace(self.places[place[owner == t]], effects, seed)
            for t in np.unique(owner)
        ]
        return join_receivers(parts).select_receivers(np.argsort(order, kind="stable"))


class TracingEngine(Protocol):
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

    def trace(
        self, receivers: np.ndarray, effects: Effects, seed: int | None = None
    ) -> TracedPaths:
        """Trace paths to receivers (R, 3) [m]; `seed` of the rays where there are any."""

    def materials(self) -> dict[str, dict[str, Any]]:
        """Return material properties of the scene, for provenance and physical expectations."""

    def supported_effects(self, effects: Effects) -> Effects:
        """Return these switches without what the engine cannot compute."""
        return effects

    def with_samples(self, samples: int) -> Self:
        """Return the same with so many rays of a call, where there are any."""
        return self

    def package_versions(self) -> dict[str, str]:
        """Return versions of the solver's packages."""
        return {}

    def triangles(self) -> np.ndarray:
        """Return triangles (n, 3, 3) [m] of all objects, where they have any."""
        return np.zeros((0, 3, 3))
