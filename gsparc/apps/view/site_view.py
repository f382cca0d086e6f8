"""What all clients share of a model: scenes of stations, each made once, and where planes lie."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.area import Grid, lay_grid
from gsparc.apps.maps.floor_plan import FloorPlan
from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.building import VALUES, Sphere, build_scene, start_place
from gsparc.apps.view.plane import Plane, refine_plane
from gsparc.apps.view.scene import EXTENT, DrawnScene, Points
from gsparc.apps.view.viewed import Measured, Viewed
from gsparc.prediction.levels import MAPPED
from gsparc.processes.few_rows import evenly_spaced


@dataclass(frozen=True)
class StationView:
    """A scene of one station and what explains its answers.

    Attributes:
        scene: what stands still.
        measured: of the station; None without data.
        tree: see `reasons`.
        power: colours of powers: as those of the measured points, where there are any.
    """

    scene: DrawnScene
    measured: Measured | None
    tree: cKDTree | None
    power: Legend | None

    @property
    def dot(self) -> float:
        """Width of the dots of measured places [m]."""
        part = self.scene.part(VALUES)
        return part.size if isinstance(part, Points) else 0.0


@dataclass
class SiteView:
    """A model as all clients see it.

    Attributes:
        viewed: the model.
        plan: of the floor, beneath all.
        grid: cells of planes; None where no power is predicted.
        at: world place where the moving end first stands; None: chosen.
        other: the same of the transmitter, where both move.
        made: stations' views, as they are asked for.
    """

    viewed: Viewed
    plan: FloorPlan | None = None
    grid: Grid | None = None
    at: np.ndarray | None = None
    other: np.ndarray | None = None
    made: dict[str | None, StationView] = field(default_factory=dict)
    _lock: Any = field(default_factory=threading.Lock)

    @property
    def unit(self) -> str:
        """Of powers."""
        return self.viewed.site.level_unit

    def station(self, name: str | None) -> StationView:
        """Return the view of a station, made when first asked for, in seconds;
        those made wait for nobody.
        """
        if name not in self.made:
            # Two clients that ask for a new station at once wait for one making of it.
            with self._lock:
                if name not in self.made:
                    self.made[name] = self._make(name)
        return self.made[name]

    def _make(self, name: str | None) -> StationView:
        viewed = self.viewed
        measured = viewed.measured_at(name)
        scene = build_scene(viewed, self.plan, name, measured)
        power = scene.legends.get(VALUES) if viewed.site.kind in MAPPED else None
        tree = cKDTree(measured.places) if measured is not None and not viewed.site.paired else None
        return StationView(scene, measured, tree, power)

    def extent(self, name: str | None) -> float:
        """Return the width of the site [m]."""
        return EXTENT / self.station(name).scene.frame.scale

    def sphere(self, name: str | None) -> Sphere | None:
        """Return directions of a spectrum; None of other kinds."""
        site = self.viewed.site
        return (
            Sphere.from_site(site, self.extent(name))
            if site.target.is_image and site.grid
            else None
        )

    def initial_places(self, name: str | None) -> dict[str, np.ndarray]:
        """Return world places (3,) where the ends that move first stand."""
        viewed, first = self.viewed, self.viewed.moving[-1]
        at = start_place(viewed, self.station(name).measured) if self.at is None else self.at
        places: dict[str, np.ndarray] = {first: at}
        if len(viewed.moving) > 1:
            other = (viewed.site.box + viewed.site.origin).mean(axis=0)
            if viewed.data is not None:
                other = viewed.data.tx[len(viewed.data) // 2] + viewed.site.origin
            places["tx"] = other if self.other is None else self.other
        return places

    def plane(self, name: str | None, grid: Grid) -> Plane:
        """Return the power over all of some cells, the transmitter where it first stands if both
        ends move.
        """
        other = self.initial_places(name)["tx"].tolist() if self.viewed.site.paired else None
        *_, plane = refine_plane(self.viewed.predictor_of(name), grid, other)
        assert plane is not None
        return plane


def lay_power_plane(viewed: Viewed, settings: Mapping[str, Any], plan: Any = None) -> Grid | None:
    """Return cells of planes of power, as `gsparc map` lays them;
    None where the model predicts none.
    """
    if viewed.site.kind not in MAPPED:
        return None
    return lay_grid(
        viewed.site, settings.get("area"), settings.get("height_m"), settings.get("step_m"), plan
    )


def walk_places(view: SiteView, name: str | None, count: int) -> Sequence[np.ndarray]:
    """Return at most `count` measured places in the order of measuring,
    or along the box's diagonal.
    """
    measured = view.station(name).measured
    if measured is None:
        low, high = view.viewed.box()
        return [low + (high - low) * share for share in np.linspace(0.1, 0.9, count)]
    places = measured.places
    return list(places[evenly_spaced(len(places), count)])
