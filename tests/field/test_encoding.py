import math

import pytest
import torch

from gsparc.field.encoding import EncodingSettings, PositionEncoding, Smoothness

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 2.0, 1.0]])


def positions(count: int, seed: int = 0) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    return BOX[0] + (BOX[1] - BOX[0]) * torch.rand(count, 3, generator=draw)


def prior(count: int = 20, length: float = 0.7) -> Smoothness:
    return Smoothness(positions(count, 1), length, 0.01)


def test_raw_has_one_scale_for_all_axes():
    encode = PositionEncoding(EncodingSettings("raw"), BOX)
    assert encode.width == 3
    got = encode(torch.tensor([[0.0, 2.0, 0.5], [1.0, 0.0, 0.5]]))
    assert torch.equal(got, torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.0, 0.0]]))


def test_fourier_is_sines_and_cosines_of_octaves():
    encode = PositionEncoding(EncodingSettings("fourier", octaves=3), BOX)
    where = positions(7)
    got, scaled = encode(where), PositionEncoding(EncodingSettings("raw"), BOX)(where)
    assert encode.width == 3 + 2 * 9 == got.shape[1]
    angles = torch.cat([scaled * math.pi * 2**k for k in range(3)], 1)
    assert torch.allclose(got, torch.cat([scaled, angles.cos(), angles.sin()], 1), atol=1e-5)


def test_kernel_features_are_white_on_their_anchors():
    encode = PositionEncoding(EncodingSettings("kernel"), BOX, prior())
    anchors = prior().anchors
    gram = encode(anchors) @ encode(anchors).T
    apart = torch.cdist(anchors, anchors) * math.sqrt(3) / 0.7
    assert encode.width == 20
    assert torch.allclose(gram, (1 + apart) * torch.exp(-apart), atol=1e-3)


def test_repeated_anchors_stay_invertible():
    twice = positions(10, 1).repeat(2, 1)
    encode = PositionEncoding(EncodingSettings("kernel"), BOX, Smoothness(twice, 0.7, 0.01))
    assert torch.isfinite(encode(positions(5))).all()


def test_kernel_without_a_prior_says_so():
    with pytest.raises(ValueError, match="needs a prior"):
        PositionEncoding(EncodingSettings("kernel"), BOX)


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="choose raw, fourier or kernel"):
        PositionEncoding(EncodingSettings("fuorier"), BOX)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 1e4])
@pytest.mark.parametrize("kind", ["raw", "fourier", "kernel"])
def test_any_box_gives_finite_features_of_order_one(kind, size):
    """Also the box of a single position, whose extent is 0."""
    encode = PositionEncoding(EncodingSettings(kind), BOX.double() * size, prior())
    for count in (0, 1, 30):
        got = encode(positions(count) * size)
        assert got.shape == (count, encode.width) and (got.abs() <= 2).all()
