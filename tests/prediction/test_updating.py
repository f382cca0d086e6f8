"""A predictor that is told of later rows, and goes back."""

import inspect
import time

import numpy as np
import pytest
import torch
from refusals import refused
from rooms_later import PLACES, SCREENED, draw, levels, truth

import gsparc
from gsparc.prediction.later_rows import read_level_arrays
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.updating import VERSIONS, read_versions, versions_extra
from gsparc.processes import factor

POST = {"tx": [9.0, 9.0, 2.6], "model": "gp"}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    file = tmp_path_factory.mktemp("room") / "model.ckpt"
    gsparc.fit(rx=PLACES, rssi=levels(PLACES, 0), **POST, save=file)
    return file


@pytest.fixture
def predictor(fitted):
    return gsparc.load(fitted)


def changed(count, seed=5):
    near = draw(40 * count, seed)
    near = near[np.linalg.norm(near[:, :2] - 5, axis=1) < 5][:count]
    return {"rx": near, "rssi": levels(near, seed, change=-12.0)}


def miss(predictor, places=SCREENED, **world):
    return float(np.sqrt(np.mean((predictor.rssi(rx=places)[:, 0] - truth(places, **world)) ** 2)))


def test_twenty_rows_of_a_changed_part_undo_most_of_the_error(predictor):
    before = miss(predictor, change=-12.0)
    found = predictor.update(**changed(20))
    assert len(found.rows) == len(found.deviations) == 20 and found.alarms
    assert miss(predictor, change=-12.0) < 0.35 * before
    assert predictor.std(rx=SCREENED).mean() < 6  # still a statement


def test_many_rows_of_before_hid_what_a_whole_map_lost(predictor):
    """After 400 rows of a world without change, 20 of one that lost 6 dB left 4.4 dB of error."""
    before, after, asked = draw(400, 8), draw(20, 9), draw(300, 10)
    predictor.update(rx=before, rssi=levels(before, 8))
    (alarm,) = predictor.update(rx=after, rssi=levels(after, 9, offset=-6.0)).alarms
    assert alarm.kind == "offset" and len(predictor.rows) <= 20
    assert miss(predictor, asked, offset=-6.0) < 1.7


def test_levels_that_an_older_file_moved_by_hand_are_not_lost_in_silence(predictor):
    predictor.update(**changed(10))
    extra = versions_extra(predictor.versions)
    assert read_versions(extra)[-1].changes.next_number == 10
    state = extra["updates"][-1]["state"]["changes"]["state"]
    state["rows"][0][1]["state"]["faded"] = torch.zeros(10)
    state["shifts"] = []
    del state["new"]  # files of before links
    assert read_versions(extra)[-1].changes.next_number == 10
    state["shifts"] = [[0, -3.0, 10]]
    refused("levels were moved by `shift`", read_versions, extra)


def test_a_phone_that_reads_with_more_noise_is_no_change_after_change(predictor):
    """Maps state the noise of their own survey: another phone's raised alarm after alarm."""
    at, rng = draw(300, 8), np.random.default_rng(1)
    for part in np.split(np.arange(300), 15):
        predictor.update(rx=at[part], rssi=levels(at, 8)[part] + rng.normal(0, 4, 20))
    assert len(predictor.alarms) <= 2


def test_rows_of_the_same_world_change_next_to_nothing(predictor):
    asked = draw(400, 3)
    before = miss(predictor, asked)
    predictor.update(rx=draw(30, 8), rssi=levels(draw(30, 8), 8))
    assert miss(predictor, asked) < 1.01 * before


def test_ten_updates_and_ten_undos_are_bit_identical(predictor):
    before = predictor.predict(rx=SCREENED)
    for turn in range(10):
        predictor.update(**changed(3, turn))
    assert len(predictor.rows) == 30 and len(predictor.versions) == VERSIONS
    for _ in range(10):
        predictor.undo()
    after = predictor.predict(rx=SCREENED)
    assert (after.mean == before.mean).all() and (after.variance == before.variance).all()
    refused("undo: 1 back, 0 are kept", predictor.undo)


def test_forgotten_rows_say_nothing(predictor):
    before = predictor.rssi(rx=SCREENED)
    found = predictor.update(**changed(10))
    predictor.forget(found.rows[:4])
    assert predictor.rows.tolist() == found.rows[4:].tolist()
    predictor.forget(predictor.rows)
    assert np.array_equal(predictor.rssi(rx=SCREENED), before)
    refused("has number 99", predictor.forget, [99])


def test_the_window_keeps_the_last_rows_as_they_were_measured(predictor):
    rows = changed(30)
    predictor.update(**rows, window=12)
    kept = predictor.measured
    assert kept["number"].tolist() == list(range(18, 30))
    assert np.allclose(kept["place"], rows["rx"][18:]) and np.allclose(
        kept["level"], rows["rssi"][18:]
    )


def test_no_factor_of_all_rows_is_made(predictor, monkeypatch):
    predictor.rssi(rx=SCREENED[:1])
    sizes, make = [], factor._cholesky
    monkeypatch.setattr(
        factor, "_cholesky", lambda gram, *rest: sizes.append(gram.shape[-1]) or make(gram, *rest)
    )
    predictor.update(**changed(5))
    assert sizes and max(sizes) < 100 < len(PLACES)


def test_a_refit_finds_that_a_change_is_small(predictor):
    """A screen of 3 m in a room of 20 m: at lengths as they are, it was smoothed over 5 m."""
    narrow = lambda at: np.linalg.norm(at[:, :2] - 5, axis=1) < 1.5  # noqa: E731
    near, asked, misses = changed(60)["rx"], changed(400, 9)["rx"], []
    told = levels(near, 5) - 12 * narrow(near)
    for refit in (False, True):
        predictor.update(rx=near, rssi=told, refit=refit)
        error = predictor.rssi(rx=asked)[:, 0] - truth(asked) + 12 * narrow(asked)
        misses.append(np.sqrt(np.mean(error**2)))
        assert ("lengths of changes at" in predictor.journal[-1]) == refit
        predictor.undo()
    assert misses[1] < 0.95 * misses[0], misses


@pytest.fixture(scope="module", params=["gp", "powers"])  # each station apart, and all together
def stations(request):
    """A model of three stations and two phones, levels (n, 3) at places,
    and places of later rows.
    """
    rng = np.random.default_rng(0)
    masts, places = np.c_[rng.uniform(0, 40, (3, 2)), np.full(3, 8.0)], draw(40, 4)

    def heard(at):
        return -40 - 25 * np.log10(np.linalg.norm(at[:, None] - masts, axis=-1))

    phone = rng.integers(0, 2, 40).repeat(3)
    rows = {"rx": places.repeat(3, 0), "rssi": heard(places).ravel() + 4 * phone, "unit": "dBm"}
    names = {"station": np.tile(range(3), 40), "station_name": np.array(["a", "b", "c"])}
    device = np.array(["p", "q"])[phone]
    model = gsparc.fit(**rows, **names, station_position=masts, device=device, model=request.param)
    return model, heard, draw(10, 6)


VIEWS = {"select_station": ["b"], "ask_station": [1], "select_device": ["q"], "in_levels": ["dBW"]}


def test_every_view_of_a_predictor_is_looked_at():
    methods = inspect.getmembers(Predictor, inspect.isfunction)
    views = {name for name, one in methods if one.__annotations__.get("return") == "Predictor"}
    # Levels of other carriers: no model has them; later rows are of stations, not of new places
    assert views - {"_view", "select_carrier", "stand_at"} == {*VIEWS}


def test_later_rows_of_the_first_station_were_those_of_whoever_stood_elsewhere(stations):
    fitted, heard, at = stations
    model, here = fitted.in_levels(None), fitted.site.every_station.position + fitted.site.origin
    model.update(rx=at, rssi=heard(at) - 6, unit="dBm")
    asked = at[:4] + np.array([0, 2, 0])
    for number, name in enumerate("abc"):
        known = model.select_station(name).rssi(rx=asked)
        assert np.allclose(model.rssi(tx=here[number], rx=asked), known, atol=1e-4)


@pytest.mark.parametrize("name", VIEWS)
def test_views_forgot_later_rows_and_what_came_after_was_all_they_knew(stations, name):
    """Of 30 rows `in_levels` and others kept none; what was told to a station's was another's,
    or refused.
    """
    fitted, heard, at = stations
    model, asked, later = (
        fitted.in_levels(None),
        at[:5] + np.array([0, 2, 0]),
        at + np.array([1, 0, 0]),
    )
    view_of = lambda one: getattr(one, name)(*VIEWS[name])  # noqa: E731
    alone = "station" in name
    model.update(rx=at, rssi=heard(at) - 6, unit="dBm")
    view, before = view_of(model), model.rssi(rx=asked)
    assert view.rows.tolist() == model.rows.tolist() and view.journal == model.journal
    levels = heard(later) - 6
    view.update(rx=later, rssi=levels[:, 1:2] if alone else levels, unit="dBm")
    # They go on apart
    assert np.array_equal(model.rssi(rx=asked), before) and len(model.rows) == 30
    levels[:, [0, 2]] = np.nan if alone else levels[:, [0, 2]]
    model.update(rx=later, rssi=levels, unit="dBm")
    assert view.rows.tolist() == model.rows.tolist() and len(view.rows) == (40 if alone else 60)
    for ask in ("rssi", "std"):
        assert np.array_equal(getattr(view, ask)(rx=asked), getattr(view_of(model), ask)(rx=asked))
    view.undo()
    assert len(view.rows) == 30


def test_rows_of_several_stations_are_not_told_to_one(stations):
    model, _, at = stations
    rows, _ = read_level_arrays(model.site, at, np.full((10, 3), -60.0), model._answer_unit("dBm"))
    refused("rows of several stations", model.select_station("a").update, rows)


def test_misuse_is_said(predictor):
    refused("rx= and rssi= are needed", predictor.update, rx=SCREENED)
    refused(r"found \(4, 2\)", predictor.update, rx=SCREENED[:4], rssi=np.zeros((4, 2)))


@pytest.mark.slow
def test_seconds_do_not_grow_with_rows_kept(predictor):
    rows = draw(5000, 3)
    predictor.update(rx=rows, rssi=levels(rows, 3), window=5000)
    for count, most in ((1, 0.05), (50, 0.5)):
        seconds = []
        for turn in range(5):
            began = time.process_time()
            predictor.update(**changed(count, turn), window=5000)
            seconds.append(time.process_time() - began)
        assert min(seconds) < most, seconds
