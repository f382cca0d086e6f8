"""The stand-in for Argos: its physics, its offsets, its layout."""

import numpy as np

from gsparc.data.schema import LIGHT
from gsparc.simulate.argos_sim import (
    CARRIER_HZ,
    SPACING_HZ,
    TONES,
    Offsets,
    simulate_snapshots,
    simulate_world,
)
from gsparc.simulate.streets import Streets, trace_streets


def _street(buildings: list, **more) -> Streets:
    none = {
        "scatterers": np.zeros((0, 3)),
        "cross_section": np.zeros(0),
        "scatterer_phase": np.zeros(0),
    }
    boxes = np.array(buildings, dtype=float).reshape(-1, 2, 2)
    return Streets(
        boxes, np.full(len(boxes), -0.7), base=np.array([0.0, 0.0, 5.0]), **{**none, **more}
    )


def test_free_space_is_friis() -> None:
    users = np.array([[30.0, 40.0, 5.0]])
    rays = trace_streets(_street([], ground=0.0), users, 0.125)
    assert np.isclose(np.abs(rays.gain).max(), 0.125 / (4 * np.pi * 50))
    assert np.isclose(rays.delay[0, np.abs(rays.gain[0]).argmax()], 50 / LIGHT)


def test_wall_makes_an_image() -> None:
    """A wall at y = 10 to 20: the user at (20, 0) hears the mirrored base at (0, 20) through it."""
    rays = trace_streets(
        _street([[[-50, 10], [50, 20]]], ground=0.0), np.array([[20.0, 0.0, 5.0]]), 0.125
    )
    strength = np.sort(np.abs(rays.gain[0]))[::-1]
    assert np.isclose(strength[0], 0.125 / (4 * np.pi * 20))
    assert np.isclose(strength[1], 0.7 * 0.125 / (4 * np.pi * np.hypot(20, 20)))
    assert strength[2] == 0


def test_building_blocks_and_its_corner_diffracts() -> None:
    """By Keller's coefficient of a half-plane, from the corner at (8, 2)."""
    streets, user, corner = (
        _street([[[8, -10], [12, 2]]], ground=0.0),
        np.array([16, 2.5]),
        np.array([8, 2]),
    )
    behind = trace_streets(streets, np.array([[*user, 5.0]]), 0.125)
    assert streets.are_blocked(np.zeros((1, 2)), user[None])[0]
    near, far = np.linalg.norm(corner), np.linalg.norm(user - corner)
    bend = np.arccos(corner @ (user - corner) / near / far)
    keller = 1 / (2 * np.sqrt(2 * np.pi * 2 * np.pi / 0.125) * np.sin(bend / 2))
    expected = 0.125 / (4 * np.pi) * keller / np.sqrt(near * far * (near + far))
    assert np.isclose(np.abs(behind.gain).max(), expected, rtol=1e-2)


def test_offsets_are_a_switch() -> None:
    there = simulate_world(40, seed=0)
    clean = there.response(CARRIER_HZ + TONES * SPACING_HZ)
    still = simulate_snapshots(there, Offsets(0.0, 0.0, 0.0))
    noise = np.abs(still - clean) ** 2
    assert np.isclose(noise.mean(), there.noise_power, rtol=0.02)
    turned = simulate_snapshots(there, Offsets(1.0, 0.0, 0.0))
    angle = np.angle((turned * clean.conj()).sum((1, 2)))
    assert np.ptp(angle) > 3
    assert np.ptp(np.angle((still * clean.conj()).sum((1, 2)))) < 0.1
