import dataclasses

import pytest
import torch

from gsparc.field.emission import Emission, EmissionSettings
from gsparc.field.encoding import EncodingSettings, PositionEncoding

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
ENCODING = EncodingSettings("fourier", octaves=2)


def emission(hidden: int = 4, count: int = 5, channels: int = 2, **more) -> Emission:
    torch.manual_seed(0)
    settings = EmissionSettings(
        encoding=ENCODING, hidden=hidden, **{"activation": "sigmoid", "init_bias": 0.0, **more}
    )
    return Emission(settings, count, channels, PositionEncoding(ENCODING, BOX))


@pytest.mark.parametrize("hidden", [0, 4])
def test_every_gaussian_has_a_network_of_its_own(hidden):
    """Against N separate small networks, one after the other."""
    many = emission(hidden)
    where = torch.rand(3, 3)
    encoded = many.encoding(where)
    for i in range(5):
        inner = encoded
        if hidden:
            inner = torch.relu(encoded @ many.weight1[i] + many.bias1[i])
        want = inner @ many.weight2[i] + many.bias2[i]
        assert torch.allclose(many.logits(where)[:, i], want, atol=1e-6)


@pytest.mark.parametrize("activation", ["softplus", "linear"])
def test_the_logarithm_of_distance_lives_under_a_sigmoid_only(activation):
    with pytest.raises(ValueError, match="log_distance=true needs activation=sigmoid"):
        emission(activation=activation, log_distance=True)


@pytest.mark.parametrize(
    ("activation", "log_distance"),
    [("linear", False), ("softplus", False), ("sigmoid", False), ("sigmoid", True)],
)
def test_inverse_undoes_the_activation(activation, log_distance):
    many = emission(activation=activation, log_distance=log_distance)
    distance = torch.rand(7, 5) + 0.1
    wanted = torch.rand(7, 5, 2) * 0.9 + 0.05
    logits = many.to_logits(wanted, distance)
    frozen = dataclasses.replace(many.settings, hidden=0)
    direct = Emission(frozen, 5, 2, many.encoding)
    direct.logits = lambda position: logits  # type: ignore[method-assign]
    assert torch.allclose(direct(torch.zeros(7, 3), distance), wanted, atol=1e-5)


@pytest.mark.parametrize("activation", ["softplus", "sigmoid"])
def test_inverse_of_impossible_powers_is_finite(activation):
    many = emission(activation=activation)
    assert torch.isfinite(
        many.to_logits(torch.tensor([[[-3.0], [0.0], [1.0], [40.0], [1e-9]]]), torch.ones(1, 5))
    ).all()
