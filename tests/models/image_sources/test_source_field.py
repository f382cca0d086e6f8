"""Image sources as a field: slopes by mirror planes and by powers."""

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
    return found, data


@pytest.mark.parametrize("name,step", [("planes", 1e-3), ("log_amplitudes", 1e-2)])
def test_slopes_are_those_of_finite_differences(field, name, step):
    field, data = field
    batch, (parameter,) = data.batch(ROWS[:40]), list(getattr(field, name))
    field.zero_grad()
    field.loss(batch).mean().backward()
    slope = parameter.grad.reshape(-1).numpy().copy()
    flat = parameter.data.reshape(-1)
    numeric = np.zeros_like(slope)
    for number, value in enumerate(flat.tolist()):
        ends = []
        for moved in (value - step, value + step):
            with torch.no_grad():
                flat[number] = moved
                ends.append(float(field.loss(batch).double().mean()))
        with torch.no_grad():
            flat[number] = value
        numeric[number] = (ends[1] - ends[0]) / (2 * step)
    # how alike sources are seen from two places is held fixed in the slope
    assert np.linalg.norm(slope - numeric) < 0.1 * np.linalg.norm(numeric), (slope, numeric)


def test_objects_mirror_the_transmitter_into_its_images(field):
    field, _ = field
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
