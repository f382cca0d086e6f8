"""What a map holds, its layers over all stations (which serves, its ratio, its outage),
and its files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.strongest import REFUSED
from gsparc.base.files import write_archive

OF_STATIONS = ("power_db", "lower_db", "upper_db", "expected_error_db")
ARRAYS = (*OF_STATIONS, "sinr_db", "outage", "best_server", "server_chance", "heard_chance")


@dataclass(frozen=True)
class FieldMap:
    """Predictions for the cells of a grid; float32, NaN where they are refused.

    Attributes:
        grid: the cells, world.
        stations: (T,) names; one, "", where there is one.
        power_db: (T, ny, nx) received power.
        lower_db, upper_db: (T, ny, nx) ends of the interval.
        expected_error_db: (T, ny, nx) root mean square error.
        best_server: (ny, nx) int16, number of the strongest station; `REFUSED`.
        server_chance: (ny, nx) probability that it is, and is above its floor; see `server_chance`.
        heard_chance: (ny, nx) probability that it lies above its floor.
        sinr_db: (ny, nx) of the strongest station, over the others' load and noise.
        outage: (ny, nx) probability that all powers lie below `threshold_db`.
        share: of measurements that the intervals hold; the field alone lies in them more often.
        calibrated: whether held-out blocks say so; else the model's own deviations alone.
        threshold_db: of `outage`.
        extra: further layers (ny, nx) by name: `overlap` of several stations.
        places: (n, 2) where was measured, world [m].
        station_place: (T, 2) world [m], NaN where unknown.
        notes: what a reader must know, one line each.
        unit: of all levels.
        azimuth: (T,) that sectors face [deg from north], NaN of others.
        bands: (T,) carriers of the stations; () of one.
        site: (T,) int64 of the stations.
        number: (T,) int64 of the stations in the model.
    """

    grid: Grid
    stations: tuple[str, ...]
    power_db: np.ndarray
    lower_db: np.ndarray
    upper_db: np.ndarray
    expected_error_db: np.ndarray
    best_server: np.ndarray
    server_chance: np.ndarray
    heard_chance: np.ndarray
    sinr_db: np.ndarray
    outage: np.ndarray
    share: float
    calibrated: bool
    threshold_db: float
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    places: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    station_place: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    notes: tuple[str, ...] = ()
    unit: str = "dB"
    azimuth: np.ndarray = field(default_factory=lambda: np.zeros(0))
    bands: tuple[str, ...] = ()
    site: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    number: np.ndarray = field(default_factory=lambda: np.zeros(1, np.int64))

    @property
    def refused(self) -> np.ndarray:
        """Cells (ny, nx) bool of the area about which nothing is said."""
        return self.grid.inside & (self.best_server == REFUSED)

    @property
    def unsure(self) -> np.ndarray:
        """Cells (ny, nx) bool whose best server is less likely than not strongest
        and above its floor.
        """
        return np.nan_to_num(self.server_chance, nan=1.0) < 0.5

    @property
    def quiet(self) -> np.ndarray:
        """Cells (ny, nx) bool where more likely than not no station is heard."""
        return np.nan_to_num(self.heard_chance, nan=1.0) < 0.5

    @property
    def other_leads(self) -> np.ndarray:
        """Cells (ny, nx) bool, of those where one is heard, that another leads more likely."""
        with np.errstate(divide="ignore", invalid="ignore"):
            lead = self.server_chance / self.heard_chance
        return (np.nan_to_num(lead, nan=1.0) < 0.5) & ~self.quiet

    @property
    def without_ratio(self) -> np.ndarray:
        """Cells (ny, nx) bool that have a level, and neither interference nor noise."""
        return self.grid.inside & ~self.refused & ~np.isfinite(self.sinr_db)

    def lone_squares(self) -> int:
        """Count cells on one side of the threshold, all of whose neighbours are on the other."""
        covered = np.where(np.isfinite(self.outage), self.outage < 0.5, np.nan)
        around = np.pad(covered, 1, constant_values=np.nan)
        shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
        ny, nx = covered.shape
        beside = np.stack([around[i : i + ny, j : j + nx] for i, j in shifts])
        return int((beside == 1 - covered).all(0).sum())

    def at_best_server(self, layers: np.ndarray) -> np.ndarray:
        """Return, of layers (T, ny, nx), each cell's strongest station's (ny, nx);
        NaN where refused.
        """
        number = np.maximum(self.best_server, 0).astype(np.int64)
        chosen = np.take_along_axis(layers, number[None], axis=0)[0]
        return np.where(self.best_server == REFUSED, np.nan, chosen)

    def to_unit(self, decibels: float, unit: str) -> FieldMap:
        """Return the same map with levels so many decibels higher, which is in another unit."""
        # Errors and probabilities do not change with the unit, differences of levels neither.
        levels = {name: getattr(self, name) + np.float32(decibels) for name in OF_STATIONS[:3]}
        return replace(self, **levels, threshold_db=self.threshold_db + decibels, unit=unit)

    def layer(self, name: str) -> np.ndarray:
        """Return one of `ARRAYS` (ny, nx), of the strongest station; NaN where refused."""
        if name == "best_server":
            return np.where(self.best_server == REFUSED, np.nan, self.best_server)
        values = getattr(self, name)
        return self.at_best_server(values) if name in OF_STATIONS else values

    def save(self, path: str | Path) -> None:
        """Write as npz, whole or not at all."""
        arrays = {
            "x": self.grid.x,
            "y": self.grid.y,
            "height": np.array(self.grid.height),
            "inside": self.grid.inside,
            "stations": np.array(self.stations),
            "share": np.array(self.share),
            "calibrated": np.array(self.calibrated),
            "threshold_db": np.array(self.threshold_db),
            "unit": np.array(self.unit),
            "bands": np.array(self.bands, str),
            # Of the metres, where places came in degrees: latitude and longitude
            "origin": np.array(
                [] if (at := self.grid.origin) is None else [at.latitude, at.longitude]
            ),
            **{name: getattr(self, name) for name in ARRAYS},
            **self.extra,
        }
        write_archive(path, arrays)

    def summarise(self) -> dict[str, float | int | str | None]:
        """Return `map/*` for `summary.json`; shares are of the cells that something is said of."""
        mask = self.grid.inside & ~self.refused

        def reduce(
            layer: np.ndarray, reduced: Callable[[np.ndarray], Any] = np.mean
        ) -> float | None:
            values = layer[mask & np.isfinite(layer)]
            return float(reduced(values)) if len(values) else None

        power = self.layer("power_db")
        figures = {
            "cells": int(self.grid.inside.sum()),
            "refused": int(self.refused.sum()),
            "step_m": self.grid.step,
            "height_m": self.grid.height,
            "stations": len(self.stations),
            "lowest_db": reduce(power, np.min),
            "highest_db": reduce(power, np.max),
            "width_db": reduce(self.at_best_server(self.upper_db - self.lower_db)),
            "expected_error_db": reduce(
                self.layer("expected_error_db"), lambda v: np.sqrt(np.mean(v**2))
            ),
            "threshold_db": self.threshold_db,
            "outage": reduce(self.outage),
            "sinr_db": reduce(self.sinr_db),
            "server_unsure": reduce(1.0 * self.unsure),
        }
        return {f"map/{name}": value for name, value in figures.items()} | {"map/unit": self.unit}


def empty_layers(stations: int, shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return `ARRAYS` of a map (ny, nx) about which nothing is said yet."""
    shapes = {name: (stations, *shape) if name in OF_STATIONS else shape for name in ARRAYS}
    values = {name: np.full(size, np.nan, np.float32) for name, size in shapes.items()}
    return values | {"best_server": np.full(shape, REFUSED, np.int16)}
