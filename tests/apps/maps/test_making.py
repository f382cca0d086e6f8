"""A map is what the model predicts cell by cell,
with its layers over stations and words on its pictures.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv, to_rgb
from matplotlib.figure import Figure
from refusals import refused
from scipy.stats import norm
from towns import MASTS, town_model

import gsparc
from gsparc.apps.maps import layers, pictures, plan_measurements, strongest
from gsparc.apps.maps.layers import Layer, Legend, assign_colours, label_places, list_layers
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.promise import Promise, map_notes
from gsparc.apps.maps.refining import sample_adaptively
from gsparc.apps.maps.strongest import (
    REFUSED,
    best_server,
    read_loads,
    server_chance,
    sinr,
)
from gsparc.base.errors import DataError
from gsparc.data.georeference import Georeference
from gsparc.prediction.left_out import HeldOutLevels
from gsparc.prediction.predictor import Predictor


@pytest.fixture(scope="module")
def predictor():
    return gsparc.load(town_model())


def test_cells_hold_what_the_model_predicts(predictor):
    found = predict_map(predictor, [0, 0, 80, 60], step_m=4.0, threshold_db=-90)
    assert found.power_db.shape == (2, 15, 20) and found.power_db.dtype == np.float32
    place = [found.grid.x[3], found.grid.y[5], 1.5]
    for number, name in enumerate(found.stations):
        assert found.power_db[number, 5, 3] == pytest.approx(
            float(predictor.select_station(name).rssi(rx=place)[0]), abs=1e-3
        )
    assert (found.lower_db < found.power_db).all() and (found.power_db < found.upper_db).all()
    west, east = (
        found.best_server[int(MASTS[0, 1] / 4), int(MASTS[0, 0] / 4)],
        found.best_server[11, 17],
    )
    assert (west, east) == (0, 1)
    assert ((found.outage >= 0) & (found.outage <= 1)).all() and not found.calibrated


def test_squares_in_buildings_take_a_stated_loss(predictor, tmp_path):
    ring = [[8, 8], [40, 8], [40, 40], [8, 40], [8, 8]]
    (tmp_path / "house.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    how = {"area": [0, 0, 80, 60], "step_m": 4.0, "threshold_db": -90}
    inside = {"buildings": tmp_path / "house.geojson", "indoor_db": [15, 6]}
    without, found = (predict_map(predictor, **how, **more) for more in ({}, inside))
    lost, wider = (
        without.power_db - found.power_db,
        found.expected_error_db**2 - without.expected_error_db**2,
    )
    assert found.grid.indoors.sum() == 64 and found.grid.inside.all()
    np.testing.assert_allclose(
        lost, 15.0 * np.broadcast_to(found.grid.indoors, lost.shape), atol=1e-4
    )
    np.testing.assert_allclose(
        wider, 36.0 * np.broadcast_to(found.grid.indoors, lost.shape), rtol=1e-3, atol=1e-3
    )
    assert (found.best_server == without.best_server).all()
    assert (found.outage >= without.outage - 1e-6).all()
    refused("indoor_db=.*buildings=FILE", predict_map, predictor, **how, indoor_db=[15, 6])


def test_a_unit_of_maps_changed_their_names_alone():
    """`unit=dBm` of levels in dBW wrote dBm beside the same numbers
    and the threshold of the others.
    """
    stored = gsparc.load(town_model())
    predictor = Predictor(stored.method, replace(stored.site, level_unit="dBW"), extra=stored.extra)
    own = predict_map(predictor, step_m=8.0, threshold_db=-90, noise_db=-100)
    other = predict_map(predictor, step_m=8.0, threshold_db=-60, noise_db=-70, unit="dBm")
    assert (own.unit, other.unit, other.threshold_db) == ("dBW", "dBm", -60)
    for name in ("power_db", "lower_db", "upper_db"):
        np.testing.assert_allclose(getattr(other, name), getattr(own, name) + 30, atol=1e-4)
    for name in ("expected_error_db", "outage", "sinr_db", "server_chance", "best_server"):
        np.testing.assert_allclose(getattr(other, name), getattr(own, name), atol=1e-6)
    assert "[dBm]" in next(iter(list_layers(other))).legend.label
    assert other.summarise()["map/unit"] == "dBm"
    refused(r"unit=W: of powers in dBW expected dBm, dBW$", predict_map, predictor, unit="W")


def test_chunks_do_not_change_a_map(predictor, monkeypatch):
    whole = predict_map(predictor, step_m=5.0)
    monkeypatch.setattr("gsparc.prediction.answers.BLOCK", 7)
    monkeypatch.setattr("gsparc.apps.maps.making.BANDS", 13)
    assert np.allclose(predict_map(predictor, step_m=5.0).power_db, whole.power_db, atol=1e-4)


def test_ratio_of_signal_to_interference_by_hand():
    power = np.array([[-50.0, np.nan, np.nan], [-60.0, -60.0, np.nan]])
    assert sinr(power, np.array([1.0, 1.0]), None)[0] == pytest.approx(10)
    assert sinr(power, np.array([1.0, 0.1]), None)[0] == pytest.approx(20)
    assert sinr(power, np.ones(2), -60.0)[0] == pytest.approx(10 - 10 * np.log10(2))
    assert sinr(power, np.ones(2), -80.0)[1] == pytest.approx(20)
    assert np.isnan(sinr(power, np.ones(2), -80.0)[2]) and np.isnan(
        sinr(power, np.ones(2), None)[1]
    )
    assert best_server(power).tolist() == [0, 1, REFUSED]
    assert read_loads({"b": 0.2}, ["a", "b"]).tolist() == [1.0, 0.2]
    assert read_loads({"Roof": 0.2}, ["a", "b"], ["Tower", "Roof"]).tolist() == [1.0, 0.2]


def test_sectors_that_err_together_are_told_apart():
    """The chance of the best server took errors of sectors of one site for independent."""
    power, error = np.array([[-60.0], [-64.0]]), np.full((2, 1), 6.0)
    floor = np.full(2, -np.inf)
    alone = server_chance(power, error, floor)[0]
    together = server_chance(power, error, floor, np.array([[1.0], [0.8]]))[0]
    assert alone == pytest.approx(norm.cdf(4 / np.hypot(6, 6)), abs=3e-3)
    assert together == pytest.approx(norm.cdf(4 / np.sqrt(72 * 0.2)), abs=3e-3)


def test_the_chance_of_a_best_server_was_a_product_of_all_that_it_beats():
    """Of six alike it was 1/32; given its own level it is one of six.
    Lists' levels were its floor.
    """
    power, error = np.full((6, 1), -60.0), np.full((6, 1), 6.0)
    found = server_chance(power, error, np.full(6, -np.inf))[0]
    assert found == pytest.approx(1 / 6, abs=5e-3)


def test_coverage_counted_the_named_station_alone():
    """Simulated networks: .61 of places said to be covered, .69 with all stations, .70 in truth."""
    power, error, below = np.array([[-100.0], [-100.0]]), np.full((2, 1), 6.0), np.array([0.5])

    def found(*alike):
        return strongest.outage_probability(power, error, -100.0, np.array(alike)[:, None], below)[
            0
        ]

    assert found(1.0, 0.0) == pytest.approx(0.25, abs=1e-3)
    assert found(1.0, 0.5) == pytest.approx(1 / 3, abs=5e-3)  # 1/4 + asin(r) / (2 pi)
    assert found(1.0, 1.0) == pytest.approx(0.5, abs=1e-2)
    power[1] = np.nan  # unknown: counts as below
    assert found(1.0, 0.0) == 0.5


def test_twenty_one_stations_had_twenty_colours():
    """Those of neighbours were shades of one hue: areas side by side have different ones,
    and names.
    """
    classes = np.kron(np.arange(24.0).reshape(4, 6), np.ones((6, 6)))
    found = assign_colours(classes, 24)
    assert found.min() >= 0 and found.max() < 10
    grid = found[classes.astype(int)]
    assert (grid[6:][::6] != grid[:-6][::6]).all() and (grid[:, 6:] != grid[:, :-6]).all()
    words = tuple(f"cell {i}" for i in range(24))
    table = Layer("best_server", classes, Legend("", -0.5, 23.5), words).table()
    assert len(table) == 24
    layer = Layer("best_server", classes, Legend("", -0.5, 23.5), words, group=np.arange(24) // 3)
    hue = [rgb_to_hsv(to_rgb(colour))[0] for colour in layer.table()]
    listed = layer.class_table()
    assert np.ptp(np.reshape(hue, (8, 3)), axis=1).max() < 0.02 and len(set(listed["colour"])) == 24
    assert sum(listed["share"]) == pytest.approx(1, abs=2e-3) and listed["station"][0] == "cell 0"
    named = list(label_places(classes, words))
    assert [word for _, _, word in named] == list(words)
    assert all(classes[row, column] == words.index(word) for row, column, word in named)


def test_twelve_plain_stations_had_ten_colours():
    """Two of the list and of best_server.csv had the colour of another one."""
    classes = np.arange(12.0).reshape(3, 4)
    layer = Layer("best_server", classes, Legend("", -0.5, 11.5), tuple(map(str, range(12))))
    assert len(set(layer.class_table()["colour"])) == 12


def test_a_sector_that_serves_nowhere_was_missing_in_the_table():
    layer = Layer("best_server", np.zeros((4, 4)), Legend("", -0.5, 1.5), ("west", "east"))
    listed = layer.class_table()
    assert listed["station"] == ["west", "east"] and listed["share"] == [1, 0]


def test_a_station_was_named_best_where_nothing_was_known_or_above_the_floor(predictor):
    power = np.array([[-60.0, -60.0, np.nan, -60.0], [-90.0, -60.0, np.nan, np.nan]])
    error = np.full((2, 4), 5.0)
    free = server_chance(power, error, np.full(2, -np.inf))
    assert free[:2] == pytest.approx([1.0, 0.5], abs=1e-4) and np.isnan(free[2]) and free[3] == 1
    # Unknown in the last cell, as in `outage`: weaker. As strong as usual its Brier score was .20,
    # now .18.
    told = server_chance(power, error, np.array([-60.0, -100.0]))
    assert told[[0, 3]] == pytest.approx([0.5, 0.5], abs=1e-4)
    quiet = predict_map(predictor, step_m=10.0)
    loud = predict_map(predictor, step_m=10.0, noise_db=0.0)
    assert (
        not quiet.unsure.any() and loud.unsure.all() and loud.summarise()["map/server_unsure"] == 1
    )
    doubts = {layer.name: layer.doubts for layer in list_layers(loud)}
    (other, *_), (silent, *_) = doubts["best_server"]
    # None is heard: that another cell led was said of all of it.
    assert silent.all() and not other.any() and not doubts["power"]


def test_a_threshold_below_all_that_was_measured_was_said_to_be_met_everywhere(predictor):
    """100.0% of a city (100.0% to 100.0%) had -100 dBm or more,
    where the weakest measured was -100.6.
    """
    level, row = np.linspace(-100.6, -50, 400), np.arange(400)
    place = np.random.default_rng(0).uniform(0, 60, (400, 3))
    evidence = HeldOutLevels(
        level, level, np.ones(400), np.linspace(0, 90, 400), row // 10, row * 0, row % 2
    )
    promise = Promise(evidence, place, row % 2, 5.0)
    for threshold, said in ((-100, 1), (-90, 0)):
        found = predict_map(predictor, step_m=20.0, threshold_db=threshold, promise=promise)
        assert (
            sum("or below what was measured (lowest -100.6)" in note for note in found.notes)
            == said
        )
        assert not any("above all" in note for note in found.notes)
    found = predict_map(predictor, step_m=20.0, threshold_db=60, promise=promise)
    assert np.nanmin(found.outage) == 1  # .1 % of the squares had it
    assert any(
        "threshold_db=60 is above all that was measured (highest -50)" in note
        for note in found.notes
    )


def test_spectra_have_no_power(predictor, monkeypatch):
    monkeypatch.setattr(predictor, "site", replace(predictor.site, kind="spectrum"))
    with pytest.raises(DataError, match="no received power"):
        predict_map(predictor)


def test_interpolated_cells_are_as_exact_as_asked_for():
    def ask(cells):
        row, column = np.divmod(cells, 200)
        x, y = column / 10, row / 10
        return np.column_stack(
            [-20 * np.log10(1 + np.hypot(x - 5, y - 4)), 2 + np.sin(x / 3) * np.cos(y / 4)]
        )

    inside = np.ones((150, 200), bool)
    inside[100:, :60] = False
    none = np.zeros_like(inside)
    every, count = sample_adaptively(ask, inside, lambda v: 0.1 + 0 * v, none, 1)
    few, asked = sample_adaptively(ask, inside, lambda v: 0.1 + 0 * v, none)
    assert count == inside.sum() and asked < 0.3 * count, asked / count
    assert np.array_equal(np.isnan(few), np.isnan(every)) and np.nanmax(np.abs(few - every)) < 0.1
    exact, asked = sample_adaptively(ask, inside, lambda v: 1e-6 + 0 * v, none)
    assert asked > 0.9 * count and np.nanmax(np.abs(exact - every)) < 1e-4
    sure, _ = sample_adaptively(ask, inside, lambda v: np.inf + 0 * v, inside)
    assert np.array_equal(sure, every, equal_nan=True)


def test_a_map_named_cells_by_the_numbers_of_the_drive_where_the_list_has_names(
    predictor, monkeypatch
):
    monkeypatch.setitem(vars(predictor.site.stations), "label", ("Roof 1", "Tower"))
    found = predict_map(predictor, step_m=8.0, stations=["east", "Roof 1"])
    assert found.stations == ("Tower", "Roof 1")
    # What was measured is in dB, of what nobody said: the map says how it is called dBm.
    assert any("unit=dBm" in note for note in map_notes(found, None))
    # No share was printed.
    share = f"{1 - found.summarise()['map/outage']:.1%} of the predicted squares have"
    assert any(note.startswith(share) for note in map_notes(found, None))


def test_a_noise_of_a_billion_decibels_overflowed(predictor):
    refused("noise_db", predict_map, predictor, step_m=20.0, noise_db=1e9)


@pytest.fixture
def drawn(monkeypatch):
    """Figures, which are not written."""
    figures: list[Figure] = []
    monkeypatch.setattr(pictures, "save", lambda figure, path, dpi: figures.append(figure))
    return figures


def draw(field, name):
    (layer,) = [one for one in layers.list_layers(field) if one.name == name]
    pictures.draw_layer(field, layer, "unused.png", "")


def test_axes_of_a_map_were_metres_from_an_origin_that_they_did_not_name(
    predictor, drawn, monkeypatch
):
    draw(predict_map(predictor, step_m=4.0), "power")
    monkeypatch.setattr(
        predictor, "site", replace(predictor.site, georeference=Georeference(47.2, 11.3))
    )
    draw(predict_map(predictor, step_m=4.0), "power")
    pictures.draw_measurement_plan(
        plan_measurements(predictor, 2), "unused.png", None, predictor, None
    )
    said = [figure.axes[0].get_xlabel() for figure in drawn]
    assert said == ["x [m]", "metres east of 11.3° E", "metres east of 11.3° E"]


def test_a_legend_of_ten_cells_did_not_say_that_others_serve_less(drawn, predictor):
    field = predict_map(predictor, step_m=4.0)
    number = np.arange(field.grid.inside.size).reshape(field.grid.inside.shape) % 24
    layer = layers.Layer(
        "best_server",
        1.0 * number,
        layers.Legend("", -0.5, 23.5),
        tuple("abcdefghijklmnopqrstuvwx"),
    )
    pictures.draw_layer(field, layer, "unused.png", "")
    words = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert "14 more, that serve less: best_server.csv" in words


def test_a_fall_of_a_tenth_of_a_decibel_looked_like_one_to_nothing(drawn, predictor):
    """The curve of a plan began at its own least; its ends are written beside it."""
    plan = plan_measurements(predictor, 4)
    pictures.draw_measurement_plan(plan, "unused.png", None, predictor, None)
    curve = drawn[0].axes[-1]
    assert curve.get_ylim()[0] == 0 and curve.get_ylim()[1] > plan.before_db
    assert f"{plan.after_db:.2f} dB" in [text.get_text() for text in curve.texts]
