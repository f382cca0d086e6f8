"""Trust that is learned from places left out, and whether areas keep their promise on others."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsparc.apps.locate import search
from gsparc.apps.locate.posterior import cover_box
from gsparc.apps.locate.search import (
    PlaceSearch,
    Trust,
    calibrate_level,
    calibrate_trust,
    level_misfit,
)

STATIONS = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0]])
CORNERS = np.array([[0.0, 0, 0], [10.0, 10, 0]])


def levels(places):
    return -20 * np.log10(1 + np.linalg.norm(places[:, None] - STATIONS, axis=2))


def snapshots(count, rng, wrong):
    """Noise alike at pairs of stations, `wrong` times what the field says,
    now and then four times that.
    """
    places = rng.uniform(0, 10, (count, 3)) * [1, 1, 0]
    shared = np.repeat(rng.normal(0, 1, (count, 2)), 2, axis=1)
    return places, levels(places) + wrong * shared * np.where(rng.random((count, 1)) < 0.1, 4, 1)


def looked(values, cells):
    mean = torch.from_numpy(levels(cells.centre))
    return [
        PlaceSearch(cells, level_misfit(one[None], mean, torch.ones_like(mean)))
        for one in torch.from_numpy(values)
    ]


@pytest.mark.slow
def test_areas_hold_the_promised_share(monkeypatch):
    # Whatever trust is found, its level holds the share
    monkeypatch.setattr(search, "LOOKS", 50)
    rng = np.random.default_rng(0)
    cells = cover_box(CORNERS, 400, False)
    (places, values), (others, tested) = (snapshots(count, rng, 3.0) for count in (150, 400))
    trust = calibrate_trust(looked(values, cells), places, Trust())
    trust = calibrate_level(trust, looked(values, cells), places, 0.9)
    field = replace(Trust(1.0, 1.0, 100.0), level=0.9)
    seen = list(zip(looked(tested, cells), others, strict=True))
    held, believed = (
        [one.posterior(how).mass_above(place) <= how.level for one, place in seen]
        for how in (trust, field)
    )
    assert 0.84 < np.mean(held) < 0.96, "within two deviations of 150 and 400 drawn places"
    assert np.mean(believed) < 0.7, "as the field itself says they would not"


def test_few_places_promise_the_whole_area():
    rng = np.random.default_rng(1)
    cells = cover_box(CORNERS, 100, False)
    places, values = snapshots(5, rng, 3.0)
    assert calibrate_level(Trust(), looked(values, cells), places, 0.9).level == 1.0
