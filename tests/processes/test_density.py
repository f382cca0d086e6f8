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


def stations(*more: torch.Tensor) -> list[KernelRows]:
    """Six processes of 20 rows, and of `more` values at places next to each other."""
    rng, result = np.random.default_rng(4), []
    for values in (*torch.from_numpy(rng.normal(size=(6, 20, 1))), *more):
        places = torch.from_numpy(rng.uniform(size=(len(values), 3)) * (1.0 if len(values) > 2 else 1e-3))
        signal = torch.sin(4 * places[:, :1]) if len(values) > 2 else 0.0
        result.append(
            KernelRows(torch.cdist(places, places), torch.ones(len(values), 1).double(), signal + values)
        )
    return result


def test_the_median_station_of_one_row_had_a_residual_of_0_and_a_slope_that_was_nan():
    """Its best amplitude is 0, whose inverse overflows; the walk of the common kernel ended in a corner."""
    one, two = torch.zeros(1, 1).double(), torch.zeros(2, 1).double()
    for views in ([KernelRows(one, None, one)], stations(one, two), stations(one + 1e-170)):
        for alike in (0.0, 10.0):
            at = KERNELS[1].parameters().requires_grad_()
            parts = [(view.gram(KERNELS[1].with_values(at)), view.values) for view in views]
            density, amplitudes = left_out_density(parts, alike=alike)
            (slope,) = torch.autograd.grad(density, at)
            assert slope.isfinite().all() and density.isfinite() and amplitudes.isfinite().all()


def test_an_objective_without_a_slope_says_so():
    with pytest.raises(AssertionError, match="no slope"):
        minimise(lambda at: (at - 2).abs().sum().sqrt(), [np.full(1, 2.0)], [(0.0, 5.0)])


def test_slopes_of_processes_about_a_common_amplitude():
    views = stations(torch.zeros(1, 1).double(), torch.full((2, 1), 0.4).double())
    views[0] = views[0]._replace(values=5 * views[0].values)

    def density(at: torch.Tensor) -> torch.Tensor:
        kernel = KERNELS[1].with_values(at)
        return left_out_density([(view.gram(kernel), view.values) for view in views], alike=10.0)[0]

    at = KERNELS[1].parameters().requires_grad_()
    (slope,) = torch.autograd.grad(density(at), at)
    for axis in torch.eye(len(at), dtype=torch.float64):
        ends = [float(density(at.detach() + h * axis)) for h in (-1e-5, 1e-5)]
        assert float(slope @ axis) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-4, abs=1e-6)


def test_a_process_without_spread_has_the_amplitude_of_all():
    """Its own, next to 0, would say that there is no noise: it is divided by."""
    views = stations(torch.zeros(1, 1).double(), torch.full((2, 1), 1e-9).double())
    parts = [(view.gram(KERNELS[1]), view.values) for view in views]
    alone, shared = (left_out_density(parts, alike=alike)[1] for alike in (0.0, 10.0))
    typical = float(shared[:6].mean())
    assert (alone[6:] < 1e-12).all() and (shared[6:] > 0.5 * typical).all()
    assert np.allclose(shared[:6], (20 * alone[:6] + 10 * typical) / 30, rtol=0.2)
