"""Spectra of an array whose vectors are known."""

import pytest
from known_arrays import array_site, measure, room_vectors, walk

from gsparc.datasets.rfid import planar_array
from gsparc.ops import SphereGrid


@pytest.fixture(scope="session")
def known_campaign():
    """160 spectra on a path in a room with first-order reflections, and the true vectors."""
    site = array_site(SphereGrid.hemisphere(30, 60), planar_array())
    tx = walk(160)
    vectors, _ = room_vectors(tx, 1, planar_array())
    return measure(site, tx, vectors), vectors
