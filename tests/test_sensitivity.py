"""Position errors disturb only what they are said to disturb, and every contender sees the same ones."""

from __future__ import annotations

import numpy as np

from gsparc.data.rfid import load_rfid
from gsparc.data.splits import Fold
from gsparc.peers.gp import GaussianProcess
from gsparc.peers.mean import Mean
from gsparc.sensitivity import displaced, draw, sweep
from gsparc.simulate.rfid_sim import ensure_rfid_sim


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
    value = {(r.method, r.where, r.error_m): r.value for r in rows_found}
    assert len(value) == 10
    for where in ("query", "train"):
        assert value["gp", where, 0.3] < value["gp", "none", 0.0] - 1
        assert abs(value["mean", where, 0.3] - value["mean", "none", 0.0]) < 1e-6
    draw(rows_found, tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 10_000
