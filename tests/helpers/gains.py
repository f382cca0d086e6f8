"""Posterior gains of sources without batching."""

from __future__ import annotations

import torch

from gsparc.models.image_sources.phased_gp import PhasedPosterior


def gains(member: PhasedPosterior, places: torch.Tensor) -> torch.Tensor:
    """Posterior mean gains (m, K, R) complex64 at places (m, 3) float64 [m], attenuated by clutter."""
    both, m = torch.cat([places, member.rows.position]), len(places)
    kernel, scene = member.scene.visibility, member.scene
    seen = [kernel.correlation(both, source)[:m, m:].to(torch.complex64) for source in scene.sources]
    each = [share @ weights for share, weights in zip(seen, member.dual_weights, strict=True)]
    turn = torch.polar(scene.visible_share(places), member.phased.phase.expand(1, -1))
    return torch.stack(each, 1) * turn[:, :, None]
