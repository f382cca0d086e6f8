"""Position errors disturb only what they are said to disturb, and every contender sees the same ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rooms import directed

from gsparc.data.rfid import load_rfid
from gsparc.data.splits import Fold
from gsparc.methods.gp import GaussianProcess
from gsparc.methods.mean import Mean
from gsparc.multipath.directional_gp import DirectionalGP
from gsparc.simulate.rfid_sim import ensure_rfid_sim
from gsparc.studies.study.sensitivity import displaced, draw, sweep, turned


def test_errors_cost_an_interpolator_and_not_the_mean(tmp_path) -> None:
    data = load_rfid(ensure_rfid_sim(tmp_path, count=60, seed=0))
    rows = np.arange(60)
    fold = Fold(rows[::2], rows[:0], rows[1::2])
    moved = displaced(data, fold.test, 0.1, seed=0)
    assert np.array_equal(moved.tx[fold.train], data.tx[fold.train])
    assert 0.05 < np.std(moved.tx[fold.test] - data.tx[fold.test]) < 0.2
    rows_found = list(
        sweep(
            {"gp": GaussianProcess, "mean": Mean},
            data,
            fold,
            [0.001, 0.3],
            tmp_path,
            train_errors=True,
            seed=0,
        )
    )
    value = {(r.method, r.where, r.error): r.value for r in rows_found}
    assert len(value) == 10
    for where in ("query", "train"):
        assert value["gp", where, 0.3] < value["gp", "none", 0.0] - 1
        assert abs(value["mean", where, 0.3] - value["mean", "none", 0.0]) < 1e-6
    draw(rows_found, tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 10_000


def test_directions_turn_by_what_was_asked_and_nothing_else(tmp_path) -> None:
    data, fold, _ = directed(40)
    there = turned(data, 2.0, seed=0)
    angle = np.linalg.norm(np.concatenate(there.directions) - np.concatenate(data.directions), axis=1)
    assert abs(np.degrees(np.sqrt(np.mean(angle**2) / 2)) - 2) < 0.2
    assert there.target is data.target and there.rx_position is data.rx_position
    few = turned(data, 0.0, seed=0, missing=0.5)
    more = turned(data, 0.0, seed=0, false=0.5)
    counts = [sum(map(len, d.directions)) for d in (few, data, more)]
    assert counts[0] < 0.6 * counts[1] and counts[2] > 1.4 * counts[1]
    with pytest.raises(ValueError, match="no directions of arrival"):
        turned(replace(few, directions=None), 1.0, seed=0)
    found = list(
        sweep(
            {"directed": DirectionalGP}, data, fold, [], tmp_path,
            train_errors=False, seed=0, errors_deg=[0.5],
        )
    )  # fmt: skip
    assert [r.where for r in found] == ["none", "directions"] and found[1].value < 0.1
    draw(found, tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 5_000
