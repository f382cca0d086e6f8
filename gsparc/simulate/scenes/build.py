"""From the config group `scene` to transmitters and receivers in a scene, ready to trace."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.instantiate import from_settings
from gsparc.data.ends import SAME_PLACE_M
from gsparc.data.georeference import Georeference
from gsparc.data.walls import SIZE, RoomSettings
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.sampling import Sampling
from gsparc.simulate.scenes.osm import Town, read_town
from gsparc.simulate.scenes.receivers import Ground, make_clearance_test, place_receivers
from gsparc.simulate.scenes.settings import (
    BUILDERS,
    MIN_RECEIVERS,
    SceneSettings,
    from_config,
    move_solids,
    read_moves,
)
from gsparc.simulate.scenes.solid import box
from gsparc.simulate.scenes.transmitters import ISOTROPIC, Transmitter, place_transmitters
from gsparc.simulate.shoebox import Room, ShoeboxEngine
from gsparc.simulate.survey import Survey, TracingEngine

log = logging.getLogger(__name__)

CLEARANCE = 0.1  # [m] of receivers from any surface of a scene that comes as a file
WIDEST_M = 400.0  # of an area that nobody states
MAST_M = 10.0  # height of a transmitter that nobody states, above what stands in the middle
CEILING = 0.85  # and its share of the height of a closed room


def build_survey(scene: SceneSettings, sampling: Sampling) -> Survey:
    """Build the scene with its transmitters and receivers.

    Raises:
        ValueError: no such scene, or no place for the receivers.
        SimulatorMissing: the scene needs Sionna and it is not here.
    """
    if scene.room is not None:
        return _shoebox(scene)
    # Receivers are those of the scene before: what stands there now would shift all draws.
    tracer, town, allowed = _load(replace(scene, moved=()), sampling)
    for note in () if town is None else town.notes:
        log.info("%s: %s", scene.file, note)
    area = _area(scene, tracer.bounding_box()[:, :2] if town is None else town.box)
    ground = _around(scene, tracer, area) if allowed is None else Ground(allowed)
    georeference = None if town is None else town.georeference
    # Heights of masts count from the highest surface, a roof where there is one.
    masts = _stated(scene, tracer.surface_height, georeference) or [
        _in_the_middle(tracer, ground, area)
    ]
    placed = place_receivers(scene, area, ground, town)
    if scene.moved:
        tracer, _, allowed = _load(scene, sampling)
        assert allowed is not None
        placed = placed.subset(allowed(placed.places))
    # Copies that share the scene, which is loaded once.
    engines = [tracer.with_transmitter(mast.position, mast.antenna) for mast in masts]
    return Survey(engines, placed.places, tuple(m.name for m in masts), placed.time_s, georeference)


def known_scene(
    stated: str | None, provenance: Mapping[str, str], carrier_hz: float
) -> SceneSettings:
    """Return the scene that measurements were made in.

    Args:
        stated: the name of a scene that comes with Sionna or is built here, or the path of an
            extract of OpenStreetMap (*.osm) or of a scene file (*.xml); None: the one that the
            provenance names.
        provenance, carrier_hz: of the measurements; materials are taken at that carrier [Hz].

    Raises:
        ValueError: no scene is known, or not one that a ray tracer loads.
    """
    if stated is None:
        if not has_known_scene(provenance):
            raise ValueError(
                "the data name no scene of triangles; say model.scene=NAME, TOWN.osm or SCENE.xml"
            )
        scene = from_config(json.loads(provenance["scene"]))
    else:
        suffix = Path(stated).suffix.lower()
        builtin = "builder" if stated in BUILDERS else "builtin"
        source: dict[str, Any] = {{".osm": "file", ".xml": "xml"}.get(suffix, builtin): stated}
        # Receivers and band are formal here: the scene alone is loaded.
        scene = SceneSettings(stated, MIN_RECEIVERS, carrier_hz, 0.0, 1, **source)
    for path in (scene.file, scene.xml):
        if path is not None and not Path(path).is_file():
            raise ValueError(f"the scene's file {path} is not here; name it with model.scene=FILE")
    # Permittivities depend on the carrier (ITU-R P.2040).
    return replace(scene, carrier_hz=carrier_hz)


def has_known_scene(provenance: Mapping[str, str]) -> bool:
    """Tell whether measurements come out of a scene that a ray tracer loads."""
    try:
        return json.loads(provenance["scene"])["room"] is None
    except (KeyError, TypeError, ValueError):
        return False


def load_tracer(
    scene: SceneSettings, sampling: Sampling, transmitter: np.ndarray, name: str
) -> RayTracer:
    """Return the scene alone, to be traced from a place (3,)
    [m] with the antenna that it states there.

    Of several there, sectors of a mast, it is the one that `name` ends with;
    without one an isotropic one.

    Raises:
        ValueError, SimulatorMissing: see `build_survey`.
    """
    tracer, town, _ = _load(scene, sampling)
    masts = _stated(scene, tracer.surface_height, None if town is None else town.georeference) or []
    masts_there = [
        mast for mast in masts if np.linalg.norm(mast.position - transmitter) < SAME_PLACE_M
    ]
    called = [mast for mast in masts_there if name.endswith(mast.name)]
    return tracer.with_transmitter(
        transmitter, next((mast.antenna for mast in called or masts_there), ISOTROPIC)
    )


def _shoebox(scene: SceneSettings) -> Survey:
    """Our own exact image sources, whose transmitters are isotropic."""
    stated = from_settings(RoomSettings, scene.room or {}, "scene.room")
    SIZE.check("scene.room.size_m", stated.size_m)
    size, reflection = np.array(stated.size_m, float), np.array(stated.reflection, complex)
    boxes = [box(f"box{k}", "", *corners) for k, corners in enumerate(stated.boxes)]
    before, after = (
        Room.from_size(
            size,
            reflection,
            occluders=np.array([solid.keep_out for solid in each]).reshape(-1, 2, 3),
        )
        for each in (boxes, move_solids(boxes, read_moves(scene.moved))[0])
    )
    area = _area(scene, np.stack([before.lower, before.upper])[:, :2])
    middle = np.append(area.mean(0), CEILING * before.upper[2])
    masts = _stated(scene, None, None) or [Transmitter("tx", middle)]
    if any(mast.antenna.pattern != "iso" for mast in masts):
        raise ValueError(
            "scene.transmitters: a shoebox room knows isotropic antennas alone; pattern=iso"
        )
    engines: list[TracingEngine] = [
        ShoeboxEngine(after, mast.position, scene.carrier_hz) for mast in masts
    ]
    placed = place_receivers(scene, area, Ground(before.contains))
    placed = placed.subset(after.contains(placed.places))
    return Survey(engines, placed.places, tuple(mast.name for mast in masts), placed.time_s)


def _load(
    scene: SceneSettings, sampling: Sampling
) -> tuple[RayTracer, Town | None, Callable[[np.ndarray], np.ndarray] | None]:
    """The ray tracer, what a map holds, and a test of free places where objects know
    where nobody stands.
    """
    source: Any = scene.builtin if scene.builtin is not None else Path(str(scene.xml))
    town, allowed, moves = None, None, read_moves(scene.moved)
    if scene.file is not None:
        town = read_town(scene.file, scene.carrier_hz)
        source = town.solids
    elif scene.builder is not None:
        source = BUILDERS[scene.builder](scene.seed)
        # Rooms of ours know their boxes; of other scenes rays have to tell where something stands.
        allowed = make_clearance_test(source)
    if moves:
        if isinstance(source, str | Path):
            raise ValueError(
                "moved: objects of scenes that come as a file stand as they are; of our own they "
                "move"
            )
        source, changed = move_solids(source, moves)
        allowed = make_clearance_test(changed)
    # At the origin for the time being: `with_transmitter` puts a copy at each transmitter.
    return (
        RayTracer(source, np.zeros(3), scene.carrier_hz, sampling, scene.scattering),
        town,
        allowed,
    )


def _area(scene: SceneSettings, box: np.ndarray) -> np.ndarray:
    """(2, 2) [m] where receivers are."""
    if scene.area_m is not None:
        return np.array(scene.area_m, dtype=np.float64)
    middle, half = box.mean(0), np.minimum(np.ptp(box, axis=0), WIDEST_M) / 2
    area = np.round(np.stack([middle - half, middle + half]), 1)
    log.info("no scene.area_m: %s m taken, the middle of the scene", area.tolist())
    return area


def _stated(
    scene: SceneSettings, surface: Any, georeference: Georeference | None
) -> list[Transmitter] | None:
    if scene.transmitters is not None:
        return place_transmitters(scene.transmitters, surface, georeference)
    if scene.transmitter_m is not None:
        return [Transmitter("tx", np.array(scene.transmitter_m, dtype=np.float64))]
    return None


def _in_the_middle(tracer: RayTracer, ground: Ground, area: np.ndarray) -> Transmitter:
    """A transmitter where nobody states one."""
    middle = area.mean(0)
    if ground.open_sky:
        high = float(tracer.surface_height(middle[None])[0]) + MAST_M
    else:
        low, top = tracer.bounding_box()[:, 2]
        high = float(low + CEILING * (top - low))
    position = np.round(np.append(middle, high), 1)
    log.info("no scene.transmitter_m: %s m taken, in the middle", position.tolist())
    return Transmitter("tx", position)


def _around(scene: SceneSettings, tracer: RayTracer, area: np.ndarray) -> Ground:
    """Places about the surfaces that rays find; an area (2, 2) [m] is looked at for a ceiling."""
    open_sky = tracer.has_open_sky(area) if scene.open_sky is None else scene.open_sky
    # Under a ceiling the highest surface is the ceiling: heights count from zero.
    over = scene.over if open_sky else "zero"

    def lift(points: np.ndarray) -> np.ndarray:
        if over == "zero":
            return points
        return points + [0.0, 0.0, 1.0] * tracer.surface_height(points[:, :2])[:, None]

    def allowed(points: np.ndarray) -> np.ndarray:
        free = tracer.clear_of_surfaces(points, CLEARANCE)
        if over == "ground":
            free &= tracer.highest_surface(points[:, :2])[1]
        return free & tracer.under_open_sky(points) if open_sky else free

    return Ground(allowed, lift, open_sky)
