"""Expected errors against known ones, at synthetic places."""

import numpy as np
import pytest
import torch
from distances import far

from gsparc.models.moving_array.error_regression import _posterior_variance, fit_errors
from gsparc.processes.kernel import Kernel

KERNEL, REACH, PRIOR = Kernel.from_length(1.0, 0.1), 2.0, 0.05


def fit(places, errors, observed):
    errors, observed = (torch.from_numpy(value).float() for value in (errors, observed))
    return fit_errors(places, errors, observed, KERNEL, REACH, PRIOR)


def said_of(model, places, queries, observed):
    distances = far(queries, places)
    return model.error_and_nearest(distances, torch.from_numpy(observed).float())[0].numpy()


def features(count, seed=0):
    rng = np.random.default_rng(seed)
    mean, added, peak = (rng.uniform(0.5, 1.5, count) for _ in range(3))
    return np.column_stack([np.log(mean), np.log(added), peak])


@pytest.fixture(scope="module")
def half_bad():
    """One half of a floor errs ten times as much as the other."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(0, 10, 400), rng.uniform(0, 8, 400), np.full(400, 1.3)])
    truth = np.where(places[:, 0] > 5, 0.3, 0.03)
    return fit(places, truth * rng.lognormal(-0.125, 0.5, 400), features(400)), places


def test_the_error_of_each_half_is_predicted(half_bad):
    here = np.column_stack([np.linspace(1, 9, 9), np.full(9, 4.0), np.full(9, 1.3)])
    said = said_of(*half_bad, here, features(9, 1))
    assert said[:4].max() < 0.06 and said[5:].min() > 0.18
    assert said[:4].mean() == pytest.approx(0.03, rel=0.4) and said[5:].mean() == pytest.approx(
        0.3, rel=0.4
    )


def test_the_error_grows_far_away_to_that_of_an_image_drawn_at_random(half_bad):
    """Near rows it is the relative one."""
    away = np.array([[10.0, 4, 1.3], [13.0, 4, 1.3], [1e4, 4, 1.3]])
    near, off, lost = said_of(*half_bad, away, features(3))
    assert near < off < lost and np.isfinite(lost)
    away = np.array([[5.0, 4, 1.3], [1e2, 4, 1.3]])
    model, places = half_bad
    observed = torch.from_numpy(features(2)).float()
    unknown, variance = model.unknown_and_variance(
        far(away, places), observed, torch.tensor([0.01, 0.01])
    )
    assert unknown[0] < 0.6 and unknown[1] == 1
    assert variance[0] < 0.01 and float(variance[1]) == pytest.approx(PRIOR)


def test_a_variance_needs_the_nearest_rows_only():
    rng = np.random.default_rng(3)
    places, queries = (
        rng.uniform(0, 5, (300, 3)) * [1, 1, 0.1],
        rng.uniform(1, 4, (20, 3)) * [1, 1, 0.1],
    )
    model = fit(places, rng.lognormal(-2, 0.3, 300), features(300))
    distance = far(queries, places)
    row = distance.argmin(1)
    at = torch.from_numpy(places)
    cross, gram = (
        KERNEL.correlations(torch.from_numpy(queries), at).numpy(),
        KERNEL.gram(at).numpy(),
    )
    exact = 1.1 - (cross * np.linalg.solve(gram, cross.T).T).sum(1)
    near = _posterior_variance(
        KERNEL, distance.gather(1, model.near[row]), model.precision[row]
    ).numpy()
    assert (
        (near > exact - 1e-6).all()
        and (near < 1.5 * exact).all()
        and near.mean() < 1.1 * exact.mean()
    )
