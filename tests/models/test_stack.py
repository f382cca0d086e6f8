"""Weights of several predictors, by rows that none of them learned from."""

import math

import numpy as np
import pytest
import torch

from gsparc.models.stack import (
    best_weights,
    error_products,
    explained_variance,
    weigh,
)

EACH = np.arange(50)  # every row is a unit
TARGET = torch.from_numpy(np.random.default_rng(0).standard_normal((50, 3)))


def noisy(share: float, seed: int) -> torch.Tensor:
    return TARGET + share * torch.from_numpy(
        np.random.default_rng(seed).standard_normal(TARGET.shape)
    )


def weights_of(
    predicted: list[torch.Tensor], target: torch.Tensor, unit: np.ndarray, sure: float = 1.0
):
    """Weights, one a prediction."""
    return tuple(weigh(error_products(predicted, target), unit, "square", sure))


def share(*pairs: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Weight of the second of two predictions of spectra,
    where its mean with the first costs more.
    """
    grams = [
        error_products([*map(torch.from_numpy, both)], torch.from_numpy(last))
        for *both, last in pairs
    ]
    products = np.concatenate(grams)
    return float(weigh(products, np.arange(len(products)), "log", slow=(False, True))[1])


def test_a_mixture_need_not_be_surely_better_where_that_is_not_asked_for():
    few = weights_of([noisy(0.3, 1), noisy(0.33, 2)], TARGET, EACH, math.inf)
    assert (
        few == (1.0, 0.0)
        and 0 < weights_of([noisy(0.3, 1), noisy(0.33, 2)], TARGET, EACH, 0.0)[1] < 0.6
    )


def test_rows_of_one_unit_do_not_make_a_mixture():
    """One square of floor: whichever mixture fits it says nothing about the next."""
    assert sorted(weights_of([noisy(0.3, 1), noisy(0.31, 2)], TARGET, 0 * EACH)) == [0, 1]


def test_silent_targets_still_give_weights():
    assert sum(
        weights_of([noisy(0.1, 1), noisy(0.2, 2)], torch.zeros_like(TARGET), EACH)
    ) == pytest.approx(1)


def test_what_is_explained_is_about_the_mean_of_powers_and_about_zero_of_channels():
    assert explained_variance(
        torch.zeros_like(TARGET) + TARGET.mean(0), TARGET, True
    ) == pytest.approx(0)
    assert explained_variance(TARGET, TARGET, False) == 1
    assert explained_variance(torch.zeros_like(TARGET), TARGET, False) == 0


def rows(
    own: float, plain: float, count: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    draws = np.random.default_rng(seed)
    target = draws.uniform(0, 1, (count, 40))
    noise = draws.standard_normal((2, count, 40))
    return (target + own * noise[0], target + plain * noise[1], target)


def test_the_second_has_the_weight_of_largest_psnr():
    assert share(rows(0.1, 0.1, 200)) == pytest.approx(0.5, abs=0.05)
    assert share(rows(0.01, 0.3, 200)) == 0.0
    assert share(rows(0.3, 0.01, 200)) == 1.0
    # A query that takes longer is worth little, a loss to the process beside it is not.
    assert share(rows(0.102, 0.1, 20_000)) > 0


def test_an_average_of_a_gain_that_rows_do_not_tell_from_none_is_not_made():
    """On the RFID spectra .04 dB were bought with three times the time of a query."""
    rng = np.random.default_rng(1)
    target, noise = rng.uniform(0, 1, (60, 40)), 0.1 * rng.standard_normal((60, 40))
    ratio = np.where(np.arange(60) < 12, 0.8, 1.05)[:, None]  # few rows make all of the gain
    pair = (target + noise, target + ratio * noise, target)
    assert share(pair) == 0.0
    assert share(*[pair] * 30) > 0  # as if rows were so many


def test_every_row_counts_once_whichever_part_it_is_of():
    few, many = rows(0.3, 0.05, 3, 1), rows(0.05, 0.3, 300, 2)
    assert share(few, many) < 0.1 < share(few)


def test_few_rows_that_do_not_tell_two_apart_weigh_them_alike():
    """Of 16 training spectra the process was left out by chance: 20.11 dB where it has 20.40."""
    rng = np.random.default_rng(0)
    target = rng.normal(size=(16, 50))
    alike = [target + rng.normal(size=(16, 50)) for _ in range(2)]
    assert share((*alike, target)) == pytest.approx(0.5, abs=0.05)
    assert share((target + 0.01, alike[1], target)) == 0.0
    assert share((alike[0], target + 0.01, target)) == 1.0


def test_a_member_worse_than_the_plain_mean_has_no_weight():
    """Of two that err apart their mean was better than either, and both behind the mean."""
    errors = drawn([1.0, 1.3], 200)
    apart, plain = gram_of(errors), np.full(200, 1.2)
    assert weigh(apart, np.arange(200), "square").min() > 0.2
    assert weigh(apart, np.arange(200), "square", plain=plain).tolist() == [1.0, 0.0]


def test_what_answers_slowly_has_to_be_surely_better():
    """Searches for .2 % of the error took four fifths of the seconds."""
    errors = drawn([1.0, 1.0], 60)
    errors[:, 1] = errors[:, 0] * np.where(np.arange(60) % 2, 1.06, 0.93)
    for slow in (0, 1):
        weights = weigh(gram_of(errors), np.arange(60), "square", slow=np.arange(2) == slow)
        assert weights[slow] == 0


def test_weights_of_few_units_were_learned_by_chance():
    """Weights learned freely on five to twenty rows left out lost to equal ones."""
    spread, truth = np.array([1.0, 1.2]), lambda weights: float((weights * spread) ** 2 @ [1, 1])
    errors = [gram_of(drawn([*spread], 6, seed=seed)) for seed in range(40)]
    ours = [truth(weigh(products, np.arange(6), "square", sure=-9.0)) for products in errors]
    free = [truth(best_weights(products.mean(0))) for products in errors]
    assert np.mean(ours) < np.mean(free) - 0.02
    many = gram_of(drawn([*spread], 4000))
    best = best_weights(many.mean(0))
    assert weigh(many, np.arange(4000), "square") == pytest.approx(best, abs=0.01)


def test_logarithms_weigh_rows_by_ratios():
    """A few rows of large errors decided for all others: mean PSNR counts each alike."""
    weak, loud = rows(0.1, 0.2, 300), rows(20.0, 10.0, 30)
    products = np.concatenate(
        [
            error_products([*map(torch.from_numpy, both)], torch.from_numpy(target))
            for *both, target in (weak, loud)
        ]
    )
    weights = [weigh(products, np.arange(330), loss, sure=0.0)[0] for loss in ("log", "square")]
    assert weights[0] > 0.6 and weights[1] < 0.4


def gram_of(errors: np.ndarray) -> np.ndarray:
    """Products (n, K, K) of errors (n, K)."""
    return errors[:, :, None] * errors[:, None, :]


def drawn(
    deviations: list[float], rows: int = 400, common: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Errors (rows, K), a part of them common to all."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, len(deviations))) * deviations + common * rng.normal(
        size=(rows, 1)
    )


def test_no_weight_is_negative_where_plain_least_squares_has_one():
    gram = np.array([[1.0, 1.5], [1.5, 4.0]])  # unconstrained: 1.25 and -0.25
    assert best_weights(gram) == pytest.approx([1.0, 0.0], abs=1e-6)


def test_weights_are_the_best_of_a_grid():
    errors = drawn([1.0, 1.2, 0.9], common=0.3)
    gram = gram_of(errors).mean(0)
    least = float(best_weights(gram) @ gram @ best_weights(gram))
    grid = [
        np.array([a, b, 1 - a - b])
        for a in np.linspace(0, 1, 41)
        for b in np.linspace(0, 1 - a, 41)
    ]
    assert least <= min(float(w @ gram @ w) for w in grid) + 1e-9


@pytest.mark.parametrize("deviations,common", [([1.0, 5.0], 0.0), ([0.1, 0.1], 1.0)])
def test_one_alone_is_taken_where_a_mixture_does_not_pay_clearly(deviations, common):
    """The other is much worse, or both err alike."""
    errors = drawn(deviations, 60, common)
    weights = weigh(gram_of(errors), np.arange(60), "square")
    assert sorted(weights) == [0.0, 1.0]
    assert weights.argmax() == (errors**2).mean(0).argmin()


def test_small_weights_are_left_out():
    weights = weigh(gram_of(drawn([1.0, 1.0, 6.0], 4000)), np.arange(4000), "square")
    assert weights[2] == 0 and weights.sum() == pytest.approx(1)
