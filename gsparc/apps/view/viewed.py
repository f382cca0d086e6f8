"""A checkpoint as a viewer needs it: whom to ask, and what was measured."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.apps.maps.making import choose_stations
from gsparc.data.schema import End, Measurements, Site
from gsparc.prediction import levels
from gsparc.prediction.predictor import Predictor
from gsparc.runs.align_site import align_to_site
from gsparc.runs.open_runs import open_run

log = logging.getLogger(__name__)

LEAST_HEIGHT_M = 0.5  # of a site, between whose floor and ceiling planes are lifted
CHUNK = 128  # rows of one call


@dataclass(frozen=True)
class Measured:
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

    def measured_at(self, station: str | None) -> Measured | None:
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
        return Measured(places, values, label)


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
