"""Single places answered by the kernels are what plain PyTorch answers."""

import pytest
import torch
from compute_kernels import SETS, assert_threads_agree, instruction_set

from gsparc.datasets.rfid import planar_array
from gsparc.models.channels.kernels import directional_correlation, fibonacci_sphere
from gsparc.ops import SphereGrid
from gsparc.ops.queries import (
    array_spectrum,
    has_query_kernel,
    nearest_weights,
    sum_directional,
)
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.processes.features import correlation, matern_mixture
from gsparc.processes.kernel import ExponentialShadowing, Kernel, Shadowing, WhiteNoise
from gsparc.processes.nearest import JITTER, neighbour_weights


@pytest.mark.parametrize(
    "grid", [SphereGrid.hemisphere(6, 10), SphereGrid(5, 7, 0.1, 0.3, 0.2, 0.4)]
)
@pytest.mark.parametrize("height", [0.0, 0.07])
@pytest.mark.parametrize("name", ["smooth_rough", "matern32"])
def test_spectra_of_an_array(grid, height, name):
    """With and without the half-turn shortcut, of one place and of several,
    at a trained place and afar.
    """
    torch.manual_seed(0)
    array = planar_array()
    array[3, 2] = height
    renderer = SpectrumRenderer(array, grid, 0.3, torch.rand(grid.height, grid.width))
    anchors, whitening = torch.rand(37, 3), torch.randn(37, 21) / 40
    weights, offset = torch.randn(21, 34) / 30, torch.randn(34) / 300
    weights[:, -2:], offset[-2:] = 0, 0
    places = torch.cat([torch.rand(4, 3), anchors[:1], torch.full((1, 3), 1e4)])
    features = correlation(places, anchors, 0.4, name) @ whitening
    parts = torch.addmm(offset, features, weights).view(len(places), -1, 2)
    share = (1 - features.square().sum(1)).clamp(0, 1)
    parts[:, -1, 0] = share.sqrt()
    expected = renderer(torch.view_as_complex(parts)).clamp(max=1)
    for rows in (slice(None), slice(2, 3)):
        image, unknown = array_spectrum(
            places[rows],
            (anchors, whitening),
            (weights, offset),
            renderer.tables,
            renderer.square,
            matern_mixture(0.4, name),
        )
        torch.testing.assert_close(image, expected[rows], atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(unknown, share[rows], atol=2e-6, rtol=0)


@pytest.mark.parametrize("near", [1, 5, 64])
@pytest.mark.parametrize(
    "kernel",
    [
        Kernel.from_length(0.3, 0.1),
        Kernel.from_lengths((0.05, 2.0), (0.3, 0.7), 0.01),
        Kernel((Shadowing(0.05, 0.3), ExponentialShadowing(2.0, 0.7), WhiteNoise(0.01))),
    ],
)
def test_weights_of_the_nearest_rows(near, kernel):
    torch.manual_seed(1)
    places, queries = torch.rand(200, 3, dtype=torch.float64), torch.rand(7, 3, dtype=torch.float64)
    queries[0] = places[3]
    noise = kernel.noise * (1 + torch.rand(200, dtype=torch.float64))
    rows = torch.cdist(queries, places).topk(near, largest=False).indices
    expected = neighbour_weights(kernel, queries, places[rows], noise[rows])
    found = nearest_weights(
        queries, places, noise + JITTER, rows, kernel.compiled_lengths, kernel.shares
    )
    assert found is not None
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-10, rtol=1e-9)


def test_rows_without_a_factor_are_said():
    places = torch.zeros(3, 3, dtype=torch.float64)
    noise, rows = torch.full((3,), -0.5, dtype=torch.float64), torch.tensor([[0, 1, 2]])
    assert nearest_weights(places[:1], places, noise, rows, (1.0,), (1.0,)) is None


@SETS
@pytest.mark.parametrize("concentration", [0.01, 5.0, 60.0])
def test_sums_of_waves_from_many_directions(name, concentration):
    """A place beside itself, beside its neighbour and a thousand wavelengths on."""
    torch.manual_seed(2)
    places, rows = torch.rand(5, 3, dtype=torch.float64), torch.rand(19, 3, dtype=torch.float64)
    rows[:2], rows[2] = places[:2], places[2] + 1e-9
    squared, angles = 9e6 * (places[:, None] - rows).square().sum(2), fibonacci_sphere(7)
    before, after = 3e3 * angles @ places.T, 3e3 * angles @ rows.T
    powers = torch.rand(6, 7, dtype=torch.float64)
    along = before[:, :, None] - after[:, None]
    each = directional_correlation(squared, along, concentration)
    expected = torch.tensordot(powers.to(each.dtype), each, 1)
    with instruction_set(name):
        for sets in (powers, powers[:1]):
            (sums,) = assert_threads_agree(
                lambda sets=sets: [sum_directional(squared, before, after, sets, concentration)]
            )
            torch.testing.assert_close(sums, expected[: len(sets)], atol=1e-10, rtol=0)


def test_followed_tensors_are_left_to_autograd():
    assert has_query_kernel(torch.ones(2))
    assert not has_query_kernel(torch.ones(2, requires_grad=True))
    with torch.no_grad():
        assert has_query_kernel(torch.ones(2, requires_grad=True))
