"""Heard rows of lists, judged by levels given that they are heard."""

from pathlib import Path

import numpy as np
import pytest
import torch

from gsparc.data.splits import Fold, Split
from gsparc.evaluation.summary import remarks
from gsparc.models.method import Method, Prediction
from gsparc.models.mixture.methods import Powers
from gsparc.prediction.hearing import Hearing
from gsparc.runs.evaluate import evaluate
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

NONE = np.zeros(0, np.int64)


@pytest.mark.slow
def test_heard_rows_beside_silent_ones_were_judged_by_levels_heard_or_not():
    """A drive above -112 dBm: heard rows 7.1 dB, kriging of these 4.3;
    given that they are heard 4.1.
    """
    rng = np.random.default_rng(0)
    at = np.c_[rng.uniform(0, 900, (1500, 2)), np.full(1500, 1.5)]
    level = (
        -20 - 35 * np.log10(np.linalg.norm(at - [450.0, 450, 20], axis=1)) + rng.normal(0, 7, 1500)
    )
    arrays = {
        "rx_position": at,
        "tx_position": np.array([450.0, 450, 20]),
        "sensitivity_db": -112.0,
    }
    data = from_arrays(arrays | {"rssi_db": np.where(level < -112, np.nan, level)})
    folds = (Fold(np.arange(1000), NONE, np.arange(1000, 1500)),)
    method = Powers()
    method.fit(data, folds[0], FitContext(Path()))
    found = evaluate(method, 1.0, data, Split("drive", folds), baselines=["kriging"], timed=False)
    facts = found.facts
    assert 0.2 < facts["test/outage/rate"] < 0.8 and facts["test/heard_above_db"] > 2
    assert facts["test/rmse_db"] < facts["baseline/kriging/rmse_db"]
    assert (
        0.8 < facts["test/reduced_chi2"] < 1.25 and 0.86 < facts["test/interval/coverage_90"] < 0.94
    )
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
        "rx_position": np.c_[np.arange(900.0), np.zeros((900, 2))][moment],
        "station": station,
        "station_position": rng.uniform(0, 900, (6, 3)),
        "rssi_db": every[moment, station],
    }
    data = from_arrays(arrays)
    heard = data.subset(np.flatnonzero(data.censored == 0))
    own = np.full(len(heard), SPREAD_DB)
    hearing = Hearing.from_learned(data, np.arange(len(data)))
    found = hearing.given_heard(
        Told(data.site), heard.moving, heard.station, MEANS_DB[heard.station], own
    )
    error = found["heard_db"] - every[moment, station]
    for one in range(6):
        assert abs(error[station == one].mean()) < 0.3
    assert 0.88 < (np.abs(error) < 1.645 * found["heard_std_db"]).mean() < 0.92
    # A list has three of six.
    share = [found["heard_share"][station == one].mean() for one in range(6)]
    np.testing.assert_allclose(share, np.bincount(station) / 900, atol=0.05)
