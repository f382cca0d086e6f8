"""What is written on pictures of maps and plans."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from towns import town_model

import gsparc
from gsparc.apps.maps import pictures, plan_measurements, predict_map
from gsparc.data.links.georeference import Georeference


@pytest.fixture
def drawn(monkeypatch):
    """Figures, which are not written."""
    figures: list[Figure] = []
    monkeypatch.setattr(pictures, "save", lambda figure, path, dpi: figures.append(figure))
    return figures


@pytest.fixture(scope="module")
def predictor():
    return gsparc.load(town_model())


def draw(field, name):
    (layer,) = [one for one in pictures.list_layers(field) if one.name == name]
    pictures.draw_layer(field, layer, "unused.png", "")


def test_axes_of_a_map_were_metres_from_an_origin_that_they_did_not_name(predictor, drawn, monkeypatch):
    draw(predict_map(predictor, step_m=4.0), "power")
    monkeypatch.setattr(predictor, "site", replace(predictor.site, georeference=Georeference(47.2, 11.3)))
    draw(predict_map(predictor, step_m=4.0), "power")
    pictures.draw_measurement_plan(plan_measurements(predictor, 2), "unused.png", None, predictor, None)
    said = [figure.axes[0].get_xlabel() for figure in drawn]
    assert said == ["x [m]", "metres east of 11.3° E", "metres east of 11.3° E"]


def test_a_legend_of_ten_cells_did_not_say_that_others_serve_less(drawn, predictor):
    field = predict_map(predictor, step_m=4.0)
    number = np.arange(field.grid.inside.size).reshape(field.grid.inside.shape) % 24
    layer = pictures.Layer(
        "best_server", 1.0 * number, pictures.Legend("", -0.5, 23.5), tuple("abcdefghijklmnopqrstuvwx")
    )
    pictures.draw_layer(field, layer, "unused.png", "")
    words = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert "14 more, that serve less: best_server.csv" in words


def test_the_curve_of_a_plan_was_a_flat_line(drawn, predictor):
    """Its axis began at 0 dB."""
    plan = plan_measurements(predictor, 4)
    pictures.draw_measurement_plan(plan, "unused.png", None, predictor, None)
    low, high = drawn[0].axes[2].get_ylim()
    assert high - low < 1.5 * (plan.before_db - plan.after_db)
