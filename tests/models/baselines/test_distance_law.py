"""The distance law against what made the powers: exponent, floor, outliers, unknown places,
moving ends.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.distance_law import (
    EXPONENTS,
    MASS,
    VARIANCE,
    DistanceLaw,
    Law,
    fit_law,
    law_variance,
    likelihood_slopes,
    locate_still_end,
    log_probability_below,
)
from gsparc.processes.powers import PowerRows
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

STILL = np.array([3.0, -8.0, 6.0])


def rows_of(
    count: int = 300, exponent: float = 2.7, floor: float = 0.0, noise: float = 3.0
) -> PowerRows:
    rng = np.random.default_rng(0)
    places = np.c_[rng.uniform(-40, 40, (count, 2)), np.full(count, 1.5)]
    far = np.maximum(np.linalg.norm(places - STILL, axis=1), floor)
    decibels = -40 - 10 * exponent * np.log10(far) + noise * rng.standard_normal(count)
    return PowerRows(places, decibels, np.zeros(count, bool))


def data_of(rows: PowerRows, **more: np.ndarray) -> Measurements:
    arrays = {"rx_position": rows.places, "tx_position": STILL, "rssi_db": rows.decibels}
    return from_arrays({**arrays, **more}, {"name": "law"})


def fitted(data: Measurements) -> tuple[DistanceLaw, tuple[str, ...]]:
    method, every = DistanceLaw(), np.arange(len(data))
    return method, method.fit(data, Fold(every, every[:0], every), FitContext()).notes


def test_the_law_is_found():
    law = fit_law(rows_of(), STILL)
    assert law.exponent == pytest.approx(2.7, abs=0.25) and law.level == pytest.approx(-40, abs=4)
    assert law_variance(law) ** 0.5 == pytest.approx(3.0, rel=0.12)


def test_the_floor_is_found():
    law = fit_law(rows_of(2000, exponent=4.0, floor=20.0, noise=1.0), STILL)
    assert law.floor == pytest.approx(20.0, rel=0.25) and law.exponent == pytest.approx(
        4.0, abs=0.4
    )


def test_outliers_bend_little():
    rows = rows_of()
    spoilt = rows.decibels.copy()
    spoilt[:9] += 60.0
    exponent = fit_law(replace(rows, decibels=spoilt), STILL).exponent
    assert exponent == pytest.approx(fit_law(rows, STILL).exponent, abs=0.5)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_rows_give_a_usual_law(count):
    law = fit_law(rows_of().subset(np.arange(count)), STILL)
    assert (
        EXPONENTS[0] <= law.exponent <= EXPONENTS[1]
        and np.isfinite([law.level, law_variance(law)]).all()
    )


def test_the_density_has_mass_one_and_its_variance():
    def density(z: float) -> float:
        return float(np.exp(-likelihood_slopes(np.array([z]), np.array([False]), 1.0)[0]))

    ends = [-40, -3, 3, 40]
    for power, expected in ((0, 1.0), (2, VARIANCE)):
        parts = [
            quad(lambda z, power=power: z**power * density(z), a, b)[0] for a, b in pairwise(ends)
        ]
        assert sum(parts) == pytest.approx(expected, rel=1e-6)
    for z in (-7.0, -3.0, -1.0, 0.5, 3.0, 5.0):
        below = sum(quad(density, a, min(b, z))[0] for a, b in pairwise(ends) if a < z)
        assert log_probability_below(np.array([z]))[0] == pytest.approx(np.log(below), abs=1e-6)
    assert MASS > 0 and np.isfinite(log_probability_below(np.array([-1e9, 1e9]))).all()


def test_slopes_of_the_misfit():
    rng = np.random.default_rng(1)
    residual, side = 6 * rng.standard_normal(40), rng.integers(-1, 2, 40)
    _, slope, by_scale = likelihood_slopes(residual, side, 2.0)
    step = 1e-5 * rng.standard_normal(40)
    ends = [likelihood_slopes(residual + sign * step, side, 2.0)[0] for sign in (-0.5, 0.5)]
    assert slope @ step == pytest.approx(ends[1] - ends[0], rel=1e-4)
    ends = [likelihood_slopes(residual, side, 2.0 * np.exp(sign * 1e-5))[0] for sign in (-0.5, 0.5)]
    assert by_scale == pytest.approx((ends[1] - ends[0]) / 1e-5, rel=1e-4)


def test_an_estimated_station_stood_under_the_ground():
    """Powers at places of one height fit a station 78 m below these as well as one above."""
    rows = rows_of(noise=4.0, count=60)
    assert [round(locate_still_end(rows, seed)[2], 1) for seed in range(3)] == [7.4] * 3


def test_a_place_nobody_gave_is_estimated_and_said():
    rows = rows_of(noise=1.0)
    place = locate_still_end(rows)
    assert np.linalg.norm(place[:2] - STILL[:2]) < 3.0
    data = data_of(rows)
    unknown = replace(data, site=replace(data.site, static_position=None))
    method, notes = fitted(unknown)
    assert "the transmitter's place is not given; estimated from powers at (" in notes[1]
    said = np.array([float(v) for v in notes[1].split("(")[1].split(")")[0].split(",")])
    assert np.allclose(said, np.array(method.law.place) + data.site.origin, rtol=1e-3)
    known, plain = fitted(data)
    assert len(plain) == 1 and law_variance(method.law) < 1.3 * law_variance(known.law)


def test_the_floor_holds_near_the_place():
    law = Law(-40.0, 2.0, 5.0, 1.0, (0.0, 0.0, 0.0))
    places = torch.tensor([[0.0, 0, 0], [5.0, 0, 0], [50.0, 0, 0]], dtype=torch.float64)
    assert np.allclose(law.mean(places).numpy(), -40 - 20 * np.log10([5, 5, 50]))


def test_powers_were_flat_nearer_than_the_nearest_row():
    """Of a run past a station that others had kept 210 m away: 30 dB too low, stated +- 7."""
    every = rows_of(2000, exponent=3.3, noise=1.0)
    apart = np.linalg.norm(every.places - STILL, axis=1)
    law = fit_law(every.subset(np.flatnonzero(apart > np.quantile(apart, 0.3))), STILL)
    near = every.subset(
        np.flatnonzero((apart > apart.max() / 20) & (apart < np.quantile(apart, 0.1)))
    )
    assert np.abs(near.decibels - law.mean(torch.from_numpy(near.places)).numpy()).mean() < 2.0
