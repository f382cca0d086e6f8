"""`gsparc.fit`: three lines do what a file and a command do."""

from __future__ import annotations

import numpy as np
import pytest
from campaigns import brief, compose

import gsparc
from gsparc.commands.train import train
from gsparc.data.errors import DataError

RNG = np.random.default_rng(0)
PLACES = np.c_[RNG.uniform(0, 9, (60, 2)), np.full(60, 1.2)]
END = np.array([4.0, 4.0, 2.5])
FAR = np.linalg.norm(PLACES - END, axis=1)
POWERS = -30 - 25 * np.log10(FAR) + RNG.normal(size=60)
CHANNELS = np.exp(-2j * np.pi * FAR / 0.125) / FAR
IMAGES = RNG.integers(0, 255, (60, 8, 16), np.uint8)
KINDS = {
    "rssi": {"rssi": POWERS},
    "csi": {"csi": CHANNELS, "carrier_hz": 2.4e9, "frequency_hz": np.array([2.4e9])},
    "spectrum": {"spectrum": IMAGES},
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", ["gp", "gsparc"])
def test_arrays_of_every_kind_become_a_predictor_that_is_stored(kind, model, tmp_path):
    file = tmp_path / "model.ckpt"
    found = gsparc.fit(rx=PLACES, tx=END, model=model, budget_s=1.0, save=file, **KINDS[kind])
    again = gsparc.load(file)
    one, two = (np.asarray(getattr(each, kind)(rx=PLACES[:3])) for each in (found, again))
    assert len(one) == 3 and np.isfinite(one).all() and np.array_equal(one, two)


def test_it_is_the_model_that_the_command_trains(tmp_path):
    np.savez(tmp_path / "own.npz", rx_position=PLACES, tx_position=END, rssi_db=POWERS)
    settings = [one for one in brief(tmp_path / "own.npz") if not one.startswith("model.")]
    _, objects = train(compose(*settings, "model=gp"), tmp_path / "run")
    fold = objects.split.folds[0]
    known = np.sort(np.concatenate([fold.train, fold.val]))
    found = gsparc.fit(rx=PLACES[known], tx=END, rssi=POWERS[known], model="gp")
    asked = PLACES[fold.test]
    other = gsparc.load(objects.checkpoints[0])
    assert np.allclose(10 * np.log10(found.rssi(rx=asked) / other.rssi(rx=asked)), 0, atol=0.01)


def test_stations_are_learned_as_a_file_has_them():
    ends = np.array([[0.0, 0, 2], [9, 9, 2]])
    powers = -30 - 25 * np.log10(np.linalg.norm(PLACES[:, None] - ends, axis=2))
    found = gsparc.fit(rx=PLACES, station_position=ends, rssi=powers, model="gp")
    near = found.rssi(rx=PLACES[:5], tx=np.tile(ends[1], (5, 1)))[:, 0]
    assert np.abs(10 * np.log10(near) - powers[:5, 1]).max() < 3


@pytest.mark.parametrize("wrong, said", [
    ({"rx": PLACES[:5], "rssi": POWERS}, "^gsparc.fit, rx_position: [^;]*found .5, 3.$"),
    ({"rx": PLACES, "rssi": POWERS, "carier_hz": 1e9}, "carier_hz.*carrier_hz"),
    ({"rx": PLACES}, "one of"),
    ({"rx": PLACES, "rssi": POWERS, "model": "gps"}, "did you mean 'gp'"),
])  # fmt: skip
def test_mistakes_are_said_with_their_array(wrong, said):
    with pytest.raises((DataError, ValueError), match=said):
        gsparc.fit(tx=END, **wrong)


def test_few_names_are_public():
    assert len(gsparc.__all__) <= 15 and all(getattr(gsparc, name) for name in gsparc.__all__)
