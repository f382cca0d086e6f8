"""Posteriors against an independent library,
and complex ones against twice as many real numbers.
"""

import math

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern

from gsparc.processes import posterior
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.kernel import (
    ExponentialShadowing,
    IsotropicWaves,
    Kernel,
    Shadowing,
    WhiteNoise,
)
from gsparc.processes.nearest import Nearest, PlaceValues, condition_on_nearest
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Law, Trend


@pytest.mark.parametrize("term", [Shadowing, ExponentialShadowing])
@pytest.mark.parametrize("seed", range(20))
def test_random_problems_are_scikit_learns(seed, term):
    """Mean, covariance and density of two terms about an uncertain level, all weighed."""
    rng = np.random.default_rng(seed)
    count, outputs, share = rng.integers(5, 60), rng.integers(1, 4), rng.uniform(0.1, 0.9)
    lengths, noise, level = rng.uniform(0.1, 3, 2), 10 ** rng.uniform(-3, 0), rng.normal()
    places, queries = rng.uniform(0, 4, (count, 3)), rng.uniform(-1, 5, (7, 3))
    values, amplitude = rng.normal(size=(count, outputs)), rng.uniform(0.1, 3)
    kernel = Kernel(
        (Shadowing(lengths[0], share), term(lengths[1], 1 - share), WhiteNoise(noise)), amplitude
    )
    ours = Exact.from_values(
        Prior(kernel, Trend(level)), torch.from_numpy(places), torch.from_numpy(values)
    )
    found = ours.answer(torch.from_numpy(queries))
    shape = ConstantKernel(share) * Matern(lengths[0], nu=1.5) + ConstantKernel(1.0)
    shape += ConstantKernel(1 - share) * Matern(lengths[1], nu=1.5 if term is Shadowing else 0.5)
    shape *= ConstantKernel(amplitude)
    library = GaussianProcessRegressor(shape, alpha=amplitude * noise, optimizer=None)
    mean, covariance = library.fit(places, values - level).predict(queries, return_cov=True)
    covariance = covariance[..., 0] if covariance.ndim == 3 else covariance  # alike for all outputs
    np.testing.assert_allclose(found.mean, mean.reshape(7, -1) + level, atol=1e-8)
    np.testing.assert_allclose(
        amplitude * (found.variance - noise), covariance.diagonal(), atol=1e-8
    )
    np.testing.assert_allclose(ours.covariance(torch.from_numpy(queries)), covariance, atol=1e-8)
    np.testing.assert_allclose(ours.given_values(), values, atol=1e-8)
    given = torch.from_numpy(values - level) / amplitude**0.5
    nats = Conditioned(ours.factor, given, ours.weights / amplitude**0.5).nll
    nats += count * outputs / 2 * math.log(2 * math.pi * amplitude)
    assert -nats == pytest.approx(library.log_marginal_likelihood_value_)


@pytest.mark.parametrize("seed", range(5))
def test_circular_values_are_real_and_imaginary_parts_of_one_covariance(seed):
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(30, 3, generator=generator, dtype=torch.float64)
    values = torch.randn(30, 2, generator=generator, dtype=torch.complex128)
    prior = Prior(Kernel((IsotropicWaves(0.7, 1.0, 20.0), WhiteNoise(0.05))))
    both = Exact.from_values(prior, places, values)
    pairs = Exact.from_values(prior, places, torch.cat([values.real, values.imag], 1))
    queries = torch.rand(6, 3, generator=generator, dtype=torch.float64)
    one, two = both.answer(queries), pairs.answer(queries)
    torch.testing.assert_close(one.mean, torch.complex(*two.mean.split(2, 1)))
    torch.testing.assert_close(one.variance, two.variance)
    near = condition_on_nearest(
        prior, PlaceValues(places.numpy(), values, torch.ones(30).double()), 0, neighbours=1000
    )
    torch.testing.assert_close(near.answer(queries).mean, one.mean, rtol=1e-5, atol=1e-6)
    again = Nearest.read(near.state()).answer(queries)
    torch.testing.assert_close(again.mean, near.answer(queries).mean)


def test_density_and_slope_of_circular_values():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(12, 24, generator=generator, dtype=torch.complex128)
    covariance, values = (
        root @ root.mH / 12,
        torch.randn(12, 3, generator=generator, dtype=torch.complex128),
    )
    change = torch.randn(12, 12, generator=generator, dtype=torch.complex128)
    change = 1e-6 * (change + change.mH)
    ends = [Conditioned.from_gram(covariance + step * change, values).nll for step in (-0.5, 0.5)]
    told = Conditioned.from_gram(covariance, values)
    expected = float((told.nll_gradient @ change).diagonal().sum().real)
    assert ends[1] - ends[0] == pytest.approx(expected, rel=1e-5)
    density = (
        3 * torch.logdet(covariance).real
        + (values.mH @ torch.linalg.solve(covariance, values)).trace().real
    )
    assert told.nll == pytest.approx(float(density))


@pytest.mark.parametrize(
    "trend", [Trend(-70.0), Trend(0.0, Law(-40.0, 3.0, 0.1, 5.0, (0.5, 0.5, 3.0)))]
)
def test_variance_of_many_rows_is_of_the_nearest(trend, monkeypatch):
    """Within 2 % at places among the rows and far from all; means are the exact ones."""
    rng = np.random.default_rng(0)
    places = torch.from_numpy(np.c_[rng.uniform(0, 10, (1_500, 2)), np.zeros(1_500)])
    kernel = Kernel.from_lengths((0.4, 3.0), (0.4, 0.6), 0.05, 20.0)
    values = -60 + 3 * torch.sin(places[:, :1]) + torch.from_numpy(rng.normal(size=(1_500, 1)))
    many = Exact.from_values(Prior(kernel, trend), places, values)
    inside = torch.from_numpy(np.c_[rng.uniform(0, 10, (200, 2)), np.zeros(200)])
    queries = torch.cat([inside, inside + torch.tensor([300.0, 0.0, 0.0])])
    near = many.answer(queries)
    monkeypatch.setattr(posterior, "MANY", 10_000)
    exact = Exact.from_values(Prior(kernel, trend), places, values).answer(queries)
    assert torch.equal(near.mean, exact.mean)
    assert float((near.variance / exact.variance - 1)[:200].abs().max()) < 0.02
    assert float((near.variance / exact.variance - 1)[200:].abs().max()) < 0.02
