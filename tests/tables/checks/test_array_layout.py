"""What spectra of an array tell by themselves: its plane, zenith angles."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsparc.datasets.rfid import planar_array
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import bartlett_spectrum, steering_matrix
from gsparc.tables.checks.array_layout import layout_warnings
from gsparc.tables.conventions import convert_conventions
from gsparc.tables.own import from_arrays

UPRIGHT = planar_array(spacing_m=0.5)[:, [2, 0, 1]]  # in the plane yz, of a wavelength of 1 m


@pytest.fixture(scope="module")
def rooms():
    """Direct paths and two others of 20 places at three carriers, phases free."""
    rng, grid = np.random.default_rng(0), SphereGrid.hemisphere(30, 60)
    places = np.repeat(
        np.c_[np.full(20, 4.0), rng.uniform(-4, 4, 20), rng.uniform(0.2, 3, 20)], 3, axis=0
    )
    others = np.repeat(rng.normal(size=(20, 2, 3)), 3, axis=0)
    ways = np.concatenate([places[:, None], others], 1)
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    phases = np.exp(2j * np.pi * rng.random((60, 3))) * [1.0, 0.4, 0.4]
    vectors = np.einsum("sk,skm->sm", phases, np.exp(2j * np.pi * ways @ UPRIGHT.T))
    image = bartlett_spectrum(
        torch.from_numpy(vectors), steering_matrix(UPRIGHT, grid, 1.0)
    ).numpy()
    image = (image / image.max(1, keepdims=True)).reshape(60, 30, 60)
    arrays = {
        "tx_position": places,
        "rx_position": np.zeros(3),
        "spectrum": image,
        "array_position": UPRIGHT,
    }
    carriers = np.tile([1.0, 1.0001, 1.0002], 20) * 299_792_458.0
    return from_arrays(arrays | {"carrier_hz": carriers})


def test_what_is_as_declared_is_not_doubted(rooms):
    assert layout_warnings(rooms) == []


def test_zenith_angles_and_another_plane_were_taken_for_the_declared_ones(rooms):
    lying = replace(rooms, site=replace(rooms.site, array=UPRIGHT[:, [1, 2, 0]]))
    assert "in the plane yz" in layout_warnings(lying)[0]
    assert "dataset.zenith=true" in layout_warnings(convert_conventions(rooms, ["zenith"]))[0]
