"""Image sources as a field: its objects."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from campaigns import channels

from gsparc.data.load import load
from gsparc.field.initial import InitSettings
from gsparc.models.fields import sources
from gsparc.models.image_sources.source_field import SourceField
from gsparc.physics.mirror_planes import reflect
from gsparc.training.context import FitContext

ROWS = np.arange(60)
INIT = InitSettings(searches=1, search_rows=60, max_sources=6)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    data = load({"name": "own", "file": str(channels(folder / "own.npz", shape="SK"))})
    found, _ = sources(data, ROWS, INIT, False, FitContext(folder, budget_s=2.0))
    assert isinstance(found, SourceField) and found.count > 1
    return found


def test_objects_mirror_the_transmitter_into_its_images(field):
    method = field.method
    scene = method.members[int(torch.as_tensor(method.weights).argmax())].scene
    planes = torch.from_numpy(field.objects().planes)
    assert torch.linalg.vector_norm(planes[:, :3], dim=1).allclose(
        torch.ones(len(planes), dtype=planes.dtype)
    )
    end = scene.transmitter + method.frame.middle
    for sequence, place in zip(scene.sequences, scene.sources, strict=True):
        if len(sequence) == 1:
            assert torch.allclose(reflect(end, planes[sequence[0]]), place + method.frame.middle, atol=1e-6)
