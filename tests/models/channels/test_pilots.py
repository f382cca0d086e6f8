"""Channels heard after the fit: as if they had been learned from, up to a factor of their run."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from ceilings import ceiling, tied
from refusals import refused

import gsparc
from gsparc.models.channels.pilots import KEPT, HeardField

TURN = 0.7 * np.exp(2.1j)


def _rows(data, learned):
    """Rows of places before and after, of all ends."""
    place = np.unique(data.tx, axis=0, return_inverse=True)[1].reshape(-1)
    return np.flatnonzero(place < learned), np.flatnonzero(place >= learned)


def _values(data, rows):
    return torch.from_numpy(data.target[rows]).to(torch.complex128)


def _check_like_rows(heard, data, before, told, asked):
    """Answers are those of a field conditioned on the pilots, each in the phase of the fit."""
    same = data.target.copy()
    same[told] = heard.values.numpy()
    whole = tied(data, before)
    whole.condition(replace(data, target=same), np.r_[before, told])
    answer, wanted = heard.predict(data.batch(asked)), whole.predict(data.batch(asked))
    torch.testing.assert_close(answer.mean, wanted.mean * heard.run_factor, rtol=1e-3, atol=1e-3)


def test_pilots_are_as_good_as_rows():
    data = ceiling(ends=3, count=60)
    before, later = _rows(data, 40)
    told, asked = later[: len(later) // 2], later[len(later) // 2 :]
    field = tied(data, before)
    heard = HeardField(field, data.batch(told), TURN * _values(data, told))
    _check_like_rows(heard, data, before, told, asked)
    again = HeardField(field, data.batch(told), _values(data, told))
    assert abs(heard.run_factor / again.run_factor - TURN) < 1e-6
    assert (
        heard.predict(data.batch(asked)).variance
        < field.predict(data.batch(asked)).variance * abs(heard.run_factor) ** 2 * 1.001
    ).all()


def test_runs_that_come_later_keep_their_own_factors():
    data = ceiling(ends=3, count=60)
    before, later = _rows(data, 40)
    told, more = np.array_split(later, 2)
    field = tied(data, before)
    first = HeardField(field, data.batch(told), _values(data, told))
    both = HeardField(field, data.batch(more), TURN * _values(data, more), first)
    torch.testing.assert_close(both.values[: len(told)], first.values)
    _check_like_rows(both, data, before, later, later)
    many = HeardField(field, data.batch(np.tile(later, 20)), _values(data, np.tile(later, 20)))
    assert torch.bincount(many.ends.station).max() == KEPT
    assert max(len(slot.heard) for slot in many.told.values()) == KEPT


def test_a_run_is_known_by_pilots_of_earlier_runs_too():
    """Where the fit knows little, runs that share places differ by their factor."""
    data = ceiling(ends=3, count=60)
    before, later = _rows(data, 5)
    field, again = tied(data, before), later[::6]
    first = HeardField(field, data.batch(later), _values(data, later))
    turned = data.batch(again), TURN * _values(data, again)
    for told, error in ((first, (0, 0.1)), (None, (0.1, 10))):
        factor = HeardField(field, *turned, told).run_factor / first.run_factor
        assert error[0] < abs(factor / TURN - 1) < error[1]


@pytest.fixture(scope="module")
def predictor():
    data = ceiling(ends=3, count=60)
    place = np.unique(data.tx, axis=0)
    heard = np.stack([data.target[data.station == number][:, 0, 0] for number in range(3)], 1)
    places = data.tx[data.station == 0] + data.site.origin
    assert len(place) == len(places)
    stations = data.site.stations.position + data.site.origin
    known = {"station_position": stations, "frequency_hz": [2.4e9], "align": "none"}
    return gsparc.fit(tx=places[:40], csi=heard[:40], **known), places, heard


def test_a_predictor_hears_all_stations_or_one(predictor):
    model, places, heard = predictor
    pilots = np.where(np.arange(60)[:, None] % 7 == 0, np.nan, heard)[40:50, :, None, None] * TURN
    told = model.hear(tx=places[40:50], csi=pilots)
    assert told is not model and told.csi(tx=places[50:]).shape == (10, 3, 1, 1)

    def missed(channels, factor):
        return np.abs(channels[..., 0, 0] - factor * heard[50:]).mean()

    assert missed(told.csi(tx=places[50:]), TURN) < missed(model.csi(tx=places[50:]), 1) * abs(TURN)
    assert told.std(tx=places[45]).mean() < model.std(tx=places[45]).mean()
    one = model.select_station(1).hear(tx=places[40:50], csi=heard[40:50, 1, None, None])
    assert one.csi(tx=places[50:]).shape == (10, 1, 1)


def test_who_cannot_hear_says_who_can(predictor):
    model, places, heard = predictor
    few = {"tx": places[:2], "csi": heard[:2, :2]}
    refused(r"csi is of shape \(2, 2\), expected \(2, 3, 1, 1\)", model.hear, **few)
    free = replace(model.site, unknown_factor="phase")
    refused("known up to", gsparc.Predictor(model.method, free).hear, **few)
    refused(r"hear\(\) takes channels", model.update, tx=places[:1], rssi=[-50.0])
    one = {"tx": places, "rx": [0.0, 0.0, 2.0], "csi": heard[:, 0], "frequency_hz": [2.4e9]}
    told = {"tx": places[:1], "csi": heard[:1, 0]}
    refused("model=channels does", gsparc.fit(**one, model="nearest").hear, **told)
    does = gsparc.fit(**one, model="channels", align="none")  # as it was told
    does.method.doubt = 4.0  # stated variances were too small
    wider = does.hear(**told).std(tx=places[5:9]) / does.std(tx=places[5:9])
    assert (wider <= abs(does.hear(**told).method.run_factor) * 1.001).all() and wider.max() > 0.5
