"""Factors against torch's own functions: single and batched, real and complex,
with and without gradients.
"""

import pytest
import torch

from gsparc.processes.factor import Factor, NotDefiniteError
from gsparc.processes.left_out import left_out_residuals, left_out_signal, rows_of_groups

KINDS = {torch.float32: 1e-4, torch.float64: 1e-12, torch.complex64: 1e-4, torch.complex128: 1e-12}


def covariance(kind: torch.dtype, count: int = 30, batch: tuple[int, ...] = ()) -> torch.Tensor:
    torch.manual_seed(0)
    root = torch.randn(*batch, count, 2 * count, dtype=kind)
    return root @ root.mH / count + 0.3 * torch.eye(count, dtype=kind)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("kind", KINDS)
def test_everything_solved_is_what_torch_solves(kind, batch):
    given, close = covariance(kind, batch=batch), {"rtol": KINDS[kind], "atol": 10 * KINDS[kind]}
    values, inverse = torch.randn(*batch, 30, 4, dtype=kind), torch.linalg.inv(given)
    factor, lower = Factor.from_gram(given), torch.linalg.cholesky(given)
    torch.testing.assert_close(factor.lower, lower, **close)
    torch.testing.assert_close(factor.solve(values), inverse @ values, **close)
    torch.testing.assert_close(factor.whiten(values), torch.linalg.inv(lower) @ values, **close)
    torch.testing.assert_close(factor.root, torch.linalg.inv(lower), **close)
    torch.testing.assert_close(factor.precision, inverse.diagonal(dim1=-2, dim2=-1).real, **close)
    torch.testing.assert_close(factor.inverse, inverse, **close)
    determinant = torch.linalg.slogdet(given).logabsdet.double()
    torch.testing.assert_close(factor.log_determinant, determinant, rtol=1e-4, atol=1e-4)


def test_complex_values_through_a_real_factor_lost_their_imaginary_parts():
    given = covariance(torch.float64)
    values = torch.randn(30, 2, dtype=torch.complex128)
    expected = torch.linalg.inv(given).to(values.dtype) @ values
    torch.testing.assert_close(Factor.from_gram(given).solve(values), expected)
    torch.testing.assert_close(Factor.from_gram(given).solve(values.conj()), expected.conj())


def test_gradients_go_through():
    given = covariance(torch.float64, 5).requires_grad_()
    one = torch.ones(5, 1, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda k: Factor.from_gram((k + k.T) / 2).solve(one), given)


def test_rounding_is_mended_with_a_ridge_and_what_is_more_is_refused():
    places = torch.linspace(0, 1e-3, 200)[:, None]
    alike = torch.exp(-torch.cdist(places, places).square())  # float32: eigenvalues of either sign
    assert torch.linalg.cholesky_ex(alike).info
    lower = Factor.from_gram(alike).lower
    assert float((lower @ lower.T - alike).abs().max()) < 1e-3
    with pytest.raises(NotDefiniteError):
        Factor.from_gram(alike, "raise")
    with pytest.raises(NotDefiniteError, match="gsparc check"):
        Factor.from_gram(-torch.eye(3))
    assert torch.equal(Factor.from_gram(torch.stack([alike, torch.eye(200)])).lower[0], lower)
    with pytest.raises(NotDefiniteError):
        Factor.from_gram(torch.eye(3).expand(2, 3, 3) * torch.tensor([1.0, -1.0])[:, None, None])


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("kind", [torch.float64, torch.complex128])
def test_rows_left_out_are_predictions_of_the_rest(kind, grouped):
    signal, noise = covariance(kind, 20), covariance(kind, 20) * 0.2
    given, values = signal + noise, torch.randn(20, 3, dtype=kind)
    inverse = Factor.from_gram(given).inverse
    number = torch.arange(20) // (4 if grouped else 1)
    groups = rows_of_groups(number.numpy()) if grouped else None
    residual, variance = left_out_residuals(inverse, inverse @ values, groups)
    missed, spread = left_out_signal(inverse, inverse @ values, noise, groups)
    for one in number.unique():
        own, rest = number == one, number != one
        solved = torch.linalg.solve(
            given[rest][:, rest], torch.cat([values[rest], given[rest][:, own]], 1)
        )
        weights, known = solved[:, :3], given[own][:, rest] @ solved[:, 3:]
        torch.testing.assert_close(residual[own], values[own] - given[own][:, rest] @ weights)
        torch.testing.assert_close(variance[own], (given[own][:, own] - known).diagonal().real)
        torch.testing.assert_close(missed[own], values[own] - signal[own][:, rest] @ weights)
    assert (spread is None) == grouped


def test_a_factor_of_nothing_says_nothing(capfd):
    """LAPACK printed a complaint for each of hundreds of empty factors."""
    none = torch.zeros(0, 0, dtype=torch.float64)
    factor = Factor.from_gram(none)
    assert factor.whiten(torch.zeros(0, 3).double()).shape == (0, 3)
    assert factor.solve(torch.zeros(0, 3).double()).shape == (0, 3)
    assert "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize("rows", [20, 200])
@pytest.mark.parametrize("columns", [1, 3])
def test_values_of_another_precision_are_taken_as_the_factors(rows, columns):
    """Few rows go to torch, which refuses what LAPACK converted;
    L may take the covariance's place.
    """
    gram = covariance(torch.float64, rows)
    assert torch.equal(
        Factor.from_gram(gram.clone(), overwrite=True).lower, Factor.from_gram(gram).lower
    )
    values = torch.randn(rows, columns)
    found = Factor.from_gram(gram).solve(values)
    torch.testing.assert_close(gram @ found, values.double())
