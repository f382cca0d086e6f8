"""`gsparc.fit`: three lines do what a file and a command do."""

import logging

import numpy as np
import pytest
from campaigns import plain
from refusals import refused

import gsparc
from gsparc.base.errors import DataError
from gsparc.commands.train import train

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


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", ["gp", "gsparc"])
def test_arrays_of_every_kind_become_a_predictor_that_is_stored(kind, model, tmp_path):
    file = tmp_path / "model.ckpt"
    found = gsparc.fit(rx=PLACES, tx=END, model=model, effort=0.1, save=file, **KINDS[kind])
    assert " on arrays; " in repr(found)  # and not on gsparc
    again = gsparc.load(file)
    one, two = (np.asarray(getattr(each, kind)(rx=PLACES[:3])) for each in (found, again))
    assert len(one) == 3 and np.isfinite(one).all() and np.array_equal(one, two)


def test_it_is_the_model_that_the_command_trains(tmp_path):
    np.savez(tmp_path / "own.npz", rx_position=PLACES, tx_position=END, rssi_db=POWERS)
    _, objects = train(plain(tmp_path / "own.npz", "gp"), tmp_path / "run")
    fold = objects.split.folds[0]
    known = np.sort(np.concatenate([fold.train, fold.val]))
    found = gsparc.fit(rx=PLACES[known], tx=END, rssi=POWERS[known], model="gp")
    asked = PLACES[fold.test]
    other = gsparc.load(objects.checkpoints[0])
    assert np.allclose(found.rssi(rx=asked), other.rssi(rx=asked), atol=0.01)
    assert (found.unit, other.unit) == ("dBm", "dB")


def test_stations_are_learned_as_a_file_has_them():
    ends = np.array([[0.0, 0, 2], [9, 9, 2]])
    powers = -30 - 25 * np.log10(np.linalg.norm(PLACES[:, None] - ends, axis=2))
    found = gsparc.fit(rx=PLACES, station_position=ends, rssi=powers, model="gp")
    near = found.rssi(rx=PLACES[:5], tx=np.tile(ends[1], (5, 1)))
    assert np.abs(near[:, 0] - powers[:5, 1]).max() < 3
    every = found.rssi(rx=PLACES[:5])
    assert every.shape == found.std(rx=PLACES[:5]).shape == (5, 2)
    assert np.array_equal(every[:, 1:], near) and found.rssi(rx=PLACES[0]).shape == (2,)


@pytest.mark.parametrize("count", [2, 3])
def test_places_of_stations_given_as_an_end_were_refused_by_their_shape_alone(count):
    wrong = {"tx": PLACES[:count], "rssi": np.tile(POWERS[:, None], count)}
    said = f"gsparc.fit: tx and rssi are of {count} stations: say station_position= in place of tx="
    with pytest.raises(DataError, match=f"^{said}$"):
        gsparc.fit(rx=PLACES, **wrong)


UNITS = {
    "dBm": lambda level: level,
    "dBW": lambda level: level - 30,
    "mW": lambda level: 10 ** (level / 10),
}
UNITS |= {"W": lambda level: 10 ** (level / 10 - 3), "pW": lambda level: 10 ** (level / 10 + 9)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "several"), [("gp", False), ("gp", True), ("gsparc", True), ("kriging", False)]
)
def test_powers_in_dbm_were_answered_in_milliwatts(model, several, tmp_path):
    """An error of 57 dB for who takes units to come back: now one field,
    answered in each unit to 1e-4 dB.
    """
    ends = np.array([[0.0, 0, 2], [9, 9, 2]])
    where = {"station_position": ends} if several else {"tx": END}
    level = np.c_[POWERS, np.roll(POWERS, 7)] if several else POWERS
    asked, answers = PLACES[:6] + 0.2, {}
    for unit in UNITS if model == "gp" else ("dBm", "W"):
        found = gsparc.fit(
            rx=PLACES,
            rssi=UNITS[unit](level),
            unit=unit,
            model=model,
            save=tmp_path / "m.ckpt",
            **where,
        )
        again = gsparc.load(tmp_path / "m.ckpt")
        assert (
            found.unit == again.unit == unit
            and gsparc.load(tmp_path / "m.ckpt", unit="dBm").unit == "dBm"
        )
        assert np.array_equal(found.rssi(rx=asked), again.rssi(rx=asked))
        assert np.array_equal(found.std(rx=asked), again.std(rx=asked))
        answers[unit] = (
            found.rssi(rx=asked),
            *(ask(rx=asked, unit="dBm") for ask in (found.rssi, found.std)),
        )
        for other, back in UNITS.items():
            there = found.rssi(rx=asked, unit=other)
            np.testing.assert_allclose(there, back(answers[unit][1].astype(float)), rtol=3e-5)
    own, dbm, std = answers["dBm"]
    assert own.shape == std.shape == (6, 1 + several) and (std > 0).all()
    assert np.array_equal(own, dbm) and np.abs(own - level[:6].reshape(own.shape)).max() < 12
    for unit, (_, other, spread) in answers.items():
        assert np.abs(other - dbm).max() <= 1e-4 and np.abs(spread - std).max() <= 1e-4, unit


def test_decibels_of_no_known_reference_and_linear_powers_come_back():
    found = gsparc.fit(rx=PLACES, tx=END, rssi=POWERS, unit="dB", model="gp")
    plain = gsparc.fit(rx=PLACES, tx=END, rssi=10 ** (POWERS / 10), unit="linear", model="gp")
    said = plain.rssi(rx=PLACES[0])
    assert (found.unit, plain.unit) == ("dB", "linear")
    assert np.allclose(10 * np.log10(said), found.rssi(rx=PLACES[0]), atol=1e-4)
    assert np.allclose(said, found.rssi(rx=PLACES[0], unit="linear"), rtol=3e-5)
    refused("unit=W: of powers in dB expected dBm, dBW, linear", found.rssi, rx=PLACES[0], unit="W")
    with pytest.raises(ValueError, match="unit=dBm: goes with powers, not with csi"):
        gsparc.fit(rx=PLACES, tx=END, model="mean", **KINDS["csi"]).std(rx=PLACES[0], unit="dBm")


def test_noise_goes_with_its_unit():
    noise = np.full(60, 1e-10)
    scales = [
        gsparc.fit(
            rx=PLACES,
            tx=END,
            rssi=10 ** (POWERS / 10) * by,
            unit=unit,
            noise_variance=noise * by**2,
            model="gp",
        ).rssi(rx=PLACES[0], unit="dBm")
        for unit, by in (("mW", 1.0), ("W", 1e-3))
    ]
    assert abs(scales[0] - scales[1]) < 1e-4


def test_a_station_with_too_few_rows_is_nan_among_the_others():
    powers = np.c_[POWERS, np.where(np.arange(60) == 3, POWERS, np.nan)]
    ends = np.array([[0.0, 0, 2], [9, 9, 2]])
    found = gsparc.fit(rx=PLACES, station_position=ends, rssi=powers, model="gp")
    for answer in (found.rssi(rx=PLACES[:2]), found.std(rx=PLACES[:2])):
        assert np.isfinite(answer[:, 0]).all() and np.isnan(answer[:, 1]).all()


def test_methods_without_deviations_say_so():
    found = gsparc.fit(rx=PLACES, tx=END, rssi=POWERS, model="nearest")
    refused("nearest states no deviations", found.std, rx=PLACES[0])


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"rx": PLACES, "rssi": POWERS, "unit": "dBi"}, "unit=dBi"),
        ({"rx": PLACES, "rssi": POWERS, "unit": "mW"}, "rssi.*linear power, at least 0"),
        ({"rx": PLACES, "rssi": POWERS, "unit": None}, "unit=None"),  # were taken for dBW
        ({"rx": PLACES, "rssi": POWERS.astype(str), "unit": "mW"}, "rssi: expected real numbers"),
        ({"rx": PLACES[:5], "rssi": POWERS}, "^gsparc.fit, rx_position: [^;]*found .5, 3.$"),
        ({"rx": PLACES, "rssi": POWERS, "carier_hz": 1e9}, "carier_hz.*carrier_hz"),
        (
            {"rx": PLACES, "csi": np.ones((60, 2), complex), "carrier_hz": 1e9},
            "or say frequency_hz=",
        ),
        ({"rx": PLACES}, "one of"),
        ({"rx": PLACES, "rssi": POWERS, "model": "gps"}, "did you mean 'gp'"),
    ],
)
def test_mistakes_are_said_with_their_array(wrong, said):
    with pytest.raises((DataError, ValueError), match=said):
        gsparc.fit(tx=END, **wrong)


def test_two_rows_stated_a_deviation_without_a_word(caplog):
    """.11 dB of a model of two rows."""
    places = np.random.default_rng(0).uniform(0, 9, (12, 3))
    gsparc.fit(rx=places, tx=[20.0, 3, 2], rssi=-60 - places[:, 0], model="gp")
    assert "too few to tell errors" not in caplog.text
    gsparc.fit(rx=places[:2], tx=[20.0, 3, 2], rssi=-60 - places[:2, 0], model="gp")
    assert "2 places to learn from are too few to tell errors" in caplog.text


def test_the_mask_of_an_array_was_thrown_away():
    masked = np.ma.array(POWERS, mask=np.arange(60) % 3 == 0)
    kept = ~masked.mask
    one = gsparc.fit(rx=PLACES, tx=END, rssi=masked, model="gp")
    other = gsparc.fit(rx=PLACES[kept], tx=END, rssi=POWERS[kept], model="gp")
    assert np.allclose(one.rssi(rx=PLACES[:5]), other.rssi(rx=PLACES[:5]), atol=1e-3)


@pytest.mark.parametrize(
    "rssi, says",
    [
        (np.full(60, -60.0), "levels differ by 0 dB in all"),
        (-np.round(POWERS), "is below 0: losses"),
        (POWERS, "in kilometres?"),
    ],
)
def test_arrays_were_not_asked_what_files_are(rssi, says, caplog):
    """`gsparc.fit` answered -60 +- 3e-9 dB, and losses as levels, without a word;
    runs of files say so.
    """
    places = PLACES / (1e4 if "kilometres" in says else 1)
    gsparc.fit(
        rx=places, tx=END / (1e4 if "kilometres" in says else 1), rssi=rssi, model="distance_law"
    )
    assert says in caplog.text


def test_nan_of_a_station_with_too_few_rows_left_without_a_word(caplog):
    powers = np.stack([POWERS, np.where(np.arange(60) == 3, POWERS, np.nan)], 1)
    ends = np.array([END, END + 1])
    found = gsparc.fit(rx=PLACES, station_position=ends, rssi=powers, model="gp")
    assert np.isnan(found.rssi(rx=PLACES[0])).tolist() == [False, True]
    assert "answers are NaN, of fewer than 4 rows: station 1" in caplog.text


def test_a_fit_of_minutes_said_nothing(monkeypatch, capsys):
    """Who shows the log sees each line once; who does not, as long as the fit takes."""
    known = {"rx": PLACES, "tx": END, "rssi": POWERS, "model": "gsparc", "effort": 0.1}
    gsparc.fit(**known)
    assert not capsys.readouterr().err
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    shown = logging.getLogger("gsparc")
    before = shown.level, [*shown.handlers]
    gsparc.fit(**known)
    assert "cost: " in capsys.readouterr().err and before == (shown.level, shown.handlers)
