"""Degrees to metres about an origin on the WGS 84 ellipsoid, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from pyproj import Proj

from gsparc.base.errors import DataError

DIGITS = 4  # of an origin's degrees: 11 m
# Latitude and longitude [deg]; both customs of longitude are taken: -180 to 180, and 0 to 360.
ON_EARTH = ((-90, 90), (-180, 360))


@dataclass(frozen=True)
class Georeference:
    """The origin of local coordinates: x points east there, y north.

    The projection is azimuthal equidistant about the origin (Snyder, Map Projections, 1987, chapter
    25), computed from geodesics (Karney, J. Geodesy 87, 2013), so that poles and the antimeridian
    are places like any other. Distances from the origin are exact, across them they are stretched
    by (r / 6371 km)^2 / 6: 0.4 millionths at 10 km, 41 millionths at 100 km.

    Attributes:
        latitude: of the origin [deg], -90 to 90.
        longitude: of the origin [deg], -180 to 180, counted to the east.
    """

    latitude: float
    longitude: float

    def __post_init__(self) -> None:
        _refuse_invalid(self.latitude, self.longitude, "origin: ")

    @classmethod
    def from_coordinates(
        cls, latitude: np.ndarray, longitude: np.ndarray, digits: int = DIGITS
    ) -> Self:
        """Place the origin of (n,) [deg] at their median, rounded to so many digits.

        Raises:
            DataError: no places, or a value is not in range.
        """
        latitude, longitude = (
            np.atleast_1d(np.asarray(v, np.float64)) for v in (latitude, longitude)
        )
        if not latitude.size:
            raise DataError("origin: no places")
        _refuse_invalid(latitude, longitude, "origin: ")
        # Relative to one of them: 179.9 and -179.9 are neighbours, their median is not 0.
        turned = np.median((longitude - longitude[0] + 180) % 360 - 180) + longitude[0]
        east = (round(float(turned), digits) + 180) % 360 - 180
        return cls(round(float(np.median(latitude)), digits), round(east, digits))

    def from_degrees(self, latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
        """Return local coordinates (n, 2) [m], east and north, of places (n,) [deg].

        Raises:
            DataError: a value is not finite or out of range (latitude -90 to 90, longitude -180 to
                360).
        """
        _refuse_invalid(latitude, longitude)
        east, north = (np.array(degrees, np.float64, ndmin=1) for degrees in (longitude, latitude))
        return np.stack(self._projection(east, north), axis=-1)

    def to_degrees(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return latitude, longitude (n,) [deg] of local (n, 2) [m]; the inverse of `from_degrees`.

        Raises:
            DataError: not finite, of another shape, or farther than half the way round the Earth.
        """
        xy = np.asarray(xy, np.float64)
        if xy.ndim != 2 or xy.shape[1] != 2:
            raise DataError(f"local coordinates: expected shape (n, 2), found {xy.shape}")
        if not (np.hypot(xy[:, 0], xy[:, 1]) < 2.0e7).all():
            raise DataError(
                "local coordinates: not finite, or not on Earth; expected metres from the origin"
            )
        longitude, latitude = self._projection(xy[:, 0], xy[:, 1], inverse=True)
        return np.asarray(latitude), np.asarray(longitude)

    @property
    def _projection(self) -> Proj:
        return Proj(proj="aeqd", ellps="WGS84", lat_0=self.latitude, lon_0=self.longitude)


def _refuse_invalid(
    latitude: np.ndarray | float, longitude: np.ndarray | float, what: str = ""
) -> None:
    if (fault := find_invalid_coordinate(latitude, longitude)) is not None:
        raise DataError(f"{what}{fault[1]}")


def find_invalid_coordinate(
    latitude: np.ndarray | float, longitude: np.ndarray | float
) -> tuple[int, str] | None:
    """Return the first row of (n,) [deg] that is not on Earth, and what is wrong;
    None when all are.
    """
    latitude, longitude = np.atleast_1d(latitude, longitude)
    for name, values, (low, high) in zip(
        ("latitude", "longitude"), (latitude, longitude), ON_EARTH, strict=True
    ):
        wrong = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(wrong):
            swapped = name == "latitude" and (np.abs(longitude) <= 90).all()
            hint = "; are latitude and longitude swapped?" if swapped else ""
            return int(wrong[0]), (
                f"{name} {values[wrong[0]]:g} is outside {low} to {high} degrees{hint}"
            )
    return None
