"""Image sources: the objects that they are mirrored in."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from campaigns import channels
from closed import fitted_to

from gsparc.data.load import load
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.physics.mirror_planes import reflect

ROWS = np.arange(60)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    data = load({"name": "own", "file": str(channels(folder / "own.npz", shape="SK"))})
    method = ImageSourceGP(searches=1, search_rows=60, max_sources=6, clutter=False)
    found, _ = fitted_to(method, data, ROWS, budget_s=2.0)
    assert found.count > 1
    return found


def test_objects_mirror_the_transmitter_into_its_images(field):
    method = field
    scene = method.members[int(torch.as_tensor(method.weights).argmax())].scene
    planes = torch.from_numpy(field.objects().planes)
    assert torch.linalg.vector_norm(planes[:, :3], dim=1).allclose(
        torch.ones(len(planes), dtype=planes.dtype)
    )
    end = scene.transmitter + method.frame.middle
    for sequence, place in zip(scene.sequences, scene.sources, strict=True):
        if len(sequence) == 1:
            assert torch.allclose(reflect(end, planes[sequence[0]]), place + method.frame.middle, atol=1e-6)
