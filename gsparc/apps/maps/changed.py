"""Where, and by how much, the strongest station's level changed since a map was learned
(`gsparc update`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.layers import Layer, Legend
from gsparc.prediction.predictor import Predictor

CHANGE, DEVIATION = "change_db", "change_deviation_db"
# Deviations that a change is said to be sure from; least end of the colours [dB]
SURE, LEAST = 2.0, 1.0


def add_changes(field: FieldMap, predictor: Predictor, dry: bool = False) -> FieldMap:
    """Return a map with two further layers (ny, nx) [dB]: the mean of what changed,
    and its deviation.

    Of a model that no later rows were told to it is returned as it is. `dry`:
    the layers without values.
    """
    if not predictor.versions or not len(predictor.rows):
        return field
    layers = np.full((2, field.best_server.size), np.nan, np.float32)
    for row, number in enumerate([] if dry else field.number):
        cells = np.flatnonzero(field.best_server.reshape(-1) == row)
        if len(cells):
            model = predictor.ask_station(int(number))
            layers[:, cells] = model.change(**model.site.name_moving(field.grid.places(cells)))
    change, deviation = layers.reshape(2, *field.best_server.shape)
    return replace(field, extra={**field.extra, CHANGE: change, DEVIATION: deviation})


def change_layers(field: FieldMap) -> Iterator[Layer]:
    """List what `add_changes` added, as it is drawn."""
    if CHANGE not in field.extra:
        return
    change, deviation = field.extra[CHANGE], field.extra[DEVIATION]
    most = max(float(np.nanmax(np.abs(change), initial=0.0)), LEAST)
    why = f"within {SURE:g} deviations of no change"
    doubt = np.abs(change) < SURE * deviation, "////", why
    yield Layer(
        "change", change, Legend("change of the level [dB]", -most, most, "RdBu_r"), doubts=[doubt]
    )
    label = "deviation of the change [dB]"
    yield Layer("change_deviation", deviation, Legend.over(label, deviation, "cividis"))
