"""Scenes with phases, and posterior gains of sources without batching."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsparc.models.image_sources.gp_likelihood import Posterior
from gsparc.models.image_sources.scene import Scene


def gains(member: Posterior, places: torch.Tensor) -> torch.Tensor:
    """Posterior mean gains (m, K, R) complex64 at places (m, 3) float64 [m], attenuated by clutter."""
    both, m = torch.cat([places, member.rows.position]), len(places)
    kernel, scene = member.scene.visibility, member.scene
    seen = [kernel.correlation(both, source)[:m, m:].to(torch.complex64) for source in scene.sources]
    each = [share @ weights for share, weights in zip(seen, member.dual_weights, strict=True)]
    turn = torch.polar(scene.visible_share(places), scene.phase.expand(1, -1))
    return torch.stack(each, 1) * turn[:, :, None]


def phased(scene: Scene, phase: torch.Tensor, quadrature: float = 0.2) -> Scene:
    """The scene with phases (K,) [rad] of its gains."""
    return replace(scene, phase=phase, quadrature=quadrature)
