"""Features of a process: its posterior, from all rows or from places that stand for them."""

import numpy as np
import pytest
import torch
from sklearn.gaussian_process.kernels import Matern

from gsparc.field.encoding import EncodingSettings, PositionEncoding, Smoothness, unknown_share
from gsparc.processes.features import correlation, pivoted_rows, place_features, whitened_features

LENGTH, NOISE, NAME = 0.4, 0.01, "smooth_rough"


def rows(count: int, seed: int = 0, extent: float = 1.0) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    return extent * torch.rand(count, 3, generator=draw, dtype=torch.float64)


def posterior(known: torch.Tensor, values: torch.Tensor, asked: torch.Tensor):
    """Mean and variance, written out."""
    gram = correlation(known, known, LENGTH, NAME) + NOISE * torch.eye(
        len(known), dtype=known.dtype
    )
    cross = correlation(asked, known, LENGTH, NAME)
    weights = torch.linalg.solve(gram, cross.T).T
    return weights @ values, 1 - (weights * cross).sum(1)


def told(features, values: torch.Tensor, asked: torch.Tensor):
    seen = correlation(asked, features.places, LENGTH, NAME) @ features.whitening
    return seen @ (features.weigh @ values), unknown_share(seen)


def test_the_correlation_is_a_mixture_of_two_matern_functions():
    a, b = rows(7), rows(9, 1)
    long, short = (Matern(length, nu=nu)(a, b) for length, nu in ((LENGTH, 2.5), (LENGTH / 3, 1.5)))
    np.testing.assert_allclose(
        correlation(a, b, LENGTH, NAME), 0.85 * long + 0.15 * short, atol=1e-12
    )


def test_a_correlation_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="none of matern32, smooth_rough"):
        correlation(rows(2), rows(2), 1.0, "gauss")  # type: ignore[arg-type]


def test_features_of_all_rows_are_the_posterior():
    known, asked, values = rows(60), rows(20, 1), torch.randn(60, 3, dtype=torch.float64)
    for features in (
        whitened_features(known, LENGTH, NOISE, NAME, 60),
        place_features(known, known, LENGTH, NOISE, NAME),
    ):
        for found, wanted in zip(
            told(features, values, asked), posterior(known, values, asked), strict=True
        ):
            torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)


def test_places_stand_for_many_rows():
    """600 rows in a small room are told by fewer than 400 of them, about as surely."""
    known, asked = rows(600, extent=0.3), rows(50, 1, extent=0.3)
    values = torch.stack([(3 * known).sin().sum(1), (2 * known).cos().prod(1)], 1)
    features = whitened_features(known, LENGTH, NOISE, NAME, 400)
    assert len(features.places) < 400
    mean, unknown = told(features, values, asked)
    wanted, variance = posterior(known, values, asked)
    assert (mean - wanted).square().mean() < 1e-4 * wanted.square().mean()
    assert (unknown > 0.8 * variance).all() and (unknown - variance).max() < NOISE


def test_there_are_never_more_places_than_allowed_and_never_twins():
    known = rows(50).repeat(3, 1)
    chosen = pivoted_rows(known, LENGTH, 0.0, NAME, 40)
    assert len(set(chosen.tolist())) == 40
    # The others are the same places again
    assert len(pivoted_rows(known, LENGTH, 0.0, NAME, 150)) <= 50
    assert torch.isfinite(whitened_features(known, LENGTH, NOISE, NAME, 40).whitening).all()


def test_the_unknown_share_is_1_far_away_and_small_at_data():
    features = whitened_features(rows(60), LENGTH, NOISE, NAME, 60)
    prior = Smoothness(features.places.float(), LENGTH, NOISE, NAME, features.whitening.float())
    encode = PositionEncoding(
        EncodingSettings("kernel"), torch.tensor([[0.0] * 3, [1.0] * 3]), prior
    )
    assert encode.tells_share and encode.width == 60
    far = torch.tensor([[40.0, 0.0, 0.0], [1e4, -1e4, 3.0], [0.0, 0.0, -30.0]])
    assert (unknown_share(encode(far)) == 1).all()
    assert unknown_share(encode(rows(60).float())).max() < NOISE


@pytest.mark.parametrize("extent,wavelength", [(10.0, 0.0107), (100.0, 0.125), (100.0, 0.005)])
def test_features_far_from_the_middle_are_as_good_as_float64(extent, wavelength):
    """Positions of thousands of wavelengths: differences come before squares,
    and as positions are stored.
    """
    known = (rows(40, extent=extent) - extent / 2).float()
    known = torch.cat([known, known + 0.3 * wavelength])
    features = whitened_features(known.double(), wavelength / 2, 1e-3, NAME, 80)
    prior = Smoothness(known, wavelength / 2, 1e-3, NAME, features.whitening.float())
    encode = PositionEncoding(
        EncodingSettings("kernel"), torch.tensor([[0.0] * 3, [1.0] * 3]), prior
    )
    asked = known + 0.1 * wavelength * torch.randn(80, 3)
    wanted = correlation(asked.double(), features.places, wavelength / 2, NAME) @ features.whitening
    assert wanted.abs().max() > 0.5 and (encode(asked) - wanted).abs().max() < 1e-4
