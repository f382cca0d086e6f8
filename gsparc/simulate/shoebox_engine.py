"""Exact image sources as an engine: line of sight and mirror reflections."""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np

from gsparc.data.schema import LIGHT
from gsparc.simulate.effects import SPECULAR, Effects
from gsparc.simulate.paths import Paths
from gsparc.simulate.shoebox import Room, images, visible


class ShoeboxEngine:
    """A shoebox room with one transmitter.

    Args:
        room: walls and absorbing boxes.
        transmitter: (3,) [m].
        carrier_hz: [Hz].
    """

    name = "gsparc-shoebox"
    random = False

    def __init__(self, room: Room, transmitter: np.ndarray, carrier_hz: float) -> None:
        self.room = room
        self.transmitter = np.asarray(transmitter, dtype=np.float64)
        self.wavelength = LIGHT / carrier_hz
        if not room.contains(self.transmitter):
            raise ValueError(f"scene.transmitter_m={self.transmitter.tolist()}: outside the room or in a box")

    def supported(self, effects: Effects) -> Effects:
        """Line of sight and specular reflection; walls do not transmit, edges do not diffract."""
        return replace(
            effects.without("diffuse", "diffraction", "refraction"),
            polarisation=False,
            depth=effects.depth if effects.specular else 0,
        )

    def trace(self, receivers: np.ndarray, effects: Effects, seed: int | None = None) -> Paths:
        """Paths to receivers (R, 3) [m]; there are no rays, so no seed matters."""
        mirrored = images(self.room, effects.depth)
        seen = visible(self.room, mirrored, self.transmitter[None], receivers)
        if not effects.line_of_sight:
            seen[:, mirrored.order == 0] = False
        way = mirrored.of(self.transmitter) - receivers[:, None]
        distance = np.linalg.norm(way, axis=-1)
        delay = np.where(seen, distance / LIGHT, np.inf)
        rank = np.argsort(delay, axis=1, kind="stable")
        rows = np.arange(len(receivers))[:, None]
        kept = seen[rows, rank]
        gain = (mirrored.gain * self.wavelength / (4 * np.pi * distance))[rows, rank][kept]
        order = np.broadcast_to(mirrored.order, seen.shape)[rows, rank][kept].astype(np.uint8)
        return Paths(
            np.concatenate([[0], np.cumsum(seen.sum(1))]),
            gain[:, None].astype(np.complex64),
            delay[rows, rank][kept],
            (way / distance[..., None])[rows, rank][kept].astype(np.float32),
            np.where(order > 0, SPECULAR, 0).astype(np.uint8),
            order,
        )

    def thinned(self, samples: int) -> ShoeboxEngine:
        """Itself: there are no rays."""
        return self

    def fingerprint(self) -> str:
        """Of the room."""
        return sha256(repr(self.room).encode()).hexdigest()

    def versions(self) -> dict[str, str]:
        """Part of this package."""
        return {}

    def materials(self) -> dict[str, dict[str, Any]]:
        """Amplitude reflection coefficients of the walls."""
        return {f"wall{i}": {"reflection": abs(complex(r))} for i, r in enumerate(self.room.reflection)}
