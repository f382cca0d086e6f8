"""Joint descent on boxes, patches and amplitudes, with the varying part of the gains held.

Planes and phases move only where they are new: the varying part of the others stays where it was
and would explain what the moved constant part leaves.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from gsparc.models.image_sources.clutter.blocking import SOFT, Clutter, visible_share
from gsparc.models.image_sources.clutter.residual import ClutterLikelihood
from gsparc.models.image_sources.clutter.unfold import Legs
from gsparc.models.image_sources.refine import STEP
from gsparc.models.image_sources.scene import BETAS, SourceScene, spherical_waves
from gsparc.physics.mirror_planes import images

AMPLITUDE_SPREAD = 0.7  # standard deviation of the sources' log amplitudes about their mean
# Adam's steps: boxes and patches [m], planes (unit normal, offset [m]), phases [rad],
# log amplitudes.
STEPS = (SOFT, SOFT, 0.003, 0.03, STEP)
STEP_DECAY = 0.97  # factor of all step sizes from step to step


def refine_with_clutter(
    residual: ClutterLikelihood, scene: SourceScene, paths: Legs, steps: int
) -> SourceScene:
    """Return the most likely scene of `steps` steps; paths are those of the start."""
    assert scene.phase is not None
    rows, old = residual.rows, scene.clutter
    start = (old.boxes, old.patches, scene.planes, scene.phase, scene.log_amplitude)
    values = [v.clone().requires_grad_() for v in start]
    groups = [{"params": [v], "lr": rate} for v, rate in zip(values, STEPS, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=BETAS)
    lowest, best = float("inf"), [v.detach() for v in values]
    for step in range(steps + 1):
        boxes, patches, planes, phase, log_amplitude = values
        seen = visible_share(paths, Clutter(boxes, patches, old.plane), scene.planes)
        waves = spherical_waves(
            rows, images(rows.static_ends(scene.transmitter), planes, scene.sequences)
        )
        waves = waves * torch.polar(torch.ones(()), phase)
        deviation = (log_amplitude - log_amplitude.mean().detach()) / AMPLITUDE_SPREAD
        cost = residual.nll(seen, log_amplitude, waves) + deviation.square().sum() / 2
        if cost.item() < lowest:
            lowest, best = cost.item(), [v.detach().clone() for v in values]
        if step == steps:
            break
        optimizer.zero_grad()
        cost.backward()
        factored = residual.scene
        for value, count in ((planes, len(factored.planes)), (phase, len(factored.sequences))):
            if value.grad is not None:
                # What the varying part was factored with stays; see the module's text.
                value.grad[:count] = 0
        optimizer.step()
        for group in optimizer.param_groups:
            group["lr"] *= STEP_DECAY
    boxes, patches, planes, phase, log_amplitude = best
    clutter = Clutter(boxes, patches, old.plane)
    return replace(scene, planes=planes, phase=phase, log_amplitude=log_amplitude, clutter=clutter)
