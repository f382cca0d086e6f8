import numpy as np
import pytest
import torch

from gsparc.models.mixture.weights import Rows, error, explained, share_of_second, weights

EACH = np.arange(50)  # every row is a unit
TARGET = torch.from_numpy(np.random.default_rng(0).standard_normal((50, 3)))


def noisy(share: float, seed: int) -> torch.Tensor:
    return TARGET + share * torch.from_numpy(np.random.default_rng(seed).standard_normal(TARGET.shape))


def test_equal_errors_share_and_large_ones_have_nothing():
    found = weights([noisy(0.3, 1), noisy(0.3, 2), noisy(5.0, 3)], TARGET, EACH)
    assert sum(found) == pytest.approx(1) and found[2] == 0
    assert found[0] == pytest.approx(0.5, abs=0.1)


def test_one_far_ahead_predicts_alone():
    assert weights([noisy(0.01, 1), noisy(0.3, 2)], TARGET, EACH) == (1.0, 0.0)


def test_rows_of_one_unit_do_not_make_a_mixture():
    """One square of floor: whichever mixture fits it says nothing about the next."""
    assert sorted(weights([noisy(0.3, 1), noisy(0.31, 2)], TARGET, 0 * EACH)) == [0, 1]


def test_complex_predictions_are_weighed_as_they_are_summed():
    turned = torch.complex(noisy(0.3, 1), noisy(0.3, 2))
    other = torch.complex(noisy(0.3, 3), noisy(0.3, 4))
    target = torch.complex(TARGET, TARGET)
    found = weights([turned, other], target, EACH)
    mixed = found[0] * turned + found[1] * other
    assert error(mixed, target) < min(error(turned, target), error(other, target))


def test_silent_targets_still_give_weights():
    assert sum(weights([noisy(0.1, 1), noisy(0.2, 2)], torch.zeros_like(TARGET), EACH)) == pytest.approx(1)


def test_what_is_explained_is_about_the_mean_of_powers_and_about_zero_of_channels():
    assert explained(torch.zeros_like(TARGET) + TARGET.mean(0), TARGET, True) == pytest.approx(0)
    assert explained(TARGET, TARGET, False) == 1
    assert explained(torch.zeros_like(TARGET), TARGET, False) == 0


def rows(own: float, plain: float, count: int, seed: int = 0) -> Rows:
    draws = np.random.default_rng(seed)
    target = draws.uniform(0, 1, (count, 40))
    noise = draws.standard_normal((2, count, 40))
    return Rows(target + own * noise[0], target + plain * noise[1], target)


def test_the_second_has_the_weight_of_largest_psnr():
    assert share_of_second([rows(0.1, 0.1, 200)]) == pytest.approx(0.5, abs=0.05)
    assert share_of_second([rows(0.01, 0.3, 200)]) == 0.0
    assert share_of_second([rows(0.3, 0.01, 200)]) == 1.0
    # A query that takes longer is worth little, a loss to the process beside it is not.
    assert share_of_second([rows(0.102, 0.1, 20_000)]) > 0


def test_every_row_counts_once_whichever_part_it_is_of():
    few, many = rows(0.3, 0.05, 3, 1), rows(0.05, 0.3, 300, 2)
    assert share_of_second([few, many]) < 0.1 < share_of_second([few])
