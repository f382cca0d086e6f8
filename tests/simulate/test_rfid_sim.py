import hashlib

import numpy as np
import torch
from poses import boresight_degrees

from gsparc.data.datasets.rfid import HEIGHT, WAVELENGTH, WIDTH, load_rfid, planar_array
from gsparc.data.schema import LIGHT
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import bartlett, steering
from gsparc.simulate.rfid_sim import HAND_BOX, RFIDStandIn, hand_moved


def _digest(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return [(p.name, hashlib.sha256(p.read_bytes()).hexdigest()) for p in files]


def test_deterministic_by_seed_and_reused(tmp_path):
    first = RFIDStandIn(20, 3, tmp_path / "a").folder()
    other = RFIDStandIn(20, 3, tmp_path / "b").folder()
    assert _digest(first) == _digest(other)
    assert _digest(first) != _digest(RFIDStandIn(20, 4, tmp_path / "a").folder())
    stamp = (first / "tx_pos.csv").stat().st_mtime_ns
    assert RFIDStandIn(20, 3, tmp_path / "a").folder() == first
    assert (first / "tx_pos.csv").stat().st_mtime_ns == stamp
    assert [p.name for p in (tmp_path / "b").iterdir()] == ["rfid-sim-20-3"]


def test_never_passes_for_the_release(tmp_path):
    data = load_rfid(RFIDStandIn(20, 0, tmp_path).folder())
    assert data.site.name == "rfid-sim" and data.site.stand_in == "rfid"
    assert data.target.max(axis=(1, 2)).min() == 255
    assert [len(part) for part in data.release_split] == [16, 4]


def test_hand_moves_like_the_release_s():
    positions = hand_moved(600, seed=0)
    assert (positions >= HAND_BOX[0] - 1e-3).all() and (positions <= HAND_BOX[1] + 1e-3).all()
    step = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert 0.008 < np.median(step) < 0.015
    assert (step < 0.04).mean() > 0.97


def test_tags_sit_on_bright_pixels_like_the_real_ones(tmp_path):
    data = load_rfid(RFIDStandIn(60, 0, tmp_path).folder())
    elevation, azimuth = boresight_degrees(data)
    assert elevation.min() > 75 and elevation.max() < 81
    pixel = data.target[np.arange(60), np.round(elevation).astype(int), np.round(azimuth).astype(int) % 360]
    assert pixel.mean() / 255 > 0.6 and 0.3 < data.target.mean() / 255 < 0.5


def test_point_source_is_brightest_in_its_pixel():
    """A far point source at elevation i, azimuth j is brightest in row i, column j."""
    grid, array = SphereGrid.hemisphere(HEIGHT, WIDTH), planar_array()
    matrix = steering(array, grid, WAVELENGTH)
    for row, column in ((60, 37), (45, 200), (70, 359), (80, 0), (50, 90)):
        elevation, azimuth = np.radians(row), np.radians(column)
        direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                              np.sin(elevation)])  # fmt: skip
        distance = np.linalg.norm(1e4 * direction - array, axis=1)
        h = np.exp(-2j * np.pi * np.mod(distance / WAVELENGTH, 1))
        image = bartlett(torch.from_numpy(h)[None], matrix).reshape(HEIGHT, WIDTH)
        assert divmod(int(image.argmax()), WIDTH) == (row, column)
        np.testing.assert_allclose(grid.directions(torch.float64)[row, column], direction, atol=1e-12)
    assert abs(LIGHT / WAVELENGTH - 920e6) < 1e6
