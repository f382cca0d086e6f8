"""Image sources: fits, scenes with phases, and posterior gains without batching."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.scene import SourceScene
from gsparc.training.context import FitContext, FitReport


def gains(member: GainPosterior, places: torch.Tensor) -> torch.Tensor:
    """Posterior mean gains (m, K, R) complex64 at places (m, 3) float64 [m],
    attenuated by clutter.
    """
    both, m = torch.cat([places, member.rows.position]), len(places)
    kernel, scene = member.scene.visibility, member.scene
    seen = [
        kernel.correlation(both, source)[:m, m:].to(torch.complex64) for source in scene.sources
    ]
    each = [share @ weights for share, weights in zip(seen, member.dual_weights, strict=True)]
    turn = torch.polar(scene.visible_share(places), scene.phase.expand(1, -1))
    return torch.stack(each, 1) * turn[:, :, None]


def phased(scene: SourceScene, phase: torch.Tensor, quadrature: float = 0.2) -> SourceScene:
    """The scene with phases (K,) [rad] of its gains."""
    return replace(scene, phase=phase, quadrature=quadrature)


def fitted(
    data: Measurements, fold: Fold, folder: Path, **settings: Any
) -> tuple[ImageSourceGP, FitReport]:
    """One search over at most 100 rows in a box of 2.5 m, unless said, and its report."""
    method = ImageSourceGP(**{"searches": 1, "search_rows": 100, "margin": 2.5, **settings})
    return method, method.fit(data, fold, FitContext(folder))
