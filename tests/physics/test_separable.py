import torch
from refusals import refused

from gsparc.physics.separable import fit_separable


def images(count=12):
    """Of rank 3 in rows and 4 in columns."""
    generator = torch.Generator().manual_seed(0)
    rows, columns = torch.rand(10, 3, generator=generator), torch.rand(4, 20, generator=generator)
    return rows @ torch.rand(count, 3, 4, generator=generator) @ columns


def test_images_of_low_rank_come_back():
    known = images()
    basis = fit_separable(known.double().split(5), 1e-12)
    assert basis.project(known).shape == (12, 12) and basis.image_shape == (10, 20)
    torch.testing.assert_close(basis.images(basis.project(known)), known, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(basis.rows.T @ basis.rows, torch.eye(3), rtol=0, atol=1e-6)
    energy = basis.project(known).square().sum(1)
    torch.testing.assert_close(energy, known.square().sum((1, 2)), rtol=1e-5, atol=0)


def test_no_more_than_the_share_is_lost():
    known = images() + 0.1 * torch.rand(12, 10, 20, generator=torch.Generator().manual_seed(1))
    basis = fit_separable([known], 0.01)
    left = (basis.images(basis.project(known)) - known).square().sum() / known.square().sum()
    assert basis.project(known).shape[1] < 200 and 0 < left <= 0.02  # of both modes


def test_a_basis_of_nothing_is_refused():
    refused("needs images", fit_separable, [], 0.1)
