"""Mirrored arrays against the image-source simulator: phase, amplitude, direction of arrival, search."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from known_arrays import RECEIVER, TURN, WAVELENGTH, room_vectors, walk

from gsparc.array.mirrored import MirroredArrays, mirror, rotation
from gsparc.array.search import SearchSettings, best_gains, explained, find_sources
from gsparc.data.rfid import planar_array
from gsparc.simulate.shoebox import Room, images


def _true_model(order, array):
    """Every image of the receiving array: p = s (rx - o), Q = diag(s) R."""
    found = images(Room.uniform((7.0, 5.0, 3.0), -0.6), order)
    positions = found.signs * (RECEIVER - found.offsets)
    frames = found.signs[:, :, None] * TURN
    gains = torch.from_numpy(found.gain * WAVELENGTH / (4 * np.pi))
    model = MirroredArrays(
        torch.from_numpy(array), WAVELENGTH, torch.from_numpy(positions), torch.from_numpy(frames), gains
    )
    return model, found


def test_phase_and_amplitude_are_the_simulators():
    array, tx = planar_array(), walk(20)
    vectors, _ = room_vectors(tx, 2, array)
    model, _ = _true_model(2, array)
    with torch.no_grad():
        h = model(torch.from_numpy(tx))
    np.testing.assert_allclose(h.numpy(), vectors, rtol=0, atol=1e-12 * np.abs(vectors).max())


def test_direction_of_arrival_moves_as_the_transmitters_image_does():
    tx = walk(5)
    model, found = _true_model(2, planar_array())
    seen = (found.of(tx) - RECEIVER) @ TURN
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    with torch.no_grad():
        np.testing.assert_allclose(model.arrival(torch.from_numpy(tx)).numpy(), seen, atol=1e-12)


def test_parity_follows_the_order_and_survives_turning():
    model, found = _true_model(2, planar_array(2, 2))
    with torch.no_grad():
        model.turns.normal_()
        q = model.orthogonal()
    np.testing.assert_allclose((q @ q.transpose(1, 2)).numpy(), np.eye(3)[None].repeat(len(q), 0), atol=1e-12)
    np.testing.assert_allclose(torch.linalg.det(q).numpy(), (-1.0) ** found.order, atol=1e-12)


def test_far_carrier_phase_keeps_its_digits():
    """10 km at 60 GHz: the phase of a path to a thousandth of a radian."""
    wavelength = 299_792_458.0 / 60e9
    place = torch.tensor([[10_000.0 + wavelength / 4, 0.0, 0.0]], dtype=torch.float64)
    model = MirroredArrays(
        torch.zeros(1, 3), wavelength, torch.zeros(1, 3), torch.eye(3)[None], torch.ones(1)
    )
    cycles = (10_000.0 / wavelength) % 1.0 + 0.25
    with torch.no_grad():
        turn = model(place)[0, 0] * np.exp(2j * np.pi * cycles)
    assert abs(np.angle(turn.numpy())) < 1e-3


def test_slopes():
    model, _ = _true_model(1, planar_array(2, 2))
    x = torch.from_numpy(walk(2))

    def vectors(positions, turns, gains):
        parameters = {"positions": positions, "turns": turns, "gains": gains}
        return torch.view_as_real(torch.func.functional_call(model, parameters, (x,)))

    start = [
        p.detach().clone()
        for p in (model.positions, model.turns + 0.1, model.gains / model.gains.abs().max())
    ]
    assert torch.autograd.gradcheck(vectors, [p.requires_grad_() for p in start])


def test_mirroring_in_a_wall_gives_its_image():
    rx, frame = torch.from_numpy(RECEIVER), torch.from_numpy(TURN)
    image = rx * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    expected = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)) @ frame
    torch.testing.assert_close(mirror(rx, frame, image[None])[0], expected)
    torch.testing.assert_close(rotation(torch.zeros(1, 3))[0], torch.eye(3))


def test_best_gains_need_no_phases():
    model, found = _true_model(1, planar_array())
    x = torch.from_numpy(walk(30))
    with torch.no_grad():
        unit = model(x)
    unit = unit / torch.linalg.vector_norm(unit, dim=1, keepdim=True)
    unit = unit * torch.polar(torch.ones(30, 1).double(), torch.rand(30, 1).double() * 6)
    gains, share = best_gains(model.paths(x).detach(), unit)
    ratio = gains / torch.view_as_complex(model.gains.detach())
    assert share > 0.9999
    np.testing.assert_allclose((ratio / ratio[0]).numpy(), np.ones(len(found.gain)), atol=0.02)


def test_weak_sources_are_pruned_the_direct_path_stays():
    model, _ = _true_model(1, planar_array(2, 2))
    x = torch.from_numpy(walk(4))
    with torch.no_grad():
        model.gains[3] *= 1e-4
    assert len(model.pruned(x, 1e-4).positions) == len(model.positions) - 1
    kept = model.pruned(x, 2.0)
    torch.testing.assert_close(kept.positions.detach(), model.positions.detach()[:1])


def test_search_finds_the_walls_of_a_room():
    """Arbitrary phases and scales, one direct path and six walls: most of the unseen vectors is explained."""
    array, tx = planar_array(), walk(120, step=0.015)
    vectors, _ = room_vectors(tx, 1, array)
    rng = np.random.default_rng(0)
    vectors = vectors * (rng.uniform(0.5, 2, 120) * np.exp(2j * np.pi * rng.random(120)))[:, None]
    x, y = torch.from_numpy(tx), torch.from_numpy(vectors)
    order = torch.from_numpy(rng.permutation(120))
    train, val, test = order[:70], order[70:90], order[90:]
    settings = SearchSettings(sources=9, candidates=1500, polished=12)
    receiver = (torch.from_numpy(RECEIVER), torch.from_numpy(TURN))
    model = find_sources(
        torch.from_numpy(array), WAVELENGTH, receiver, x[train], y[train], (x[val], y[val]), settings, 0
    )
    unit = y[test] / torch.linalg.vector_norm(y[test], dim=1, keepdim=True)
    direct = MirroredArrays(
        torch.from_numpy(array), WAVELENGTH, receiver[0][None], receiver[1][None], torch.ones(1)
    )
    with torch.no_grad():
        found = float(explained(model(x[test]), unit).mean())
        alone = float(explained(direct(x[test]), unit).mean())
    assert found > 0.9 and alone < 0.8


SCATTERERS = np.array([[3.5, 3.0, 1.5], [4.0, 0.8, 0.7]])


def _scattered(tx: np.ndarray) -> np.ndarray:
    """Array vectors of free space and two scatterers, written out: both legs, 1 / (d1 d2)."""
    elements = RECEIVER + planar_array() @ TURN.T
    direct = np.linalg.norm(tx[:, None] - elements[None], axis=-1)
    h = np.exp(-2j * np.pi * direct / WAVELENGTH) / direct
    before = np.linalg.norm(tx[:, None] - SCATTERERS[None], axis=-1)[:, :, None]
    after = np.linalg.norm(SCATTERERS[:, None] - elements[None], axis=-1)[None]
    return h + 0.9 * (np.exp(-2j * np.pi * (before + after) / WAVELENGTH) / before / after).sum(1)


def test_scatterers_have_two_legs_and_a_direction_of_arrival_that_stays():
    array, tx = torch.from_numpy(planar_array()), walk(6)
    places = torch.from_numpy(np.concatenate([RECEIVER[None], SCATTERERS]))
    model = MirroredArrays(
        array, WAVELENGTH, places, torch.from_numpy(TURN).expand(3, 3, 3), torch.tensor([1.0, 0.9, 0.9]),
        torch.tensor([False, True, True]),
    )  # fmt: skip
    with torch.no_grad():
        np.testing.assert_allclose(model(torch.from_numpy(tx)).numpy(), _scattered(tx), atol=1e-12)
        arrival = model.arrival(torch.from_numpy(tx)).numpy()
    assert np.ptp(arrival[:, 1:], axis=0).max() < 1e-12 < np.ptp(arrival[:, 0], axis=0).max()
    towards = (SCATTERERS - RECEIVER) @ TURN
    np.testing.assert_allclose(arrival[0, 1:], towards / np.linalg.norm(towards, axis=1)[:, None], atol=1e-12)
    kept = model.pruned(torch.from_numpy(tx), 1e-9)
    assert kept.scattering.tolist() == [False, True, True]


@pytest.mark.slow
def test_scatterers_are_proposed_where_they_are_and_not_where_walls_are():
    tx = walk(60, step=0.025)
    x, array = torch.from_numpy(tx), torch.from_numpy(planar_array())
    receiver = (torch.from_numpy(RECEIVER), torch.from_numpy(TURN))
    cut = slice(0, 48), slice(48, 60)
    settings = SearchSettings(sources=4, candidates=1500, polished=16, reach=3.0, patience=2)
    for vectors, scatter in ((_scattered(tx), True), (room_vectors(tx, 1, planar_array())[0], False)):
        v = torch.from_numpy(vectors)
        model = find_sources(
            array, WAVELENGTH, receiver, x[cut[0]], v[cut[0]], (x[cut[1]], v[cut[1]]), settings, seed=0
        )
        if scatter:
            found = model.positions.detach().numpy()[model.scattering]
            nearest = np.linalg.norm(SCATTERERS[:, None] - found[None], axis=-1).min(1)
            assert nearest.min() < 0.3 * WAVELENGTH
        else:
            assert (~model.scattering).sum() > model.scattering.sum()
