"""The row that times learning: one optimiser step on spectra of a static receiver."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.commands.bench.case import Call, Case, Work
from gsparc.commands.bench.scene import GRID, places, receiver, scene
from gsparc.field.model import GaussianModel
from gsparc.ops import Pose
from gsparc.ops.projection import Projection
from gsparc.training.losses import spectrum_loss
from gsparc.training.optimizer import OptimizerSettings, optimizer_for

COUNT, BATCH = 100, 16  # as many Gaussians as the dense tensors of plain PyTorch leave memory for


def step(projection: Projection, count: int = COUNT, batch: int = BATCH) -> Case:
    """Emission, plan, blending, L1 and SSIM, their gradients and Adam; the reference does it in PyTorch."""
    model = scene(count, projection).model
    parameters = 4 * sum(parameter.numel() for parameter in model.parameters())
    return Case(
        *("training step", projection, count, batch),
        work=Work(7 * parameters + 8 * batch * GRID.height * GRID.width),  # Adam: four read, three written
        kernel=_learning(model, batch),
        reference=_learning(scene(count, projection, backend="reference").model, batch),
    )


def _learning(model: GaussianModel, batch: int) -> Call:
    optimizer = optimizer_for(model, OptimizerSettings())
    draw = torch.Generator().manual_seed(0)
    target = torch.rand((batch, GRID.height, GRID.width), generator=draw)
    tx, rx = places(batch) + 1, Pose.identity(places(batch))

    def call() -> Tensor:
        with torch.enable_grad():
            optimizer.zero_grad(set_to_none=True)
            values = model.features(tx, rx)[..., :1]
            image = model.raster(values, receiver()).image
            loss = spectrum_loss(image.squeeze(1), target).mean()
            loss.backward()
            optimizer.step()
        return loss.detach()

    return call
