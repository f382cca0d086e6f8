"""Heard rows of lists, judged by levels given that they are heard."""

from pathlib import Path

import numpy as np
import pytest
import torch
from networks import network

from gsparc.data.own import from_arrays
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.evaluate import evaluate
from gsparc.evaluation.summary import remarks
from gsparc.models.gsparc import Gsparc
from gsparc.models.method import Method, Prediction
from gsparc.models.mixture.methods import Powers
from gsparc.models.per_station import wrap_per_station
from gsparc.prediction.hearing import Hearing
from gsparc.training.context import FitContext

NONE = np.zeros(0, np.int64)


@pytest.mark.slow
def test_listed_rows_were_judged_by_levels_listed_or_not():
    """Kriging, of listed rows alone, looked better between the moments of one drive: 3.3 for 3.9 dB."""
    data = network(3, moments=300, asked=2).data(6)
    test = data.place % 5 == 0
    folds = (Fold(np.flatnonzero(~test), NONE, np.flatnonzero(test)),)
    method = wrap_per_station(Gsparc(), data)
    method.fit(data, folds[0], FitContext(Path()))
    split = Split("moments", folds)
    found = evaluate(method, 1.0, data, split, baselines=["kriging", "nearest"], timed=False)
    facts, columns = found.facts, found.columns
    assert facts["test/rmse_db"] < 0.97 * facts["baseline/kriging/rmse_db"]
    listed = np.isfinite(columns["error_db"])
    own = columns["predicted_db"] - columns["measured_db"]
    as_mapped, given = (np.sqrt(np.mean(one[listed] ** 2)) for one in (own, columns["error_db"]))
    assert given == pytest.approx(facts["test/rmse_db"]) and given < 0.9 * as_mapped
    assert own[listed].mean() < -0.5
    np.testing.assert_allclose(columns["error_db_with_silent"][listed], own[listed], atol=1e-9)
    np.testing.assert_allclose(
        (columns["heard_db"] - columns["measured_db"])[listed], columns["error_db"][listed]
    )
    assert abs(columns["error_db"][listed].mean()) < 0.5 and 0.85 < facts["test/interval/coverage_90"] < 0.95
    # A share that is right is a mean of what happened.
    assert abs(columns["heard_share"].mean() - listed.mean()) < 0.05
    assert facts["test/outage/brier"] < 0.5 * facts["test/outage/brier_rate"]
    assert any("levels of rows that are heard or listed" in line for line in remarks(facts))


@pytest.mark.slow
def test_heard_rows_beside_silent_ones_were_judged_by_levels_heard_or_not():
    """A drive above -112 dBm: heard rows 7.1 dB, kriging of these 4.3; given that they are heard 4.1."""
    rng = np.random.default_rng(0)
    at = np.c_[rng.uniform(0, 900, (1500, 2)), np.full(1500, 1.5)]
    level = -20 - 35 * np.log10(np.linalg.norm(at - [450.0, 450, 20], axis=1)) + rng.normal(0, 7, 1500)
    arrays = {"rx_position": at, "tx_position": np.array([450.0, 450, 20]), "sensitivity_db": -112.0}
    data = from_arrays(arrays | {"rssi_db": np.where(level < -112, np.nan, level)})
    folds = (Fold(np.arange(1000), NONE, np.arange(1000, 1500)),)
    method = Powers()
    method.fit(data, folds[0], FitContext(Path()))
    found = evaluate(method, 1.0, data, Split("drive", folds), baselines=["kriging"], timed=False)
    facts = found.facts
    assert 0.2 < facts["test/outage/rate"] < 0.8 and facts["test/heard_above_db"] > 2
    assert facts["test/rmse_db"] < facts["baseline/kriging/rmse_db"]
    assert 0.8 < facts["test/reduced_chi2"] < 1.25 and 0.86 < facts["test/interval/coverage_90"] < 0.94
    assert any("levels of rows that are heard or listed" in line for line in remarks(facts))


MEANS_DB, SPREAD_DB = np.array([-70.0, -72, -74, -76, -78, -80]), 4.0


class Told(Method):
    """Knows the law of every station: normal levels, the same everywhere."""

    name, uses_censored = "told", True

    def __init__(self, site):
        self.site, self.unit = site, site.target_scale

    def predict(self, query):
        mean = torch.from_numpy(10 ** (MEANS_DB / 10) / self.unit)[query.station][:, None]
        return Prediction(mean, (mean[:, 0] * np.log(10) / 10 * SPREAD_DB) ** 2)

    fit = state = restore = None


def test_listed_levels_had_to_exceed_those_of_lists_that_lack_their_station():
    """Lists that lack a station are the strong ones: levels of listed rows were .6 dB too high."""
    rng = np.random.default_rng(0)
    every = MEANS_DB + SPREAD_DB * rng.normal(size=(900, 6))
    moment, station = np.nonzero(np.argsort(np.argsort(-every, 1), 1) < 3)
    arrays = {
        "rx_position": np.c_[np.arange(900.0), np.zeros((900, 2))][moment], "station": station,
        "station_position": rng.uniform(0, 900, (6, 3)), "rssi_db": every[moment, station],
    }  # fmt: skip
    data = from_arrays(arrays)
    heard = data.subset(np.flatnonzero(data.censored == 0))
    own = np.full(len(heard), SPREAD_DB)
    hearing = Hearing.from_learned(data, np.arange(len(data)))
    found = hearing.given_heard(Told(data.site), heard.moving, heard.station, MEANS_DB[heard.station], own)
    error = found["heard_db"] - every[moment, station]
    for one in range(6):
        assert abs(error[station == one].mean()) < 0.3
    assert 0.88 < (np.abs(error) < 1.645 * found["heard_std_db"]).mean() < 0.92
    # A list has three of six.
    share = [found["heard_share"][station == one].mean() for one in range(6)]
    np.testing.assert_allclose(share, np.bincount(station) / 900, atol=0.05)
