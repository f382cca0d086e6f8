"""Heard rows of lists, judged by levels given that they are heard."""

import numpy as np
import torch

from gsparc.models.method import Method, Prediction
from gsparc.prediction.hearing import Hearing
from gsparc.tables.own import from_arrays

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
