"""What a field looks like, from the definitions alone: NumPy and SciPy in float64, none of the reference.

A Gaussian of covariance S at distance r and direction n is an angular Gaussian of covariance S / r^2.
`tangent` measures it on the plane that touches the sphere at n (gnomonic projection), in any orthonormal
basis; `equirect` in azimuth and elevation, linearised at n. Layers are blended front to back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

UNSURE = 1e-9  # a strength this close to its cut-off, relative, may fall on either side


@dataclass(frozen=True)
class Seen:
    """A picture and where it is certain.

    Attributes:
        image: (C, H, W).
        transmittance: (H, W).
        certain: (H, W) bool, no layer of the pixel stands at its cut-off.
    """

    image: np.ndarray
    transmittance: np.ndarray
    certain: np.ndarray


def look(means, quats, scales, opacities, extinctions, features, ids, pose, grid, optics) -> Seen:
    """Arrays (N, ...) of Gaussians; position (3,) and rotation (3, 3); a `SphereGrid` and an `Optics`."""
    position, rotation = pose
    local = (means - position) @ rotation
    distance = np.linalg.norm(local, axis=1)
    image = np.zeros((features.shape[1], grid.height, grid.width))
    light = np.ones((grid.height, grid.width))
    certain = np.ones((grid.height, grid.width), bool)
    cutoff = optics.cutoff
    for i in np.lexsort((ids, distance)):
        if distance[i] <= optics.near:
            continue
        turn = Rotation.from_quat(quats[i], scalar_first=True).as_matrix() if quats[i].any() else np.eye(3)
        axes = rotation.T @ turn
        covariance = axes @ np.diag((scales[i] / distance[i]) ** 2) @ axes.T
        shape, share = _footprint(local[i] / distance[i], covariance, grid, optics)
        nearness = np.clip(distance[i] / optics.near - 1, 0, 1)
        gain = nearness**2 * (3 - 2 * nearness) * (share if optics.compensate else 1.0)
        emits, hides = gain * opacities[i] * shape, gain * extinctions[i] * shape
        strength = shape if cutoff.relative else np.maximum(emits, hides)
        certain &= np.abs(strength - cutoff.alpha) > UNSURE * cutoff.alpha
        certain &= np.abs(light - cutoff.transmittance) > UNSURE * cutoff.transmittance
        counts = (strength >= cutoff.alpha) & (light >= cutoff.transmittance)
        image += np.where(counts, np.minimum(emits, 0.99) * light, 0.0) * features[i][:, None, None]
        light = np.where(counts, light * (1 - np.minimum(hides, 0.99)), light)
    return Seen(image, light, certain)


def _footprint(n, covariance, grid, optics) -> tuple[np.ndarray, float]:
    """Its shape (H, W), 1 at the centre, and the share of its peak that the low-pass leaves."""
    step = grid.elevation_step
    if optics.projection == "tangent":
        basis = null_space(n[None]) / step
        directions = grid.directions().numpy()
        cosine = directions @ n
        facing = cosine > 0.01
        offsets = (directions / np.where(facing, cosine, 1.0)[..., None]) @ basis
    else:
        azimuth, elevation = np.arctan2(n[1], n[0]), np.arcsin(np.clip(n[2], -1, 1))
        east = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        north = np.cross(n, east)
        widened = np.hypot(np.cos(elevation), step) * grid.azimuth_step
        basis = np.stack([east / widened, north / step], 1)
        turned = grid.azimuths().numpy() - azimuth
        turned = np.angle(np.exp(1j * turned)) / grid.azimuth_step
        risen = (grid.elevations().numpy() - elevation) / step
        offsets = np.stack(np.broadcast_arrays(turned[None, :], risen[:, None]), -1)
        facing = np.ones(offsets.shape[:2], bool)
    bare = basis.T @ covariance @ basis
    blurred = bare + optics.low_pass * np.eye(2)
    form = np.einsum("hwi,ij,hwj->hw", offsets, np.linalg.inv(blurred), offsets)
    share = np.sqrt(max(np.linalg.det(bare), 0.0) / np.linalg.det(blurred))
    return np.where(facing, np.exp(-0.5 * form), 0.0), share
