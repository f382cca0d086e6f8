"""Facts of what is measured: real numbers of a target and back, its unit of errors, its power."""

import numpy as np
import pytest
import torch

from gsparc.data.target import TARGETS
from gsparc.physics.decibels import RELATIVE_DB

SHAPES = {"spectrum": (4, 6), "csi": (2, 3), "rssi": (1,)}


def stored(kind: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    values = rng.uniform(0.1, 0.9, (5, *SHAPES[kind])).astype(np.float32)
    return (values * np.exp(6j * values)).astype(np.complex64) if kind == "csi" else values


@pytest.mark.parametrize("kind", SHAPES)
def test_real_numbers_of_targets_are_targets_again(kind):
    target, values = TARGETS[kind], stored(kind)
    rows = target.to_real(values)
    assert rows.dtype == np.float32 and rows.shape == (5, np.prod(SHAPES[kind]) * target.numbers)
    again = target.to_targets(torch.from_numpy(rows), SHAPES[kind])
    assert again.is_complex() == target.is_complex
    np.testing.assert_allclose(again.numpy(), values, rtol=1e-5)


@pytest.mark.parametrize("kind", SHAPES)
def test_variances_in_the_unit_of_errors_are_those_of_numbers(kind):
    # There and back again: a variance per real number is the squared error per entry,
    # and of powers in dB.
    target = TARGETS[kind]
    mean, variance = torch.from_numpy(stored(kind)), torch.full((5,), 1e-4)
    entry = target.entry_variance(variance, mean)
    level, spread = target.moments_in_error_unit(mean, entry)
    torch.testing.assert_close(spread, variance * target.numbers)
    torch.testing.assert_close(level, target.in_error_unit(mean))


def test_an_error_of_a_power_is_one_of_decibels_to_first_order():
    power = torch.tensor([[2.0]])
    spread = TARGETS["rssi"].moments_in_error_unit(power, torch.tensor([0.01]))[1]
    assert float(spread) == pytest.approx((RELATIVE_DB * 0.1 / 2) ** 2)


def test_powers_that_are_weighed_in_decibels_were_averaged_as_such():
    own, other = torch.tensor([1e-6]), torch.tensor([1e-10])
    powers = TARGETS["rssi"]
    assert float(powers.in_error_unit(powers.blend(own, other, 0.25))) == pytest.approx(-70)
    assert float(TARGETS["csi"].blend(own, other, 0.25)) == pytest.approx(0.75e-6, rel=1e-4)
