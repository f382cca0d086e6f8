"""Expectation propagation of "below the level": moments, evidence and its slope."""

import mpmath
import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from gsparc.processes import censored
from gsparc.processes.censored import (
    CERTAIN,
    ConditionalGaussian,
    fit_by_ep,
    log_evidence,
    truncated_moments,
)


def test_moments_of_a_truncated_normal():
    z = torch.tensor(
        [-3000.0, -100.0, -31.0, -30.0, -12.0, -1.0, 0.0, 2.0, 4.0], dtype=torch.float64
    )
    ratio, lost = truncated_moments(z)
    for one, mean, share in zip(z.tolist(), ratio.tolist(), lost.tolist(), strict=True):
        with mpmath.workdps(60):
            exact = mpmath.npdf(one) / mpmath.ncdf(one)
            kept = 1 - exact * (exact + one)
        assert mean == pytest.approx(float(exact), rel=1e-7)
        assert 1 - share == pytest.approx(float(kept), rel=1e-5)
    assert all(
        part.isfinite().all()
        for part in truncated_moments(torch.tensor([-1e8, 1e8], dtype=torch.float64))
    )


def small_vector(count: int = 8):
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(count, 2))
    gram = 30 * np.exp(-cdist(places, places) / 0.5) + 2 * np.eye(count)
    values, unknown = rng.multivariate_normal(np.zeros(count), gram), np.arange(count) > 4
    return tuple(torch.from_numpy(part) for part in (gram, values + unknown, unknown))


@pytest.mark.parametrize("side", [(1, 1, 1), (1, -1, 1)])
def test_evidence_and_means_are_those_of_sampling(side):
    gram, values, unknown = small_vector()
    told, sides = (
        ConditionalGaussian.from_gram(gram, values, unknown),
        torch.tensor(side, dtype=torch.int8),
    )
    sites = fit_by_ep(told, values[unknown], sides)
    normal = multivariate_normal(told.mean, told.covariance, seed=1)
    assert sites.settled
    drawn = normal.rvs(400_000)
    drawn = drawn[(np.array(side) * drawn < np.array(side) * values[unknown].numpy()).all(1)]
    assert sites.log_evidence == pytest.approx(np.log(len(drawn) / 400_000), abs=0.03)
    weights = torch.linalg.solve(
        told.covariance + torch.diag(sites.variance), sites.value - told.mean
    )
    assert np.allclose(told.mean + told.covariance @ weights, drawn.mean(0), atol=0.05)


def test_stand_ins_of_a_similar_vector_are_a_start(monkeypatch):
    gram, values, unknown = small_vector()
    sides, last = unknown.to(torch.int8), []
    log_evidence(1.1 * gram, values, sides, last)
    found = log_evidence(gram, values, sides, last)
    alone, calls = log_evidence(gram, values, sides), []
    assert found[0] == pytest.approx(alone[0], abs=1e-3) and torch.allclose(
        found[1], alone[1], atol=1e-3
    )
    sweep = censored._match_sites
    monkeypatch.setattr(censored, "_match_sites", lambda *given: calls.append(1) or sweep(*given))
    log_evidence(gram, values, sides, last)
    again = len(calls)
    log_evidence(gram, values, sides)
    assert again <= 2 < len(calls) - again


@pytest.mark.parametrize("side", [1, -1])
def test_the_slope_of_the_evidence(monkeypatch, side):
    monkeypatch.setattr(censored, "SETTLED", 1e-10)
    gram, values, unknown = small_vector()
    unknown = side * unknown.to(torch.int8)
    slope = log_evidence(gram, values, unknown)[1]
    change = np.random.default_rng(1).normal(size=gram.shape)
    change = 1e-4 * torch.from_numpy(change + change.T)
    ends = [log_evidence(gram + step * change, values, unknown)[0] for step in (-0.5, 0.5)]
    assert np.vdot(slope, change) == pytest.approx(ends[1] - ends[0], rel=1e-4)


def test_rows_certain_to_be_silent_change_nothing():
    gram, values, unknown = small_vector()
    level = values[unknown] + torch.tensor([0.0, 60.0, 0.0])
    told = ConditionalGaussian.from_gram(gram, values, unknown)
    kept = told.z_score(level) < CERTAIN
    assert kept.tolist() == [True, False, True]
    every, rest = fit_by_ep(told, level), fit_by_ep(told.marginal(kept), level[kept])
    assert np.allclose(every.value[kept], rest.value, atol=1e-2)
    assert np.allclose(every.variance[kept], rest.variance, rtol=1e-2)
