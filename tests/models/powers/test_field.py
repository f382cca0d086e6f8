"""The field of powers: the plain process without Gaussians, known walls, rows left out, slopes,
state.
"""

import copy
import math

import numpy as np
import pytest
import torch
from closed import fitted_to, read_back

from gsparc.data.schema import Measurements
from gsparc.data.walls import read_walls
from gsparc.models.powers.field import PowerField
from gsparc.processes.nearest import Nearest
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

STATION = (5.0, 20.0, 3.0)
TOWN_WALL = "walls: [{corners_m: [[25, 18, 0], [25, 45, 0], [25, 45, 12], [25, 18, 12]]}]"


def town(count: int, walls: bool = True, seed: int = 0) -> Measurements:
    """A square before a station: a law, a wall of 15 dB, 2 dB of shadowing over 5 m,
    1 dB of noise.
    """
    rng = np.random.default_rng(seed)
    places = np.c_[rng.uniform(10, 50, count), rng.uniform(0, 40, count), np.full(count, 1.5)]
    decibels = -30 - 25 * np.log10(np.linalg.norm(places - STATION, axis=1))
    if walls:
        # Where a path crosses x = 25 m
        height = 20 + (places[:, 1] - 20) * (25 - 5) / (places[:, 0] - 5)
        decibels = decibels - 15.0 * ((places[:, 0] > 25) & (height > 18))
    waves = rng.normal(size=(3, 100)) / 5
    decibels += (
        2 * np.cos(places @ waves + rng.uniform(0, 2 * np.pi, 100)) @ rng.normal(size=100) / 7
    )
    decibels += rng.standard_normal(count)
    return from_arrays(
        {"rx_position": places, "tx_position": STATION, "rssi_db": decibels}, {"name": "town"}
    )


def db(power: torch.Tensor) -> np.ndarray:
    return 10 * np.log10(power.numpy().astype(float)).reshape(-1)


@pytest.fixture(scope="module")
def blocked(tmp_path_factory):
    """A town of 260 rows with a known wall, and the field of 160 of them."""
    data, rows = town(260), np.arange(160)
    file = tmp_path_factory.mktemp("walls") / "town.yaml"
    file.write_text(TOWN_WALL, encoding="utf-8")
    field, notes = fitted_to(PowerField(walls=read_walls(file)), data, rows)
    field.condition(data, rows)
    return data, field, notes


def test_settings_are_chosen_on_rows_that_no_clock_counts():
    """A busy machine chose on fewer rows: 5.573 dB beside two loops, 5.580 alone."""
    chosen = [FitContext(effort=effort).counts for effort in (1e-3, 1.0, 8.0)]
    assert [each.chosen_on for each in chosen] == [150, 1000, 2000]


def test_two_rows_behind_known_walls_were_known_to_a_thousandth_of_a_decibel(tmp_path):
    """A distance law goes through both: variances of 7e-9 dB^2 at places
    that were missed by 8 dB.
    """
    (tmp_path / "town.yaml").write_text(TOWN_WALL, encoding="utf-8")
    data = town(40)
    field, notes = fitted_to(
        PowerField(walls=read_walls(tmp_path / "town.yaml")), data, np.arange(2)
    )
    told = field.predict(data.batch(np.arange(2, 40)))
    spread = told.variance.sqrt() / told.mean[:, 0] * 10 / math.log(10)
    assert float(spread.min()) > 1.0 and "known walls" in notes[0]


@pytest.mark.parametrize("rows", [20, 60])
def test_known_walls_tell_more_than_few_rows_find(rows, tmp_path):
    data, rows, test = town(260), np.arange(rows), np.arange(160, 260)
    (tmp_path / "town.yaml").write_text(TOWN_WALL, encoding="utf-8")
    batch = data.batch(test)
    errors = []
    for walls in (read_walls(tmp_path / "town.yaml"), None):
        field, _ = fitted_to(PowerField(walls=walls), data, rows)
        errors.append(
            float(np.sqrt(np.mean((db(field.predict(batch).mean) - db(batch.target)) ** 2)))
        )
    assert errors[0] < 0.75 * errors[1], errors


def test_walls_stay_where_each_place_is_told_by_the_nearest(blocked, monkeypatch):
    data, field = blocked[0], blocked[1]
    rows = np.arange(240)
    field.condition(data, rows)
    batch = data.batch(np.arange(240, len(data)))
    whole, left = db(field.predict(batch).mean), field.left_out()
    monkeypatch.setattr("gsparc.processes.powers.MOST_ROWS", 100)
    near = copy.deepcopy(field)
    near.condition(data, rows)
    assert isinstance(near.powers.posterior, Nearest) and near.terms == field.terms
    assert np.sqrt(np.mean((db(near.predict(batch).mean) - whole) ** 2)) < 0.3
    assert np.array_equal(near.left_out().rows, left.rows)
    assert np.sqrt(np.mean((db(near.left_out().mean) - db(left.mean)) ** 2)) < 0.4
    again = read_back(near)
    assert torch.equal(again.predict(batch).mean, near.predict(batch).mean)
    assert torch.equal(again.left_out().mean, near.left_out().mean)
