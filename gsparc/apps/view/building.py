"""A checkpoint as a viewer needs it: whom to ask, what was measured, the scene, and the parts of it
that follow a dragged end.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.apps.maps.area import FloorPlan
from gsparc.apps.maps.layers import Legend
from gsparc.apps.maps.making import choose_stations
from gsparc.apps.view.answer import SILENT_DB, PlaceAnswer
from gsparc.apps.view.scene import (
    EXTENT,
    DrawingFrame,
    DrawnScene,
    Faces,
    Lines,
    Mark,
    Part,
    PlacedPicture,
    Points,
)
from gsparc.data.schema import ENDS, LIGHT, End, Measurements, Site
from gsparc.data.site_objects import GaussianCloud
from gsparc.data.walls import box_faces
from gsparc.prediction import levels
from gsparc.prediction.predictor import Predictor
from gsparc.processes.few_rows import evenly_spaced
from gsparc.runs.align_site import align_to_site
from gsparc.runs.open_runs import open_run

log = logging.getLogger(__name__)

LEAST_HEIGHT_M = 0.5  # of a site, between whose floor and ceiling planes are lifted
CHUNK = 128  # rows of one call


@dataclass(frozen=True)
class MeasuredValues:
    """What was measured of one station.

    Attributes:
        places: (n, 3) world, of the moving end [m].
        values: (n,) level [dB], or mean of a spectrum; NaN where nothing was heard.
        label: of the values.
    """

    places: np.ndarray
    values: np.ndarray
    label: str


@dataclass(frozen=True)
class Viewed:
    """A model, and what is known of its site.

    Attributes:
        name: of the checkpoint.
        predictor: as trained.
        data: in the model's coordinates and units; None where they are gone.
        stations: that it answers for; one, None, where there is one static end or none.
        notes: what a reader must know, one line each.
    """

    name: str
    predictor: Predictor
    data: Measurements | None
    stations: tuple[str | None, ...]
    notes: tuple[str, ...] = ()

    @property
    def site(self) -> Site:
        """Return that of the model."""
        return self.predictor.site

    @property
    def moving(self) -> tuple[End, ...]:
        """Return the ends that can be dragged."""
        return self.site.moving_ends

    def predictor_of(self, station: str | None) -> Predictor:
        """Return the predictor of a station."""
        return self.predictor.select_station(station)

    def static_place(self, station: str | None) -> np.ndarray | None:
        """Return the world place (3,) [m] of the static end; None where it is unknown or moves."""
        place = self.predictor_of(station).site.static_position
        return None if place is None else place + self.site.origin

    def box(self) -> np.ndarray:
        """Return world corners (2, 3) of where the moving end was [m]."""
        return np.asarray(self.site.moving_box[:, -3:] + self.site.origin)

    def heights(self) -> tuple[float, float]:
        """Return the lowest and the highest height of a plane [m], to the centimetre."""
        low, high = (float(z) for z in (self.site.box + self.site.origin)[:, 2])
        if high - low <= LEAST_HEIGHT_M:
            low, high = low - 1.5, high + 1.5
        # Outwards to the centimetre, so that the slider reaches floor and ceiling.
        return float(np.floor(100 * low) / 100), float(np.ceil(100 * high) / 100)

    def measured_at(self, station: str | None) -> MeasuredValues | None:
        """Return values of a station; None without data."""
        if self.data is None:
            return None
        data, number = self.data, self.site.every_station.name.index(station or "")
        rows = np.flatnonzero(data.stations_of() == number)
        places = data.moving[rows][:, -3:] + data.site.origin
        if data.site.target.is_image:
            chunks = (rows[i : i + CHUNK] for i in range(0, len(rows), CHUNK))
            values = np.concatenate(
                [data.targets(part).flatten(1).mean(1).numpy() for part in chunks]
            )
            label = "mean of a measured spectrum"
        else:
            values, side = levels.measured_levels(data, rows)
            # What lay below its level was not heard: it has no colour, only a place.
            values[side > 0] = np.nan
            quantity = "received power" if data.site.target.is_level else "power of a channel"
            label = f"measured {quantity} [{self.site.level_unit}]"
        return MeasuredValues(places, values, label)


def open_model(
    path: str | Path,
    dataset: Mapping[str, Any] | None = None,
    station: str | int | None = None,
    unit: str | None = None,
) -> Viewed:
    """Read a checkpoint, and its data where they are still there.

    Args:
        path: of the checkpoint.
        dataset: settings that replace those stored.
        station: the only one to show; None: all that the model answers for.
        unit: of powers; None: as measured.

    Raises:
        DataError: no station is called that.
        ValueError: no checkpoint that can be read.
    """
    run, notes, data = open_run(path, dataset or {}), list[str](), None
    predictor = run.predictor.in_levels(unit)
    try:
        opened = run.read()
        data = align_to_site(opened.data, predictor.site)
        if opened.foreign is not None:
            learned = f"the model was trained on {opened.foreign}"
            notes.append(f"measured points are other data: {learned}")
    # Data are gone or changed: a model can be looked at without them.
    except (ValueError, OSError) as error:
        notes.append(
            f"measured points are not drawn ({error}); give dataset.file=... or dataset.root=..."
        )
    names, missing = choose_stations(
        predictor, None if station is None else [station], key="station"
    )
    for note in missing:
        log.warning(note)
    stations = tuple(name or None for name in names)
    return Viewed(str(path), predictor, data, stations, tuple(notes))


MOST_NAMES = 5  # stations that are named at once
MOST_POINTS = 20_000  # measured places that are drawn
DOT = 0.01  # width of a measured place, of the extent of the site
DIRECTIONS = 9000  # of a sphere of power, at most
QUERIES = 16  # places at which Gaussians are asked what they emit
RANGE_DB = 30.0  # of emissions that are told apart
RADIUS = 0.08  # of a sphere of power, of the extent of the site
BENEATH = 2e-3  # of the extent, that a floor plan lies beneath all else, and the grid beneath it
REACH = 0.8  # of the extent, that rays are drawn to at most
MIRROR, BOX = (205, 92, 92), (31, 119, 180)
SURFACES = {MIRROR: "mirror planes that were found", BOX: "boxes that were found"}
PATHS = Legend(
    "gain of a path [dB of the strongest]; it ends at an image of the transmitter",
    -SILENT_DB,
    0.0,
    "plasma",
)
VALUES, GAUSSIANS, SPHERE, RAYS, SOURCES = "measured", "gaussians", "sphere", "rays", "sources"


def build_scene(
    viewed: Viewed, plan: FloorPlan | None, station: str | None, seen: MeasuredValues | None
) -> DrawnScene:
    """Build everything that stands still, with the measurements
    and the Gaussians of one station.
    """
    stands = {name: at for name in viewed.stations if (at := viewed.static_place(name)) is not None}
    points = [viewed.box(), *(at[None] for at in stands.values())]
    if viewed.site.paired:
        points.append(viewed.site.box + viewed.site.origin)
    frame = DrawingFrame.around(np.concatenate(points))
    extent = EXTENT / frame.scale
    parts: list[Part] = []
    legends: dict[str, Legend] = {}
    low = viewed.box()[0, 2]  # of measured places, and of planes where there are any
    ground = float(low if viewed.site.target.is_image else min(low, viewed.heights()[0]))
    if plan is not None:
        corners = np.column_stack([plan.corners(), np.full(4, ground - BENEATH * extent)])
        parts.append(
            PlacedPicture(
                "floor plan",
                corners[0],
                corners[1] - corners[0],
                corners[3] - corners[0],
                plan.image,
            )
        )
    if seen is not None:
        chosen = evenly_spaced(len(seen.places), MOST_POINTS)
        legends[VALUES] = legend = Legend.over(seen.label, seen.values[chosen])
        colours = legend.to_colours(seen.values[chosen])
        parts.append(Points(VALUES, seen.places[chosen], colours, DOT * extent))
    for name, place in stands.items():
        named = len(viewed.stations) <= MOST_NAMES or name == station
        text = (name or ENDS[viewed.site.still_end]) if named else ""
        parts.append(Mark(f"station {name or ''}".strip(), place, text))
    objects = viewed.predictor_of(station).method.objects()
    origin = viewed.site.origin
    for number, plane in enumerate(objects.planes):
        square = _square(plane, frame.middle - origin, extent) + origin
        parts.append(_mesh(f"mirror {number}", [square], MIRROR, 0.12))
    for number, box in enumerate(objects.boxes + origin):
        parts.append(_mesh(f"box {number}", box_faces(*box), BOX, 0.35))
    cloud = model_gaussians(viewed, station, seen)
    if cloud is not None:
        legends[GAUSSIANS], colours = cloud_colours(cloud)
        size = float(
            np.clip(extent / 90 / max(len(cloud) / 500, 1) ** (1 / 3), extent / 600, extent / 90)
        )
        parts.append(Points(GAUSSIANS, cloud.means, colours, size))
    faces = np.array(box_faces(*viewed.box()))
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    parts.append(Lines("box of measurements", sides, np.full((len(sides), 3), 150, np.uint8)))
    title = f"{viewed.site.name}, {viewed.predictor.method.label}"
    title += "" if station is None else f": {station}"
    beneath = ground - 2 * BENEATH * extent
    return DrawnScene(title, frame, tuple(parts), beneath, legends, viewed.notes)


def cloud_colours(cloud: GaussianCloud) -> tuple[Legend, np.ndarray]:
    """Return what colours mean, and those (N, 3) uint8 of Gaussians by emission,
    below the strongest.
    """
    most = float(np.abs(cloud.strengths).max(initial=0.0))
    level = 20 * np.log10(np.maximum(np.abs(cloud.strengths), most * 1e-6 + 1e-300) / (most or 1.0))
    legend = Legend(f"{cloud.label} [dB of the strongest]", -RANGE_DB, 0.0, "plasma")
    return legend, legend.to_colours(level)


def model_gaussians(
    viewed: Viewed, station: str | None, measured: MeasuredValues | None
) -> GaussianCloud | None:
    """Return Gaussians that are rendered, in world coordinates; None: of a model without."""
    low, high = viewed.box()
    places = np.random.default_rng(0).uniform(low, high, (QUERIES, 3))
    if measured is not None:
        places = measured.places[np.linspace(0, len(measured.places) - 1, QUERIES).astype(int)]
    site = viewed.site
    other = {"tx": site.box.mean(0) + site.origin} if site.paired else {}
    with suppress(ValueError):  # of this kind are only some of those that it fits
        return viewed.predictor_of(station).gaussians(**site.name_moving(places), **other)
    return None


def _square(plane: np.ndarray, middle: np.ndarray, side: float) -> np.ndarray:
    """Corners (4, 3) of a square of a plane (4,) around the foot of a place (3,)."""
    length = np.linalg.norm(plane[:3])
    normal = plane[:3] / length
    foot = middle - (normal @ middle - plane[3] / length) * normal
    along = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    return foot + side / 2 * np.array(
        [-along - across, along - across, along + across, across - along]
    )


def _mesh(
    name: str, faces: Sequence[np.ndarray], colour: tuple[int, int, int], opacity: float
) -> Faces:
    """Flat faces (C, 3) as triangles, each face a fan about its first corner."""
    fans = [face[[0, i, i + 1]] for face in faces for i in range(1, len(face) - 1)]
    return Faces(name, np.array(fans).reshape(-1, 3, 3), colour, opacity)


@dataclass(frozen=True)
class Sphere:
    """Directions around a receiver in which power is drawn.

    Attributes:
        rows, columns: of a spectrum, that are drawn.
        offsets: (n, 3) [m], world, from the receiver.
        size: of a dot [m].
    """

    rows: np.ndarray
    columns: np.ndarray
    offsets: np.ndarray
    size: float

    @classmethod
    def from_site(cls, site: Site, extent: float) -> Sphere:
        """Return directions of a site of spectra; not more than `DIRECTIONS`."""
        assert site.grid is not None
        directions = site.grid.directions().numpy()
        stride = max(
            1, int(np.ceil(np.sqrt(directions.shape[0] * directions.shape[1] / DIRECTIONS)))
        )
        high, wide = directions.shape[:2]
        row, column = (a.reshape(-1) for a in np.mgrid[0:high:stride, 0:wide:stride])
        turn = np.eye(3) if site.rx_rotation is None else site.rx_rotation
        radius = RADIUS * extent
        offsets = radius * directions[row, column] @ turn.T
        return cls(row, column, offsets, radius * 2.2 * np.sqrt(np.pi / max(len(row), 1)) * 1.2)

    def colours(self, spectrum: np.ndarray) -> np.ndarray:
        """Return (n, 3) uint8 of a spectrum (H, W) in [0, 1]."""
        return Legend("", 0.0, 1.0, "inferno").to_colours(spectrum[self.rows, self.columns])


def draw_rays(answer: PlaceAnswer, extent: float) -> tuple[Lines, Points] | None:
    """Draw paths as lines from the receiver towards where they come from, as long as their delays,
    and the sources
    at the ends of those that are drawn whole.

    A line is straight where the path has bounced: its end is the image of the transmitter.
    """
    paths, receiver = answer.paths, answer.ends.get("rx")
    if paths is None or paths.towards is None or receiver is None:
        return None
    length = paths.delay_ns * 1e-9 * LIGHT
    reach = np.minimum(length, REACH * extent)
    ends = receiver + paths.towards * reach[:, None]
    colours = PATHS.to_colours(paths.gain_db - paths.gain_db.max(initial=-np.inf))
    segments = np.stack([np.broadcast_to(receiver, ends.shape), ends], axis=1)
    return Lines(RAYS, segments, colours), Points(SOURCES, ends, colours, extent / 80)


def start_place(viewed: Viewed, measured: MeasuredValues | None) -> np.ndarray:
    """Return the world place (3,) [m] where the moving end first stands:
    the measured one nearest to their median.
    """
    if measured is None:
        return viewed.box().mean(axis=0)
    middle = np.median(measured.places, axis=0)
    return np.asarray(
        measured.places[int(np.linalg.norm(measured.places - middle, axis=1).argmin())]
    )
