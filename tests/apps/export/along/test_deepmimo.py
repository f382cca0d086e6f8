"""A scenario of DeepMIMO, read back as its loader reads it: channels,
and geometry of a known mirror.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from gsparc.apps.export.along import deepmimo
from gsparc.data.schema import LIGHT, Site
from gsparc.prediction.channels import Paths

CARRIER = 3.5e9
STILL = np.array([100.0, 50, 8])
WALL = 120.0  # a mirror in x


class Mirror:
    site = Site(
        "mirror",
        "csi",
        "tx",
        None,
        None,
        CARRIER,
        None,
        np.array([100.0, 50, 0]),
        static_position=np.array([0.0, 0, 8]),
    )

    def paths(self, rx):
        sources = np.array([STILL, [2 * WALL - STILL[0], STILL[1], STILL[2]], [0, 0, 0]])
        away = sources - rx[:, None]
        far = np.linalg.norm(away, axis=-1)
        gain = 1e-2 / far * np.exp(-2j * np.pi * CARRIER * far / LIGHT) * [1, 0.5, 0]
        return Paths(
            gain[:, None].astype(np.complex64),
            far[:, None] / LIGHT,
            CARRIER,
            None,
            away / far[..., None],
        )


PLACES = np.array([[110.0, 60, 1.5], [95.0, 41, 2.0]])


@pytest.fixture
def scenario(tmp_path):
    """By the names that DeepMIMO's loader makes: `{key}_t{set}_tx{index}_r{set}.npz`,
    one array called so.
    """
    assert deepmimo.write_scenario(tmp_path, Mirror(), PLACES)[0] == 2
    names = [*"power phase delay aoa_az aoa_el aod_az aod_el inter inter_pos rx_pos tx_pos".split()]  # noqa: SIM905
    held = {name: np.load(tmp_path / f"{name}_t000_tx000_r001.npz")[name] for name in names}
    return json.loads((tmp_path / "params.json").read_text()), held


def test_channels_of_the_scenario_are_the_models(scenario):
    params, held = scenario
    sends, receives = params["txrx_sets"].values()
    assert sends["is_tx"] and receives["is_rx"] and receives["num_points"] == 2
    assert params["scene"]["num_scenes"] == 1 and params["rt_params"]["frequency"] == CARRIER
    shift = np.array([-5e6, 0, 7e6])
    gain = 10 ** (held["power"] / 20) * np.exp(1j * np.radians(held["phase"]))
    turned = np.exp(-2j * np.pi * shift * held["delay"][..., None]) * gain[..., None]
    expected = Mirror().paths(PLACES).channel(CARRIER + shift)[:, 0] * (CARRIER + shift) / CARRIER
    np.testing.assert_allclose(np.nansum(turned, 1), expected, rtol=2e-4)
    assert np.isnan(held["power"][:, 2:]).all()  # a path without power is none


def unit(azimuth, zenith):
    azimuth, zenith = np.radians(azimuth), np.radians(zenith)
    return np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1
    )


def towards(start, end):
    return (end - start) / np.linalg.norm(end - start, axis=1)[:, None]


def test_places_in_utm_metres_were_rounded_to_half_a_metre(tmp_path, monkeypatch):
    utm = np.array([447_000.25, 4_500_000.25, 0])
    monkeypatch.setattr(Mirror, "site", replace(Mirror.site, origin=Mirror.site.origin + utm))
    monkeypatch.setattr(Mirror, "paths", lambda self, rx, paths=Mirror.paths: paths(self, rx - utm))
    deepmimo.write_scenario(tmp_path, Mirror(), PLACES + utm)
    at, still, meets = (
        np.load(tmp_path / f"{name}_t000_tx000_r001.npz")[name]
        for name in ("rx_pos", "tx_pos", "inter_pos")
    )
    np.testing.assert_allclose(at, PLACES + utm, rtol=0, atol=1e-6)
    np.testing.assert_allclose(still[0], STILL + utm, rtol=0, atol=1e-6)
    np.testing.assert_allclose(meets[:, 1, 0, 0], WALL + utm[0], rtol=0, atol=1e-3)


def test_a_mirror_is_found_where_it_is(scenario):
    _, held = scenario
    np.testing.assert_array_equal(held["inter"][:, :2], [[0, 1], [0, 1]])
    point = held["inter_pos"][:, 1, 0]
    np.testing.assert_allclose(point[:, 0], WALL, atol=1e-3)
    whole = np.linalg.norm(point - STILL, axis=1) + np.linalg.norm(point - PLACES, axis=1)
    np.testing.assert_allclose(whole, held["delay"][:, 1] * LIGHT, rtol=1e-5)
    leaves, arrives = (unit(held[f"{name}_az"], held[f"{name}_el"]) for name in ("aod", "aoa"))
    for path, at in ((0, PLACES), (1, point)):
        np.testing.assert_allclose(leaves[:, path], towards(STILL, at), atol=1e-4)
    np.testing.assert_allclose(arrives[:, 1], towards(PLACES, point), atol=1e-4)


@pytest.mark.parametrize("end", ["rx", "tx"])
def test_all_antennas_but_the_first_were_left_out(end, tmp_path, monkeypatch):
    """Of what stands each is a transmitter, of what moves a set of receivers."""
    array = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    site = replace(Mirror.site, static_end=end, array=array)
    monkeypatch.setattr(Mirror, "site", site)
    turn = np.array([1, 1j, -1])[:, None]
    one = Mirror().paths(PLACES)
    every = replace(one, gain=one.gain * turn, delay_s=one.delay_s + np.zeros((3, 1)))
    monkeypatch.setattr(Mirror, "paths", lambda self, **places: every)
    deepmimo.write_scenario(tmp_path, Mirror(), PLACES)
    params = json.loads((tmp_path / "params.json").read_text())
    labels = {"rx": "t000_tx{}_r001", "tx": "t000_tx000_r{}"}[end]
    for antenna in range(3):
        label = labels.format(f"{antenna + (end == 'tx'):03d}")
        held = {
            name: np.load(tmp_path / f"{name}_{label}.npz")[name]
            for name in ("phase", "rx_pos", "tx_pos")
        }
        wanted = np.degrees(np.angle(every.gain[:, antenna, :2]))
        np.testing.assert_allclose(held["phase"][:, :2], wanted, atol=1e-3)
        still, places = STILL, PLACES
        still, places = (
            (still + array[antenna], places) if end == "rx" else (still, places + array[antenna])
        )
        np.testing.assert_allclose(held["tx_pos"][0], still)
        np.testing.assert_allclose(held["rx_pos"], places)
    points = [about["num_points"] for about in params["txrx_sets"].values()]
    assert points == ([3, 2] if end == "rx" else [1, 2, 2, 2])


def test_a_scenario_without_materials_and_objects_could_not_be_printed(scenario, tmp_path):
    params, _ = scenario
    assert [material["name"] for material in params["materials"].values()] == ["ground"]
    (plane,) = json.loads((tmp_path / "objects.json").read_text())
    corners = np.load(tmp_path / "vertices.npz")["vertices"][plane["face_vertex_idxs"][0]]
    assert params["scene"]["n_objects"] == 1 and (corners[:, 2] < PLACES[:, 2].min()).all()
    assert (corners[:, :2].min(0) < PLACES[:, :2].min(0)).all()
