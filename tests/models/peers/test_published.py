"""What docs/results/compare/settings.csv says of the peers' settings,
and what `paper=nerf2` builds.
"""

import pytest
import torch
from published_table import FILE, settings, table
from scenes import lobes

from gsparc.models.peers.nerf2 import REFERENCE, MarchedField, NeRF2
from gsparc.models.peers.trained import _make_scene


def test_the_table_says_which_settings_are_the_papers():
    """Rewrite it with `python tests/helpers/published_table.py`."""
    assert FILE.read_text(encoding="utf-8") == table()


@pytest.fixture
def published(tmp_path):
    data, fold = lobes(tmp_path)
    return MarchedField(
        _make_scene(data, fold.train), NeRF2(**settings("paper", "nerf2"))
    ), data.batch(fold.test)


def test_published_nerf2_was_two_networks_of_eight_layers(published):
    """The paper has one, with a skip, and one of two layers;
    directions have ten octaves as well.
    """
    shapes = {
        name: tuple(part.shape) for name, part in published[0].named_parameters() if part.dim() == 2
    }
    octaves, trunk = (
        3 + 2 * 3 * 10,
        [s for name, s in shapes.items() if name.startswith(("early", "late"))],
    )
    assert trunk == [
        (256, octaves),
        *[(256, 256)] * 4,
        (256, octaves + 256),
        *[(256, 256)] * 2,
        (258, 256),
    ]
    assert shapes["by_feature.weight"] == (256, 256) and shapes["by_ray.weight"] == (
        256,
        2 * octaves,
    )
    assert [s for name, s in shapes.items() if name.startswith("signal")] == [(128, 256), (2, 128)]


def test_nerf2_multiplied_signals_by_an_opacity(published):
    """Where nothing attenuates, nothing was sent either;
    the paper's signals fall with the distance alone.
    """
    net, batch = published
    with torch.no_grad():
        for layer, bias in (
            (net.late[-1], torch.tensor([0.0, -99.0])),
            (net.signal[-1], torch.tensor([2.0, 0])),
        ):
            layer.weight.zero_()
            layer.bias[:2] = bias
        origin, heading = batch.rx.position.reshape(-1, 3)[:1], torch.tensor([[0.0, 0, 1]])
        seen = net.march(origin, heading, batch.tx[:1])
    far = (torch.arange(64) + 1) * 5.0 / 64
    torch.testing.assert_close(seen[0], (2 * REFERENCE / far).sum(), rtol=1e-4, atol=0)
