"""The field of fingerprints: its moments, its likelihood, what it is stored as."""

import time

import numpy as np
import pytest
import torch
from access_points import invented
from releases import real
from scipy.stats import multivariate_normal

from gsparc.apps.locate.fingerprints.field import HEARING, FingerprintField, Levels, learn, misfit
from gsparc.data.datasets.fingerprints import parted, read_fingerprints

NAN = float("nan")


def log_likelihood(level, at: Levels, offset=None, sensitivity=0.0) -> torch.Tensor:
    """Log density (m, B) [nats] of rows (m, P) at places."""
    found = misfit(torch.as_tensor(level), at, offset, sensitivity)
    return found.silent - 0.5 * (found.squared + found.size + found.count[:, None] * np.log(2 * np.pi))


def likely(field: FingerprintField, level, places, offset=None) -> torch.Tensor:
    return log_likelihood(level, field.moments(torch.as_tensor(places)), offset, field.sensitivity)


@pytest.fixture(scope="module")
def field() -> FingerprintField:
    return learn(*invented(400))


def test_levels_and_silence_are_predicted_elsewhere(field):
    level, places = invented(200, seed=1)
    found, heard = field.moments(torch.from_numpy(places)), np.isfinite(level)
    error = (level - found.mean.numpy())[heard]
    assert error.std() < 3.5 and abs(error.mean()) < 0.5  # two of them are noise
    squares = error**2 / found.variance.numpy()[heard]
    assert 0.6 < squares.mean() < 1.6
    probability = found.heard.numpy()
    assert probability[heard].mean() > 0.85 and probability[~heard].mean() < 0.4
    assert probability.min() > 0 and probability.max() < 1


def test_row_is_most_likely_near_its_place(field):
    level, places = invented(60, seed=1)
    grid = np.stack(np.meshgrid(np.arange(0, 30, 1.0), np.arange(0, 20, 1.0), [0.0]), -1).reshape(-1, 3)
    found = likely(field, level, grid)
    apart = np.linalg.norm(grid[found.argmax(1).numpy()] - places, axis=1)
    assert np.median(apart) < 1.5
    torch.testing.assert_close(likely(field, level[3:4], grid)[0], found[3], rtol=1e-4, atol=1e-3)


def test_device_offset_is_absorbed(field):
    level, places = invented(60, seed=1)
    grid = invented(300, seed=2)[1]
    plain, shifted = (likely(field, level - 12, grid, offset).argmax(1) for offset in (None, 12.0))
    apart = [np.linalg.norm(grid[best.numpy()] - places, axis=1).mean() for best in (plain, shifted)]
    assert apart[1] < 0.8 * apart[0]


def test_likelihood_is_a_normal_density_with_a_common_part():
    rng = np.random.default_rng(0)
    mean, variance = rng.uniform(-80, -50, (2, 4)), rng.uniform(4, 25, (2, 4))
    heard = rng.uniform(0.2, 0.9, (2, 4))
    levels = Levels(*(torch.from_numpy(part) for part in (mean, variance, heard)))
    row = np.array([-61.0, NAN, -70.0, -55.0])
    here = np.isfinite(row)
    for offset in (None, 5.0):
        found = log_likelihood(torch.from_numpy(row)[None], levels, offset)[0]
        for place in range(2):
            covariance = np.diag(variance[place][here]) + (offset or 0.0) ** 2
            known = multivariate_normal(mean[place][here], covariance).logpdf(row[here])
            known += HEARING * np.where(here, np.log(heard[place]), np.log1p(-heard[place])).sum()
            assert float(found[place]) == pytest.approx(known, abs=1e-3)
    # Sensitivity: the mean over a common normal shift of all log odds.
    odds, draws = np.log(heard / (1 - heard)), rng.normal(0, 1, 200_000)
    sums = [np.prod(1 / (1 + np.exp(-np.where(here, 1, -1) * (o + draws[:, None]))), 1) for o in odds]
    with_, without = (log_likelihood(torch.from_numpy(row)[None], levels, None, s)[0] for s in (1.0, 0.0))
    plain = np.where(here, np.log(heard), np.log1p(-heard)).sum(1)
    wanted = HEARING * (np.log([one.mean() for one in sums]) - plain)
    np.testing.assert_allclose((with_ - without).numpy(), wanted, atol=5e-3)


def test_floors_are_distinguished():
    field = learn(*invented(500, floors=2))
    level, places = invented(100, floors=2, seed=1)
    other = places * [1, 1, 0] + [0, 0, 4.0] - places * [0, 0, 1]
    right, wrong = (likely(field, level, at).diagonal() for at in (places, other))
    assert (right > wrong).float().mean() > 0.9 and field.vertical > 1


def test_few_rows_and_access_points_never_heard():
    level, places = invented(400)
    level[:, 3] = np.nan
    for count in (1, 2, 5, 40):
        found = learn(level[:count], places[:count]).moments(torch.from_numpy(places[:7]))
        assert all(torch.isfinite(part).all() for part in vars(found).values())
        assert (found.variance > 0).all() and (found.heard[:, 3] < 0.1).all()
    with pytest.raises(ValueError, match="5 rows heard no access point"):
        learn(np.full((5, 3), np.nan, np.float32), places[:5])


def test_place_takes_a_millisecond(field):
    """200 access points, as a batch; measured 0.1 to 0.3 ms."""
    rng = np.random.default_rng(0)
    level = np.where(rng.random((400, 200)) < 0.3, rng.uniform(-90, -40, (400, 200)), np.nan)
    wide, places = (
        learn(level.astype(np.float32), invented(400)[1]),
        torch.from_numpy(invented(500, seed=3)[1]),
    )
    wide.moments(places[:10])
    start = time.perf_counter()
    wide.moments(places)
    assert (time.perf_counter() - start) / len(places) < 3e-3  # beside other work


def test_walks_are_placed_better_than_by_the_nearest_row():
    rows = read_fingerprints(real("locate/wifine-floor4.npz"))
    train, test = parted(rows, "walks", share=0.25)
    train, test = train[::3], test[::6]
    field, grid = learn(rows.level[train], rows.position[train]), rows.position[train]
    found = likely(field, rows.level[test], grid, offset=6.0).softmax(1).double().numpy() @ grid
    apart = np.linalg.norm(found - rows.position[test], axis=1)
    assert np.median(apart) < 1.9
