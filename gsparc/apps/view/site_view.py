"""What all clients share of a model: scenes of stations, each made once, and planes of predicted
power, coarse at once, then finer, in steps that others may come between.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.area import FloorPlan, Grid, lay_grid
from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.building import (
    VALUES,
    MeasuredValues,
    Sphere,
    Viewed,
    build_scene,
    start_place,
)
from gsparc.apps.view.scene import EXTENT, DrawnScene, PlacedPicture, Points
from gsparc.prediction.levels import predict_levels
from gsparc.prediction.predictor import Predictor
from gsparc.processes.few_rows import evenly_spaced

FIRST = 400  # cells of the first, coarsest picture, about
STEP_S = 0.03  # of a step: what a drag waits for [s]
LEAST = 16  # cells of a step
OPACITY = 0.9
APART = 0.1  # of a plane's width, between weak places that are visited


@dataclass(frozen=True)
class Plane:
    """A picture of power over a plane, so far.

    Attributes:
        grid: the cells.
        level_db: (ny, nx), each cell with the level of the nearest that was asked about.
        stride: cells between those; 1: all were.
    """

    grid: Grid
    level_db: np.ndarray
    stride: int


def refine_plane(
    predictor: Predictor, grid: Grid, other_end: Sequence[float] | None = None
) -> Iterator[Plane | None]:
    """Return planes of ever smaller strides; None between them, about every `STEP_S`.

    `other_end` (3,) is the transmitter's world place [m] where both ends move.
    """
    level = np.full(grid.inside.shape, np.nan)
    stride = 1 << max(0, int(np.ceil(np.log2(max(np.sqrt(level.size / FIRST), 1.0)))))
    row, column = np.indices(grid.inside.shape)
    done, chunk = np.zeros(grid.inside.shape, bool), LEAST
    while stride:
        chosen = (row % stride == 0) & (column % stride == 0) & ~done & grid.inside
        cells, start = np.flatnonzero(chosen), 0
        while start < len(cells):
            begin, part = time.perf_counter(), cells[start : start + chunk]
            level.reshape(-1)[part] = predict_levels(predictor, grid.places(part), other_end)[0]
            start += len(part)
            took = time.perf_counter() - begin
            chunk = int(np.clip(chunk * STEP_S / max(took, 1e-6), max(chunk / 2, LEAST), 2 * chunk))
            yield None
        done |= chosen
        block = level[row - row % stride, column - column % stride]
        filled = np.where(np.isfinite(level), level, block)
        yield Plane(grid, np.where(grid.inside, filled, np.nan), stride)
        stride //= 2


def plane_sheet(
    name: str, grid: Grid, values: np.ndarray, legend: Legend, beneath: float = 0.0
) -> PlacedPicture:
    """Return a picture of values (ny, nx) over the cells, clear where not finite,
    `beneath` [m] lower.

    Half a dot lower, dots of the same height are seen whole.
    """
    clear = np.where(np.isfinite(values), round(255 * OPACITY), 0)[..., None].astype(np.uint8)
    image = np.concatenate([legend.to_colours(values), clear], axis=-1)
    west, east, south, north = grid.extent
    return PlacedPicture(
        name,
        np.array([west, north, grid.height - beneath]),
        np.array([east - west, 0.0, 0.0]),
        np.array([0.0, south - north, 0.0]),
        image[::-1],
    )


def weakest_place(plane: Plane, seen: Sequence[np.ndarray] = ()) -> np.ndarray | None:
    """Return the world place (3,) [m] of the cell of least power,
    `APART` of the plane's width from places `seen` (3,).

    None where there is none.
    """
    level = np.where(plane.grid.inside, plane.level_db, np.nan)
    west, east, south, north = plane.grid.extent
    for x, y, _ in seen:
        distance = np.hypot(plane.grid.x - x, plane.grid.y[:, None] - y)
        level[distance < APART * max(east - west, north - south)] = np.nan
    if not np.isfinite(level).any():
        return None
    return plane.grid.places(np.array([int(np.nanargmin(level))]))[0]


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
    measured: MeasuredValues | None
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
        power = None if viewed.site.target.is_image else scene.legends.get(VALUES)
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
    if viewed.site.target.is_image:
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
