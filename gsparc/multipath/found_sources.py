"""What a search found, as plain arrays: where another model of the same channels may start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsparc.multipath.image_source_gp import ImageSourceGP
from gsparc.multipath.rows import static_array
from gsparc.physics.mirror_planes import orientations


@dataclass(frozen=True)
class FoundSources:
    """N sources of one or more searches; a channel is their sum `g exp(-j 2 pi f r / c) / r carrier / f`.

    The range r of antenna a of the static end (from its position, site axes) is that to `positions +
    rotations a`, and its channel that sum over `factors`; searches are averaged, not summed.

    Attributes:
        positions: (N, 3) float64 [m], local.
        rotations: (N, 3, 3) float64, orthogonal, determinant -1 after an odd number of reflections; None
            where antennas of the static end do not matter.
        member: (N,) int64, the search that found each; the best is 0.
        weights: (M,) float32 of sum 1, of the searches in the average.
        factors: (A,) complex64, what channels of each antenna were multiplied by.
        strengths: (N,) float32, prior standard deviation of a gain [stored unit m].
        gains: (N, R) complex64, posterior mean of the gain's constant part [stored unit m].
    """

    positions: np.ndarray
    rotations: np.ndarray | None
    member: np.ndarray
    weights: np.ndarray
    factors: np.ndarray
    strengths: np.ndarray
    gains: np.ndarray


def found_sources(method: ImageSourceGP) -> FoundSources:
    """The sources of all searches of a fitted or restored method, in their order.

    Raises:
        ValueError: it is not fitted yet.
    """
    if method.site is None or not method.members:
        raise ValueError(f"{method.name}: not fitted yet; call fit or restore first")
    scenes, scale = [member.scene for member in method.members], method.frame.scale
    turned = torch.cat([orientations(scene.planes, scene.words) for scene in scenes]).numpy()
    counts = [len(scene.words) for scene in scenes]
    return FoundSources(
        positions=torch.cat([scene.sources + method.frame.middle for scene in scenes]).numpy(),
        rotations=None if static_array(method.site, method.antennas) is None else turned,
        member=np.repeat(np.arange(len(scenes)), counts),
        weights=method.weights.numpy(),
        factors=method.factors.numpy(),
        strengths=scale * torch.cat([scene.log_amplitude.exp() for scene in scenes]).numpy(),
        gains=scale * torch.cat([member.mean_gains for member in method.members]).numpy(),
    )
