"""Spectra of an array whose vectors are known."""

from __future__ import annotations

import pytest
from known_arrays import array_site, measure, room_vectors, walk

from gsparc.data.datasets.rfid import planar_array
from gsparc.ops import SphereGrid


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Vectors are retrieved once for all tests here, and what other runs have cached is not read."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def known_campaign():
    """160 spectra on a path in a room with first-order reflections, and the true vectors."""
    site = array_site(SphereGrid.hemisphere(30, 60), planar_array())
    tx = walk(160)
    vectors, _ = room_vectors(tx, 1, planar_array())
    return measure(site, tx, vectors), vectors
