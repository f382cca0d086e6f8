"""From the config group `scene` to an engine and receiver positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.instantiate import known_keys
from gsparc.simulate.engine import Engine
from gsparc.simulate.raytracer import RayTracer, Sampling
from gsparc.simulate.scenes.conference import conference_room
from gsparc.simulate.scenes.placement import clear_of, place
from gsparc.simulate.shoebox import Room
from gsparc.simulate.shoebox_engine import ShoeboxEngine
from gsparc.simulate.survey import Survey

BUILDERS = {"conference_room": conference_room}
CLEARANCE = 0.1  # [m] of receivers from any surface of a scene that comes as a file


@dataclass(frozen=True)
class SceneSettings:
    """One scene, chosen by exactly one of `builder`, `builtin`, `xml`, `room`.

    Attributes:
        name: of the dataset.
        transmitter_m: (3,) [m].
        area_m: [[x, y], [x, y]] lower and upper corner of where receivers are [m].
        height_m: lowest and highest height of a receiver [m].
        num_receivers: how many.
        test_share: of them held out for testing, drawn at random.
        carrier_hz, bandwidth_hz, subcarriers: the band; subcarriers from end to end [Hz].
        builder: a procedure of ours (`conference_room`).
        builtin: a scene that comes with Sionna.
        xml: a Mitsuba or Sionna scene file.
        room: of the shoebox engine: size_m, reflection (one number or six), boxes_m.
        open_sky: receivers stand where nothing is above them.
        scattering: scattering coefficient of all materials without one; None: by material.
        seed: of the procedure and of the receivers.
    """

    name: str
    transmitter_m: tuple[float, float, float]
    area_m: tuple[tuple[float, float], tuple[float, float]]
    height_m: tuple[float, float]
    num_receivers: int
    carrier_hz: float
    bandwidth_hz: float
    subcarriers: int
    test_share: float = 0.3
    builder: str | None = None
    builtin: str | None = None
    xml: str | None = None
    room: Mapping[str, Any] | None = None
    open_sky: bool = False
    scattering: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        named = [k for k in ("builder", "builtin", "xml", "room") if getattr(self, k) is not None]
        if len(named) != 1:
            found = ", ".join(named) or "none"
            raise ValueError(f"scene: give exactly one of builder, builtin, xml, room; got {found}")
        if self.num_receivers < 20:
            raise ValueError(f"scene.num_receivers={self.num_receivers}: expected at least 20")
        if not (self.carrier_hz > 0 and self.bandwidth_hz >= 0 and self.subcarriers >= 1):
            raise ValueError("scene: carrier_hz is positive, bandwidth_hz at least 0, subcarriers at least 1")
        if not 0 < self.test_share < 1:
            raise ValueError(f"scene.test_share={self.test_share}: expected a share between 0 and 1")

    @property
    def frequency_hz(self) -> np.ndarray:
        """Subcarriers (K,) [Hz], about the carrier."""
        if self.subcarriers == 1:
            return np.array([self.carrier_hz])
        return self.carrier_hz + np.linspace(-0.5, 0.5, self.subcarriers) * self.bandwidth_hz


def from_config(config: Mapping[str, Any]) -> SceneSettings:
    """Settings from the config group `scene`.

    Raises:
        ValueError: a setting that does not exist or cannot be.
    """
    return SceneSettings(**known_keys(config, SceneSettings, "scene", "setting"))


def build(scene: SceneSettings, sampling: Sampling) -> Survey:
    """The scene with its transmitters, and receivers.

    Raises:
        ValueError: no such scene, or no place for the receivers.
        SimulatorMissing: the scene needs Sionna and it is not here.
    """
    engine, allowed = _engine(scene, sampling)
    receivers = place(scene.num_receivers, np.array(scene.area_m), scene.height_m, allowed, scene.seed)
    return Survey([engine], receivers)


def _engine(scene: SceneSettings, sampling: Sampling) -> tuple[Engine, Callable[[np.ndarray], np.ndarray]]:
    transmitter = np.array(scene.transmitter_m, dtype=np.float64)
    if scene.room is not None:
        boxes = np.array(scene.room.get("boxes_m") or np.zeros((0, 2, 3)), dtype=np.float64)
        reflection = np.array(scene.room.get("reflection", -0.7), dtype=np.complex128)
        room = Room.uniform(scene.room["size_m"], reflection, occluders=boxes)
        return ShoeboxEngine(room, transmitter, scene.carrier_hz), room.contains
    if scene.builder is not None:
        if scene.builder not in BUILDERS:
            raise ValueError(f"scene.builder={scene.builder}: expected one of {', '.join(BUILDERS)}")
        solids = BUILDERS[scene.builder](scene.seed)
        return RayTracer(solids, transmitter, scene.carrier_hz, sampling, scene.scattering), clear_of(solids)
    source: str | Path = scene.builtin if scene.builtin is not None else Path(str(scene.xml))
    tracer = RayTracer(source, transmitter, scene.carrier_hz, sampling, scene.scattering)

    def allowed(points: np.ndarray) -> np.ndarray:
        free = tracer.clear_of_surfaces(points, CLEARANCE)
        return free & tracer.under_open_sky(points) if scene.open_sky else free

    return tracer, allowed
