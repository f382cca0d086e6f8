"""`h = A z`, `|A^H h|`, its lags and the normalisation,
against sums written out and the simulator.
"""

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from gsparc.datasets.rfid import planar_array
from gsparc.ops import SphereGrid
from gsparc.physics import array_response

WAVELENGTH = 0.3259


def _vectors(rows, elements, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(
        rng.normal(size=(rows, elements)) + 1j * rng.normal(size=(rows, elements))
    )


@pytest.mark.parametrize(
    "array", [planar_array(), np.random.default_rng(1).normal(size=(5, 3)) * 0.2]
)
def test_squared_spectrum_is_linear_in_the_lags(array):
    grid, h = SphereGrid.hemisphere(7, 12), _vectors(3, len(array))
    lags = array_response.make_co_array(array, WAVELENGTH)
    direct = (
        array_response.bartlett_spectrum(h, array_response.steering_matrix(array, grid, WAVELENGTH))
        ** 2
    )
    v = torch.cat([h.real, h.imag], 1)
    numbers = torch.einsum("bi,kij,bj->bk", v, lags.quadratic_forms(), v)
    torch.testing.assert_close(numbers @ lags.spectrum_basis(grid, WAVELENGTH).T, direct)


def test_array_output_is_the_weighted_sum_over_directions():
    grid, array = SphereGrid.hemisphere(4, 6), planar_array(2, 2)
    z = _vectors(1, 24).view(1, 4, 6)
    pattern = array_response.element_pattern(grid, 1.5)
    h = array_response.array_output(
        z, array_response.steering_matrix(array, grid, WAVELENGTH), grid, pattern
    )
    expected = torch.zeros(4, dtype=torch.complex128)
    for i in range(4):
        for j in range(6):
            u = grid.directions()[i, j].numpy()
            turn = np.exp(2j * np.pi / WAVELENGTH * array @ u)
            weight = grid.solid_angles()[i, j] * max(u[2], 0) ** 1.5
            expected += z[0, i, j] * weight * torch.from_numpy(turn)
    torch.testing.assert_close(h[0], expected)


@pytest.mark.parametrize("how", ["max", "minmax", "power", "none"])
def test_slopes_through_the_array_and_the_normalisation(how):
    grid, array = SphereGrid.hemisphere(3, 4), planar_array(2, 2)
    matrix = array_response.steering_matrix(array, grid, WAVELENGTH)

    def splat_then_array(real, imag):
        h = array_response.array_output(torch.complex(real, imag), matrix, grid)
        return array_response.normalise_spectrum(array_response.bartlett_spectrum(h, matrix), how)

    parts = [
        v.clone().requires_grad_()
        for v in torch.view_as_real(_vectors(2, 12).view(2, 3, 4)).unbind(-1)
    ]
    assert torch.autograd.gradcheck(splat_then_array, parts)


def test_slope_where_the_spectrum_vanishes_is_zero_not_nan():
    matrix = torch.ones(2, 1, dtype=torch.complex128)
    h = torch.tensor([[1.0 + 0j, -1.0]], dtype=torch.complex128, requires_grad=True)
    array_response.bartlett_spectrum(h, matrix).sum().backward()
    assert torch.equal(h.grad, torch.zeros_like(h))


def test_normalised_silence_is_finite():
    for how in ("max", "minmax", "power", "none"):
        assert torch.isfinite(array_response.normalise_spectrum(torch.zeros(1, 5), how)).all()
    with pytest.raises(ValueError, match="median"):
        array_response.normalise_spectrum(torch.zeros(1, 5), "median")


def test_sites_without_an_array_are_named(campaign):
    assert "no antenna array" in campaign("spectrum", 4).site.array_problem
    assert "csi" in campaign("csi", 4).site.array_problem
    assert "receiver moves" in campaign("spectrum", 4, "tx").site.array_problem


@pytest.mark.parametrize("pattern", [False, True])
def test_weights_of_directions_stayed_on_the_cpu(pattern):
    """A GPU's arrays met them there; fake tensors tell devices apart without one."""
    grid = SphereGrid.hemisphere(4, 8)
    with FakeTensorMode():
        waves = torch.zeros(2, 4, 8, dtype=torch.complex64, device="cuda")
        matrix = torch.zeros(3, 32, dtype=torch.complex64, device="cuda")
        elements = torch.zeros(4, 8, dtype=torch.float64, device="cuda") if pattern else None
        assert array_response.array_output(waves, matrix, grid, elements).device.type == "cuda"
