"""Levels between two places, neither of which was ever an end: of robots on one floor."""

import copy
from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
from both_ends import walled_floor, walled_measurements
from closed import fitted_to, read_back
from releases import real

from gsparc.base.errors import DataError
from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.distance_law import fit_law
from gsparc.models.gsparc import Gsparc
from gsparc.models.mixture.methods import Powers
from gsparc.models.per_station import wrap_per_station
from gsparc.models.powers.together.field import JointPowerField
from gsparc.models.powers.together.links import LinkPriors, links_of_others
from gsparc.models.powers.together.terms import places_and_notes, rows_of_stations
from gsparc.ops import Pose
from gsparc.prediction.answer_files import predict_file
from gsparc.prediction.predictor import Predictor
from gsparc.processes.powers import PowerRows
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

EACH, NEW = 60, 15  # rows of each transmitter's place, and places that are left out


@cache
def robots() -> Measurements:
    """Some levels of each of 73 transmitter's places."""
    with np.load(real("both-ends/robots.npz")) as stored:
        arrays = {name: stored[name] for name in ("tx_position", "rx_position", "rssi_db")}
        number = stored["tx_place"]
    rng = np.random.default_rng(0)
    chosen = [rng.permutation(np.flatnonzero(number == each))[:EACH] for each in np.unique(number)]
    rows = np.concatenate(chosen)
    places, station = np.unique(arrays["tx_position"][rows], axis=0, return_inverse=True)
    return from_arrays(
        {
            "rx_position": arrays["rx_position"][rows],
            "station_position": places,
            "station": station.reshape(-1),
            "rssi_db": arrays["rssi_db"][rows],
        },
        {"name": "robots"},
    )


@cache
def fold() -> Fold:
    data = robots()
    new = np.random.default_rng(2).permutation(len(data.site.every_station))[:NEW]
    is_new = np.isin(data.stations_of(np.arange(len(data))), new)
    return Fold(np.flatnonzero(~is_new), np.zeros(0, np.int64), np.flatnonzero(is_new))


@cache
def field() -> JointPowerField:
    return fitted_to(JointPowerField(), robots(), fold().train)[0]


def errors_db(mean: torch.Tensor, rows: np.ndarray) -> np.ndarray:
    levels = 10 * np.log10(np.stack([mean[:, 0].double().numpy(), robots().target[rows, 0]]))
    return levels[0] - levels[1]


def test_a_new_transmitter_was_told_by_the_law_alone():
    """15 places left out: 4.48 dB, where kriging over both ends had 3.94."""
    data, rows = robots(), fold().test
    prediction = field().predict(data.batch(rows))
    errors = errors_db(prediction.mean, rows)
    learned = rows_of_stations(data, fold().train, field().places)
    tested = rows_of_stations(data, rows, field().places)
    law = fit_law(PowerRows(learned.places, learned.decibels, learned.side), None)
    plain = law.mean(torch.from_numpy(tested.places)).numpy() - tested.decibels
    assert np.sqrt((errors**2).mean()) < 0.9 * np.sqrt((plain**2).mean())
    spread = prediction.variance.sqrt() / prediction.mean[:, 0] * 10 / np.log(10)
    assert 0.8 < float((np.abs(errors) < 1.645 * spread.numpy()).mean()) < 0.97


def test_no_link_of_the_same_fold_of_stations_is_among_the_nearest():
    data = robots()
    rows = rows_of_stations(data, fold().train, places_and_notes(data, fold().train)[0])
    chosen = np.arange(0, len(rows.index), 97)
    near = links_of_others(rows, rows.places, chosen, 5)
    assert not (rows.station[near] == rows.station[chosen][:, None]).any()


def test_links_are_stored_and_left_out_rows_are_those_that_were_learned():
    again, rows = read_back(field()), fold().test[::7]
    batch = robots().batch(rows)
    assert torch.allclose(again.predict(batch).mean, field().predict(batch).mean)
    few = fold().train[::50]
    left = again.left_out(few)
    assert set(left.rows) == set(few)
    assert 0 < np.sqrt((errors_db(left.mean, left.rows) ** 2).mean()) < 6


def test_errors_together_are_those_of_each_link():
    data, rows = robots(), fold().test[:40]
    places, station = torch.from_numpy(data.moving[rows]), data.stations_of(rows)[:1]
    poses = Pose(places, torch.eye(3).expand(40, 3, 3))
    alone = field().predict(Query(torch.from_numpy(field().places[station]).expand(40, 3), poses))
    joint = field().predict_joint(places[:, None], torch.from_numpy(station))
    assert torch.allclose(joint.mean[:, 0], 10 * alone.mean[:, 0].double().log10(), atol=1e-3)
    assert (joint.covariance[:, 0, 0] >= joint.noise).all()


def test_a_copy_of_each_place_refused_a_new_one():
    """From 6,000 rows on each of 73 places had a model, 76 seconds of them."""
    data = robots()
    seen = Fold(fold().train, fold().val, fold().train[:5])
    kind, why = Powers().choose_stations(data, seen, FitContext())
    assert kind == "together" and "both ends move" in why


@cache
def served() -> Predictor:
    method = wrap_per_station(Gsparc(), robots()).create_for(robots())
    method.fit(robots(), fold(), FitContext())
    return Predictor(method, robots().site)


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_a_table_of_both_ends_was_answered_for_the_known_transmitters(tmp_path, ending):
    data, rows, predictor = robots(), fold().test[:20], served()
    still = np.asarray(data.site.every_station.position)[data.stations_of(rows)]
    ends = {"tx": still + data.site.origin, "rx": data.moving[rows] + data.site.origin}
    path = tmp_path / f"links.{ending}"
    if ending == "csv":
        named = zip(ends, ends.values(), strict=True)
        table = {f"{e}_{a}": places[:, i] for e, places in named for i, a in enumerate("xyz")}
        pd.DataFrame(table).to_csv(path, index=False)
    else:
        np.savez(path, **{f"{end}_position": places for end, places in ends.items()})
    facts = predict_file(predictor, path, tmp_path / "out.csv")
    answers = pd.read_csv(tmp_path / "out.csv")
    assert facts["predict/predictions"] == len(answers) == 20
    assert np.allclose(answers.rssi_db, predictor.rssi(**ends)[:, 0], atol=1e-4)


def test_an_end_may_stand_anywhere():
    data, predictor, place = robots(), served(), np.array([-2.0, 2.0, 0.3])
    receivers = data.moving[fold().test[:20]] + data.site.origin
    alone = predictor.stand_at(place)
    assert np.allclose(alone.rssi(rx=receivers), predictor.rssi(tx=place, rx=receivers), atol=1e-4)
    assert not alone.site.several and "from (-2, 2, 0.3)" in alone.site.name
    with pytest.raises(DataError, match="there is one place"):
        alone.stand_at(place)


@cache
def walls() -> Predictor:
    """Of a floor with walls, the same either way: rows of 24 of 30 transmitter's places."""
    data = walled_measurements(1_500, 30)
    method = wrap_per_station(Gsparc(), data).create_for(data)
    known = np.flatnonzero(data.stations_of() < 24)
    method.fit(data, Fold(known, known[:0], known[:0]), FitContext())
    return Predictor(method, data.site)


def rows_of_a_new_place(start: int, stop: int) -> dict[str, np.ndarray]:
    """Some rows of one of the other six."""
    arrays, data = walled_floor(1_500, 30), walled_measurements(1_500, 30)
    rows = np.flatnonzero(data.stations_of() == 27)[start:stop]
    return {end: arrays[f"{end}_position"][rows] for end in ("tx", "rx")} | {
        "rssi": arrays["rssi_db"][rows]
    }


def missed_db(predictor: Predictor, asked: dict[str, np.ndarray]) -> float:
    level = predictor.rssi(tx=asked["tx"], rx=asked["rx"])[:, 0]
    return float(np.sqrt(((level - asked["rssi"]) ** 2).mean()))


def test_links_tell_either_way_where_stations_left_out_say_so():
    by_walls = dict(walls().method)[-1].member.link_priors
    assert by_walls.reciprocal and not field().link_priors.reciprocal


def test_rows_of_a_transmitter_at_a_new_place_were_refused():
    predictor, told, asked = walls(), rows_of_a_new_place(0, 30), rows_of_a_new_place(30, 50)
    before = missed_db(predictor, asked)
    beside = {"tx": asked["tx"][0] + [0.5, 0, 0], "rx": asked["rx"]}
    levels = predictor.rssi(**beside)
    found = predictor.update(**told)
    assert len(found.rows) == len(found.deviations) == 30 and not found.alarms
    assert missed_db(predictor, asked) < 0.95 * before
    assert np.abs(predictor.rssi(**beside) - levels).mean() > 0.2  # its neighbours follow
    at = predictor.stand_at(asked["tx"][0])
    assert np.allclose(at.rssi(rx=asked["rx"]), predictor.rssi(tx=asked["tx"], rx=asked["rx"]))
    assert np.allclose(predictor.measured["level"], told["rssi"], atol=1e-3)
    predictor.forget(found.rows)
    assert missed_db(predictor, asked) == pytest.approx(before)
    predictor.undo(2)
    assert np.array_equal(predictor.rssi(**beside), levels)


def test_known_and_new_places_are_told_in_several_calls():
    predictor, known = walls(), walled_floor(1_500, 30)
    old = {"tx": known["tx_position"][:1], "rx": known["rx_position"][:1]}
    told = rows_of_a_new_place(0, 4)
    for row in range(4):
        both = {end: np.concatenate([old[end], told[end][row : row + 1]]) for end in old}
        predictor.update(**both, rssi=np.array([known["rssi_db"][0], told["rssi"][row]]))
    number = predictor.measured["station"]
    assert len(np.unique(number)) == 2 and (np.sort(number)[:4] == -2).all()
    predictor.undo(4)


def test_a_model_without_links_says_that_a_place_is_new():
    data = walled_measurements(400, 8)
    method = wrap_per_station(Gsparc(), data).create_for(data)
    every = np.arange(len(data))
    method.fit(data, Fold(every, every[:0], every[:0]), FitContext())
    with pytest.raises(ValueError, match="a transmitter at a new place"):
        Predictor(method, data.site).update(**rows_of_a_new_place(0, 4))


def test_known_stations_of_many_gains_were_told_by_their_neighbours():
    """Another draw's 3.64 dB became 4.15: stations left out chose for known ones, too."""
    rng = np.random.default_rng(2)
    places = np.c_[rng.uniform(0, 300, (24, 2)), np.full(24, 8.0)]
    station = np.repeat(np.arange(24), 60)
    at = np.c_[rng.uniform(0, 300, (len(station), 2)), np.full(len(station), 1.5)]
    waves, phase = rng.normal(size=(24, 2, 200)) / 30, rng.uniform(0, 2 * np.pi, (24, 200))
    shadow = np.cos(np.einsum("nd,ndk->nk", at[:, :2], waves[station]) + phase[station]).sum(1)
    away = np.linalg.norm(at - places[station], axis=1)
    level = 5 * rng.normal(size=24)[station] - 30 * np.log10(away) + 0.6 * shadow
    arrays = {"rx_position": at, "station_position": places, "station": station}
    data = from_arrays({**arrays, "rssi_db": level + rng.normal(0, 1.5, len(level))}, {"name": "x"})
    order = rng.permutation(len(data))
    known, asked = np.sort(order[288:]), order[:288]
    method, _ = fitted_to(JointPowerField(), data, known)
    assert method.links is None or method.links.heard is None
    # Also where stations left out would have chosen links
    rows, prior = rows_of_stations(data, known, method.places), method.own.never
    chosen = LinkPriors(prior.known_trend, prior.kernel, prior.kernel)
    assert not method._links_tell_heard(rows, chosen)
    assert method.link_priors is not None and method.link_priors.heard is None
    own = method.predict(data.batch(asked)).mean
    method.condition(data, known)
    assert method.links is not None
    assert torch.allclose(method.predict(data.batch(asked)).mean, own)


def test_links_of_an_earlier_fit_stayed():
    data, some, method = robots(), fold().train, copy.deepcopy(field())
    few = some[np.isin(data.stations_of(some), np.unique(data.stations_of(some))[:5])]
    assert method.links is not None
    method.fit(data, Fold(few, few[:0], few[:0]), FitContext())
    assert method.links is None
