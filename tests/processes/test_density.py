"""Densities of rows left out against refitting, and their slopes against differences."""

import numpy as np
import pytest
import torch

from gsparc.processes.density import left_out_density
from gsparc.processes.factor import NotDefiniteError
from gsparc.processes.fit_kernel import KernelRows, minimise
from gsparc.processes.kernel import Kernel

KERNELS = (Kernel.from_lengths((0.3,), (1.0,), 0.1), Kernel.from_lengths((0.1, 0.5), (0.3, 0.7), 0.1))


def rows(count: int, outputs: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Distances, columns and values."""
    rng = np.random.default_rng(0)
    places = torch.from_numpy(rng.uniform(size=(count, 3)))
    columns = torch.from_numpy(np.c_[np.ones(count), rng.normal(size=count)])
    return torch.cdist(places, places), columns, torch.from_numpy(rng.normal(size=(count, outputs)))


@pytest.mark.parametrize("outputs", [1, 4])
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("kernel", KERNELS)
def test_slopes_of_the_left_out_density(kernel, bounded, outputs):
    distance, columns, values = rows(40, outputs)

    def density(at: torch.Tensor) -> torch.Tensor:
        gram = KernelRows(distance, columns, values).gram(kernel.with_values(at))
        return left_out_density([(gram, values)], outputs + 1, bounded)[0]

    at = kernel.parameters().requires_grad_()
    (slope,) = torch.autograd.grad(density(at), at)
    for axis in torch.eye(len(at), dtype=torch.float64):
        ends = [float(density(at.detach() + h * axis)) for h in (-1e-5, 1e-5)]
        assert float(slope @ axis) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-5)


def test_it_is_that_of_refitting_without_each_row_at_the_best_amplitude():
    distance, columns, values = rows(12, 3)
    gram = KernelRows(distance, columns, values).gram(KERNELS[1])
    density, amplitude = (float(part) for part in left_out_density([(gram, values)], 3, False))
    total, g, y = 0.0, gram.numpy(), values.numpy()
    for i in range(12):
        rest = np.delete(np.arange(12), i)
        weights = np.linalg.solve(g[np.ix_(rest, rest)], g[rest, i])
        variance = amplitude * (g[i, i] - weights @ g[rest, i])
        errors = (y[i] - weights @ y[rest]) ** 2
        total += (0.5 * np.log(2 * np.pi * variance) + 0.5 * errors / variance).sum()
    assert density == pytest.approx(total / 3, rel=1e-9)


def test_kernels_are_their_parameters():
    for kernel in KERNELS:
        again = kernel.with_values(kernel.parameters())
        numbers = [*again.lengths, *again.shares, again.noise]
        assert np.allclose(numbers, [*kernel.lengths, *kernel.shares, kernel.noise])


def test_a_walk_starts_at_the_best_and_goes_round_what_has_no_factor():
    def objective(at: torch.Tensor) -> torch.Tensor:
        if at[0].item() > 2:
            raise NotDefiniteError
        return (at[0] - 1).square()

    best, value = minimise(objective, [np.array([3.0]), np.array([-1.0])], [(-5.0, 5.0)], 40, 1e-9)
    assert best[0] == pytest.approx(1.0, abs=1e-3) and value < 1e-6
