"""Densities and variances of processes by their formulas, in numpy."""

import numpy as np
import torch

from gsparc.processes.averages import mixture_moments
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import EXCESS, NeighbourSample, nearest_density

KERNEL = Kernel.from_lengths((1.2, 6.0), (0.4, 0.6), 0.08)


def test_density_of_rows_given_their_neighbours():
    rng = np.random.default_rng(1)
    places, values = rng.uniform(0, 3, (12, 6, 3)), rng.standard_normal((12, 6, 2))
    count = rng.integers(1, 4, (12, 6)).astype(float)
    squared, variance = [], []
    for row, value, times in zip(places, values, count, strict=True):
        at = torch.from_numpy(row)
        gram = KERNEL.correlations(at, at).numpy() + np.diag(0.08 / times)
        weights = np.linalg.solve(gram[1:, 1:], gram[1:, 0])
        squared.append(np.mean((value[0] - weights @ value[1:]) ** 2))
        variance.append(gram[0, 0] - weights @ gram[1:, 0])
    amplitude = np.mean(np.divide(squared, variance))
    excess = max(np.log(amplitude / np.mean(values[:, 0] ** 2)), 0)
    wanted = 0.5 * (np.log(amplitude) + np.mean(np.log(variance))) + EXCESS * excess**2 / 12
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    sample = NeighbourSample(*map(torch.from_numpy, (apart, values, count)))
    parameters = KERNEL.parameters().requires_grad_()
    nats, found = nearest_density(KERNEL.with_values(parameters), sample)
    assert abs(nats.item() - wanted) < 1e-6 and abs(found.item() / amplitude - 1) < 1e-6
    assert torch.autograd.gradcheck(
        lambda at: nearest_density(KERNEL.with_values(at), sample)[0], parameters
    )


def test_variance_of_a_mixture_has_what_its_members_disagree_about():
    rng = np.random.default_rng(2)
    share, mean, variance = (
        np.array([0.2, 0.5, 0.3]),
        rng.normal(size=(3, 4)),
        rng.uniform(1, 2, (3, 4)),
    )
    parts = list(zip(share, torch.from_numpy(mean), torch.from_numpy(variance), strict=True))
    found = mixture_moments(parts)
    np.testing.assert_allclose(found[0], share @ mean)
    np.testing.assert_allclose(found[1], share @ (variance + mean**2) - (share @ mean) ** 2)
