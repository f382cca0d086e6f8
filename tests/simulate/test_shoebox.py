import numpy as np
import pytest
from shoeboxes import scatter

from gsparc.data.schema import LIGHT
from gsparc.simulate.shoebox import Room, mirror_images, trace_room

ROOM = Room(
    lower=np.array([-1.0, 0.5, 0.0]),
    upper=np.array([4.0, 3.5, 2.5]),
    reflection=np.array([-0.9, -0.8, -0.7, -0.6, -0.5, 0.4j]),
)
PILLAR = np.array([[[1.0, 1.5, 0.0], [1.6, 2.1, 2.5]]])


def mirror(point, axis, wall):
    """A point mirrored in a wall across an axis."""
    return np.where(np.arange(3) == axis, 2 * wall - point, point)


def test_images_are_mirrors_in_the_walls():
    mirrored, point = mirror_images(ROOM, 2), np.array([0.2, 1.1, 0.9])
    walls = [(0, -1.0), (0, 4.0), (1, 0.5), (1, 3.5), (2, 0.0), (2, 2.5)]
    wanted = [
        (mirror(point, *wall), gain) for wall, gain in zip(walls, ROOM.reflection, strict=True)
    ]
    # In the high wall, then in the low one
    wanted += [(mirror(mirror(point, 0, 4.0), 0, -1.0), 0.9 * 0.8)]
    for place, gain in wanted:
        nearest = np.linalg.norm(mirrored.mirror_points(point) - place, axis=1).argmin()
        np.testing.assert_allclose(mirrored.mirror_points(point)[nearest], place)
        assert mirrored.gain[nearest] == pytest.approx(gain)


@pytest.mark.parametrize("occluders", [np.zeros((0, 2, 3)), PILLAR])
def test_reciprocity(occluders):
    room = Room(ROOM.lower, ROOM.upper, ROOM.reflection, occluders)
    tx, rx = scatter(room, 40, seed=0), scatter(room, 40, seed=1)
    there = trace_room(room, tx, rx, 2.4e9, max_order=3).csi
    np.testing.assert_allclose(
        trace_room(room, rx, tx, 2.4e9, max_order=3).csi, there, rtol=1e-9, atol=1e-15
    )


def test_line_of_sight_amplitude_phase_and_delay():
    frequency = np.array([2.40e9, 2.41e9])
    csi = trace_room(
        ROOM, np.array([0.0, 1, 1]), np.array([[3.0, 1, 1], [2.0, 1, 1]]), frequency, max_order=0
    ).csi
    distance = np.array([3.0, 2.0])[:, None]
    expected = (
        LIGHT
        / frequency
        / (4 * np.pi * distance)
        * np.exp(-2j * np.pi * frequency * distance / LIGHT)
    )
    np.testing.assert_allclose(csi[:, 0], expected, rtol=1e-9)


def test_moving_transmitter_sees_a_mirrored_array():
    array = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    tx, rx = scatter(ROOM, 10, seed=4), np.array([3.0, 2.0, 1.2])
    traced = trace_room(ROOM, tx, rx, 2.4e9, max_order=2, array=array)
    mirrored = traced.images.mirror_points(
        rx + array
    )  # (A, I, 3): images of the elements, not of the transmitter
    distance = np.linalg.norm(tx[:, None, None] - mirrored, axis=-1)
    k = 2 * np.pi * 2.4e9 / LIGHT
    expected = (
        (traced.images.gain * np.exp(-1j * k * distance) / distance).sum(-1)
        * LIGHT
        / 2.4e9
        / (4 * np.pi)
    )
    np.testing.assert_allclose(traced.csi[:, :, 0], expected, rtol=1e-9)


def test_noise_level_and_seed():
    tx, rx = np.array([0.0, 1, 1]), scatter(ROOM, 400, seed=5)
    clean = trace_room(ROOM, tx, rx, 2.4e9)
    noisy = trace_room(ROOM, tx, rx, 2.4e9, snr_db=20, seed=1)
    ratio = np.mean(np.abs(clean.csi) ** 2) / np.mean(np.abs(noisy.csi - clean.csi) ** 2)
    assert 10 * np.log10(ratio) == pytest.approx(20, abs=0.7)
    np.testing.assert_array_equal(noisy.csi, trace_room(ROOM, tx, rx, 2.4e9, snr_db=20, seed=1).csi)
