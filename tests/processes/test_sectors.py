"""Powers of a site's sectors and their covariance, as both are written out in numpy."""

import numpy as np
import torch
from networks import pattern
from scipy.spatial.distance import cdist

from gsparc.processes.sectors import (
    BEARING,
    LEVEL_DB,
    OWN_SPREAD,
    SHARED_SPREAD,
    Sectors,
    SectorShadowing,
)
from gsparc.processes.trend import Law


def test_rows_of_one_sector_share_shadowing_of_their_own_and_a_bearing():
    rng = np.random.default_rng(0)
    number = np.repeat([0.0, 1.0], 6)[:, None]
    places = np.c_[rng.uniform(0, 300, (12, 3)), np.tile([90.0, 40.0, 25.0], (12, 1)), number]
    towards = places[:, :2] - places[:, 3:5]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    far, alike = cdist(places[:, :3], places[:, :3]), np.exp((towards @ towards.T - 1) / BEARING**2)
    own = 0.2 * np.exp(-far / 20.0) + 0.2 * alike + 0.1
    wanted = 0.5 * np.exp(-far / 80.0) + (number == number.T) * own
    at = torch.from_numpy(places)
    found = SectorShadowing((80.0, 20.0), (0.5, 0.2, 0.2, 0.1)).covariance(at, at)
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_levels_follow_law_and_pattern_and_terms_are_their_slopes():
    rng, here = np.random.default_rng(1), np.array([0.0, 0, 30])
    table = np.array([[90.0, 5, 65, 10, 2], [210.0, 3, 70, 9, 0]])
    shared, bend = [3.2, 1.5, 0.1, -0.05, 25.0, 0.5], 1.5
    trend = Sectors(
        0.0,
        Law(0.0, 0.0, 1.0, 1.0, None),
        2.0,
        1.0,
        table=torch.from_numpy(table),
        site=torch.zeros(2).long(),
        band=torch.arange(2),
        shared=torch.tensor(shared).double(),
        doubt=torch.eye(8).double(),
        levels=torch.tensor([-50.0, -44]).double(),
        unit=2.0,
    )
    at = np.c_[rng.uniform(-400, 400, (40, 2)), np.full(40, 1.5)]
    number = np.arange(40) % 2
    places = torch.from_numpy(np.c_[at, np.tile(here, (40, 1)), number])

    def level(change: dict[str, float]) -> np.ndarray:
        """With some of an exponent, an azimuth, a tilt or a floor more."""
        decades = trend.law.decades(places).numpy() - 2
        loss = pattern(
            at,
            np.tile(here, (2, 1)),
            table[:, 0] + change.get("azimuth", 0),
            table[:, 1] + 0.5 + change.get("tilt", 0),
            *(table[:, 2:4] * np.exp([0.1, -0.05])).T,
            25.0 + change.get("floor", 0),
        )[np.arange(40), number]
        own = np.array([-50.0, -44])[number] + table[number, 4]
        return own - 10 * (3.2 + change.get("exponent", 0)) * decades - bend * decades**2 + loss

    def slope(name: str, spread: float) -> np.ndarray:
        return level({name: float(spread) / 2}) - level({name: -float(spread) / 2})

    np.testing.assert_allclose(trend.mean(places), level({}), atol=1e-5)
    # A sector like the second, on its band and on the first: apart by the bands' levels.
    further, second = places.clone(), places.clone()
    further[:, -1], second[:, -1] = 2.0, 1.0
    new = trend.table[1:]
    on = [trend.add_sectors(new, like).mean(further) for like in (1, 0, None)]
    np.testing.assert_allclose(on[0], trend.mean(second))
    np.testing.assert_allclose(on[0] - on[1], 6.0, atol=1e-9)
    np.testing.assert_allclose(on[1], on[2])
    columns, terms = trend.shared_columns(places).numpy(), trend.columns(places).numpy()
    np.testing.assert_allclose(columns[:, 0], slope("exponent", SHARED_SPREAD[0]), atol=1e-5)
    np.testing.assert_allclose(columns[:, 5], slope("tilt", SHARED_SPREAD[5]), atol=1e-5)
    np.testing.assert_allclose(columns[:, 6:], LEVEL_DB * np.eye(2)[number])
    own = terms[:, :10].reshape(40, 2, 5)
    assert (own[np.arange(40), 1 - number] == 0).all()
    own = 2.0 * own[np.arange(40), number]
    np.testing.assert_allclose(own[:, 0], slope("azimuth", OWN_SPREAD[0]), atol=1e-5)
    np.testing.assert_allclose(own[:, 3], slope("floor", OWN_SPREAD[3]), atol=1e-5)
    np.testing.assert_allclose(own[:, 4], OWN_SPREAD[4] * (trend.law.decades(places) - 2))
    np.testing.assert_allclose(terms[:, 10:], columns / 2.0)
