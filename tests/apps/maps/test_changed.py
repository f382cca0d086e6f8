"""A map of what changed since a model was learned."""

import numpy as np
from rooms_later import CABINET, PLACES, RADIUS, draw, levels

import gsparc
from gsparc.apps.maps.layers import CHANGE, DEVIATION, add_changes, change_layers
from gsparc.apps.maps.making import predict_map


def test_a_screen_is_drawn_where_it_stands():
    predictor = gsparc.fit(rx=PLACES, rssi=levels(PLACES, 0), tx=[9.0, 9.0, 2.6], model="gp")
    before = predict_map(predictor, step_m=1.0, promise=None)
    assert add_changes(before, predictor) is before and not list(change_layers(before))
    later = draw(600, 5)
    later = later[np.linalg.norm(later[:, :2] - CABINET, axis=1) < 1.5 * RADIUS][:100]
    predictor.update(rx=later, rssi=levels(later, 5, change=-12.0))
    field = add_changes(predict_map(predictor, step_m=1.0, promise=None), predictor)
    change, deviation = field.extra[CHANGE], field.extra[DEVIATION]
    apart = np.linalg.norm(field.grid.places()[:, :2] - CABINET, axis=1).reshape(change.shape)
    inside, outside = apart < 0.6 * RADIUS, apart > 2 * RADIUS
    assert np.abs(change[inside] + 12).mean() < 2 and np.abs(change[outside]).mean() < 1
    wrong = np.where(apart < RADIUS, change + 12, change)
    assert np.mean(np.abs(wrong) < 2 * deviation) > 0.8
    names = [layer.name for layer in change_layers(field)]
    assert names == ["change", "change_deviation"]
