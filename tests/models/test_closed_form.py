"""Dataclasses within dataclasses come back from plain containers as they were."""

import pytest
import torch

from gsparc.models.closed_form import from_containers, to_containers
from gsparc.models.image_sources.clutter.blocking import Clutter
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene


def test_a_scene_comes_back_with_its_parts():
    clutter = Clutter(torch.ones(1, 6), torch.ones(1, 4), (0,))
    planes, kernel = torch.eye(4, dtype=torch.float64)[:2], KernelVisibility(0.9, 0.6, 1.5)
    scene = SourceScene(torch.zeros(3), planes, ((), (0, 1)), torch.zeros(2), -4.0, kernel, clutter)
    assert len(scene.sources) == 2  # what is computed from the parts is not stored
    stored = to_containers(scene)
    assert stored["sequences"] == [[], [0, 1]] and stored["clutter"]["plane"] == [0]
    again = from_containers(SourceScene, stored)
    assert (
        again.sequences == scene.sequences
        and again.visibility == kernel
        and again.clutter.plane == (0,)
    )
    assert torch.equal(again.planes, planes) and again.phase is None


def test_a_part_that_is_missing_or_unknown_is_an_error():
    stored = to_containers(KernelVisibility()) | {"width": 1.0}
    with pytest.raises(TypeError, match="width"):
        from_containers(KernelVisibility, stored)
