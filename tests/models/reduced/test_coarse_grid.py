"""A coarser grid, filled in: exact where the image is linear, wrapping where the grid does."""

import pytest
import torch

from gsparc.models.reduced import Interpolated, coarsen_grid
from gsparc.ops import SphereGrid


@pytest.mark.parametrize("stride", [2, 3, 5])
def test_rendered_pixels_stay_where_they_were(stride):
    grid = SphereGrid.hemisphere(90, 360)
    coarse = coarsen_grid(grid, stride)
    assert torch.allclose(coarse.directions(), grid.directions()[::stride, ::stride], atol=1e-12)


@pytest.mark.parametrize("stride", [2, 3, 5])
def test_linear_images_are_filled_exactly_and_azimuth_wraps(stride, steady):
    grid = SphereGrid.hemisphere(90, 360)
    rows = torch.arange(90.0)[:, None].expand(90, 360)
    filled = Interpolated(steady, grid, stride).upsample(rows[None, ::stride, ::stride])
    last = (89 // stride) * stride  # rows beyond the last rendered one repeat it
    assert torch.allclose(filled[0], rows.clamp_max(last), atol=1e-4)
    seam = torch.zeros(1, 90, 360)
    seam[..., 0] = 1.0
    filled = Interpolated(steady, grid, stride).upsample(seam[:, ::stride, ::stride])
    assert torch.allclose(filled[0, :, -1], torch.full((90,), 1 - 1 / stride))
    assert torch.all(filled[..., 0] == 1)


def test_a_grid_that_does_not_close_ends(steady):
    grid = SphereGrid(4, 8, 0.0, 0.0, 0.1, 0.1)
    image = torch.zeros(1, 2, 4)
    image[..., 0] = 1.0
    assert torch.all(Interpolated(steady, grid, 2).upsample(image)[..., -1] == 0)


def test_columns_that_cannot_be_divided_are_refused():
    with pytest.raises(ValueError, match="stride=7 does not divide the 360 columns"):
        coarsen_grid(SphereGrid.hemisphere(90, 360), 7)


@pytest.fixture
def steady():
    from gsparc.models.baselines.mean import Mean

    return Mean()
