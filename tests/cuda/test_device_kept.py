"""A model that was moved keeps everything on its device, shown without a GPU by tensors on `meta`.

They hold no data and mix with a CPU's as little as a GPU's do. The rasterizer's place is taken by
one of the right shapes, differentiable in the features alone.
"""

import numpy as np
import pytest
import torch
from modules import module

from gsparc.ops import Pose, backends, validation
from gsparc.ops.results import Plan, Weights


class Shapes:
    """A rasterizer that computes nothing."""

    @staticmethod
    def make_plan(gaussians, ids, pose, grid, optics) -> Plan:
        means = gaussians.means
        size = (pose.position.shape[0], means.shape[0])
        places, visible = means.new_empty(*size, 2), means.new_empty(size, dtype=torch.bool)
        return Plan(pose, grid, optics, "meta", places, means.new_empty(size), visible, ())

    @staticmethod
    def composite(plan, gaussians, features, means2d):
        means, quats, scales, opacities = gaussians
        one = (features.sum(1) + (means + scales).sum() + quats.sum() + opacities.sum())[
            ..., None, None
        ]
        image = one.expand(*one.shape[:2], plan.grid.height, plan.grid.width)
        return image, means.new_empty(plan.num_poses, plan.grid.height, plan.grid.width)

    @staticmethod
    def mean_weights(plan, gaussians):
        return Weights(*(gaussians.opacities.expand(plan.num_poses, -1) for _ in range(2)))


def unlooked(pose: Pose, means: torch.Tensor) -> Pose:
    """`validation.check_poses`, which does not look at poses on a GPU, either."""
    return Pose(pose.position.to(means).reshape(-1, 3), pose.rotation.to(means).reshape(-1, 3, 3))


@pytest.mark.parametrize("kind", ["spectrum", "csi"])
def test_a_training_loss_and_its_gradients_stay_on_the_models_device(
    kind, campaign, tmp_path, monkeypatch
):
    monkeypatch.setattr(backends, "choose_backend", lambda name, device: Shapes)
    monkeypatch.setattr(backends, "backend_named", lambda name: Shapes)
    monkeypatch.setattr(validation, "check_poses", unlooked)
    data = campaign(kind)
    made = module(data, tmp_path).to("meta")
    batch = data.batch(np.arange(6)).to("meta")
    rendered = made.model(batch.tx, batch.rx)
    task = made.task_loss(rendered.mean, batch)
    exponent = made.model.confidence.exponent(made.model.site.moving(batch.tx, batch.rx))
    task.mean().backward()
    assert task.device.type == exponent.device.type == "meta"
    slopes = {name: p.grad for name, p in made.named_parameters() if p.grad is not None}
    assert any("emission" in name for name in slopes)
    assert all(slope.device.type == "meta" for slope in slopes.values())
