"""Degrees and metres: known lengths of the ellipsoid, and back again to a millimetre."""

import numpy as np
import pytest

from gsparc.data.georeference import Georeference


@pytest.mark.parametrize(
    "latitude, longitude",
    [(40.76, -111.84), (0, 0), (-33.9, 151.2), (0, 180), (89.99, 12), (-90, 0)],
)
def test_there_and_back_over_100_km(latitude, longitude):
    origin = Georeference(latitude, longitude)
    xy = np.random.default_rng(0).uniform(-1e5, 1e5, (500, 2))
    back = origin.from_degrees(*origin.to_degrees(xy))
    assert np.abs(back - xy).max() < 1e-6
    np.testing.assert_allclose(origin.to_degrees(np.zeros((1, 2)))[0], [latitude], atol=1e-12)


def test_known_lengths():
    """A degree of the equator is a pi / 180; one of the meridian from it 110574.389 m (WGS 84)."""
    origin = Georeference(0, 0)
    np.testing.assert_allclose(origin.from_degrees(0, 1), [[6378137 * np.pi / 180, 0]], atol=1e-6)
    np.testing.assert_allclose(origin.from_degrees(1, 0), [[0, 110574.3886]], atol=1e-3)
    quarter = origin.from_degrees(90, 0)[0, 1]
    assert quarter == pytest.approx(10001965.729, abs=1e-2)


def test_the_antimeridian_and_the_poles_are_places():
    origin = Georeference.from_coordinates([10.0, 10.0, 10.0], [179.999, -179.999, -179.998])
    assert abs(origin.longitude) > 179.9
    xy = origin.from_degrees([10.0, 10.0], [179.999, -179.999])
    assert np.linalg.norm(xy[1] - xy[0]) == pytest.approx(219.2, abs=0.3)
    across = Georeference(90, 0).from_degrees([89.9, 89.9], [0, 180])
    assert np.linalg.norm(across[1] - across[0]) == pytest.approx(22338.8, abs=0.1)
    np.testing.assert_allclose(
        Georeference(10, 1).from_degrees(10, 359.5),
        Georeference(10, 1).from_degrees(10, -0.5),
        atol=1e-6,
    )


def test_the_origin_is_the_rounded_median():
    origin = Georeference.from_coordinates(
        [40.76521977, 40.7, 40.8], [-111.83475621, -111.0, -112.0]
    )
    assert origin == Georeference(40.7652, -111.8348)


@pytest.mark.parametrize(
    "latitude, longitude, said",
    [
        (91, 0, "latitude 91 is outside -90 to 90"),
        (-111.8, 40.7, "are latitude and longitude swapped"),
        (0, 400, "longitude 400"),
        (np.nan, 0, "latitude nan"),
        (0, np.inf, "longitude inf"),
    ],
)
def test_what_is_not_on_earth_is_refused(latitude, longitude, said, refused):
    refused(said, Georeference, latitude, longitude)
    refused(said, Georeference(0, 0).from_degrees, [latitude], [longitude])
    refused(said, Georeference.from_coordinates, [latitude], [longitude])


def test_local_coordinates_that_are_none_are_refused(refused):
    for xy in (np.zeros(2), np.zeros((3, 3)), [[np.nan, 0]], [[3e7, 0]]):
        refused("local coordinates", Georeference(0, 0).to_degrees, np.asarray(xy))
    refused("no places", Georeference.from_coordinates, np.zeros(0), np.zeros(0))
