"""The simple baselines, what all of them share, and kriging from the nearest of many places."""

import warnings

import numpy as np
import pytest
import torch

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines import kriging
from gsparc.models.baselines.idw import InverseDistance
from gsparc.models.registry import method_class
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


def fitted(name, data, fold, tmp_path):
    method = method_class(name)()
    method.fit(data, fold, FitContext(tmp_path))
    return method


@pytest.mark.parametrize("name", ["nearest", "idw"])
def test_a_sample_is_repeated_at_its_own_place(campaign, folds, tmp_path, name):
    data, fold = campaign("spectrum", 30), folds(30).folds[0]
    batch = data.batch(fold.train)
    found = fitted(name, data, fold, tmp_path).predict(batch)
    assert torch.allclose(found.mean, batch.target, atol=1e-4)
    assert found.confidence.min() > 0.999


def test_idw_weighs_by_inverse_squared_distance(campaign, folds, tmp_path):
    data = campaign("rssi", 3)
    data.tx[:] = [[0, 0, 0], [3, 0, 0], [100, 0, 0]]
    fold = type(folds(8).folds[0])(np.arange(3), np.arange(0), np.arange(0))
    method = InverseDistance(neighbours=2)
    method.fit(data, fold, FitContext(tmp_path))
    found = method.predict(Query(torch.tensor([[1.0, 0, 0]]), data.batch(np.arange(1)).rx)).mean
    decibels = 10 * np.log10(data.target[:2, 0])
    assert 10 * torch.log10(found)[0, 0] == pytest.approx(
        (4 * decibels[0] + decibels[1]) / 5, rel=1e-4
    )
    with pytest.raises(ValueError, match="neighbours"):
        InverseDistance(neighbours=0)


@pytest.mark.parametrize("name", ["mean", "nearest", "idw", "gp"])
def test_entries_never_measured_do_not_leak(campaign, folds, tmp_path, name):
    data, fold = campaign("csi", 30), folds(30).folds[0]
    mask = np.random.default_rng(0).random(data.target.shape) > 0.3
    results = []
    for rubbish in (0.0, 1e6):
        target = np.where(mask, data.target, np.complex64(rubbish))
        masked = Measurements(
            data.site, data.tx, data.rx_position, data.rx_rotation, target, mask=mask
        )
        batch = masked.batch(fold.test)
        results.append(fitted(name, masked, fold, tmp_path).predict(batch).mean)
    assert torch.equal(*results)


def test_kriging_lends_its_pivots_to_no_one(campaign, folds, tmp_path, monkeypatch):
    """SciPy counts them from 1 in place while it solves: two threads wrote beside the matrix."""
    data = campaign("rssi")
    method = fitted("kriging", data, folds(len(data)).folds[0], tmp_path)
    seen = []
    solve = kriging.lu_solve
    monkeypatch.setattr(
        kriging, "lu_solve", lambda pair, right: seen.append(pair[1]) or solve(pair, right)
    )
    method.predict(data.batch(np.arange(3)))
    assert len(seen) == 1 and not np.shares_memory(seen[0], method.system[1])


def test_kriging_of_many_rows_asked_for_all_memory(tmp_path, monkeypatch):
    """50,000 rows were a matrix of 20 GB for a baseline that every run of powers fits."""
    monkeypatch.setattr(kriging, "WHOLE", 30)
    monkeypatch.setattr(kriging, "NEAREST", 20)
    places = np.random.default_rng(0).uniform(0, 9, (80, 3))
    data = from_arrays(
        {"rx_position": places, "tx_position": np.zeros(3), "rssi_db": -40 - places[:, 0]}
    )
    method = kriging.Kriging()
    report = method.fit(
        data, Fold(np.arange(60), np.arange(60, 70), np.arange(70, 80)), FitContext(tmp_path)
    )
    assert method.system is None and method.label == "kriging (nearest 20)"
    assert "of 70 places each query's nearest 20" in report.notes[0]
    error = (
        10
        * torch.log10(method.predict(data.batch(np.arange(70, 80))).mean * data.site.target_scale)[
            :, 0
        ]
    )
    assert (error + 40 + torch.from_numpy(places[70:, 0]).float()).abs().max() < 1.5


def test_two_places_have_no_variogram():
    """Their one distance is more than half the extent: no quantile of nothing could be taken."""
    found = kriging.fit_variogram(
        np.array([[0.0, 0, 0], [3.0, 4, 0]]), np.array([[-60.0], [-70.0]])
    )
    assert (found.nugget, found.range) == (0.0, 2.5) and found.sill > 0


def test_few_places_printed_a_warning_of_a_library():
    """`OptimizeWarning: Covariance of the parameters could not be estimated`,
    which nobody had asked for.
    """
    rng = np.random.default_rng(0)
    places, levels = (
        np.c_[rng.uniform(0, 50, (4, 2)), np.zeros(4)],
        np.round(2 * rng.normal(size=(4, 1))),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kriging.fit_variogram(places, levels).sill >= 0
