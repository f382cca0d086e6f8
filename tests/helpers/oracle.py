"""What a field looks like, from the definitions alone: NumPy and SciPy in float64,
none of the reference.

A Gaussian of covariance S at distance r and direction n is an angular Gaussian of covariance S /
r^2. `tangent` measures it on the plane that touches the sphere at n (gnomonic projection), in any
orthonormal basis; `equirect` in azimuth and elevation, linearised at n.
Layers are blended front to back.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

UNSURE = 1e-9  # a strength this close to its cut-off, relative, may fall on either side


@dataclass(frozen=True)
class Seen:
    """What a receiver sees of N Gaussians, and where that is certain.

    Attributes:
        image: (B, C, H, W).
        transmittance: (H, W).
        certain: (H, W) bool, no layer of the pixel stands at a cut-off.
        reached: (N,) bool, whether a pixel is certainly above the cut-off of strength.
        radii: (N,) [px], long half axes at the cut-off of strength.
    """

    image: np.ndarray
    transmittance: np.ndarray
    certain: np.ndarray
    reached: np.ndarray
    radii: np.ndarray


@dataclass(frozen=True)
class Footprint:
    """One Gaussian on the grid.

    Attributes:
        shape: (H, W), 1 at its centre.
        certain: (H, W) bool, the pixel is neither at the horizon nor half a turn away.
        share: of its peak, what the low-pass leaves.
        variance: the largest [px^2].
    """

    shape: np.ndarray
    certain: np.ndarray
    share: float
    variance: float


def look(means, quats, scales, opacities, features, ids, pose, grid, optics, unsure=UNSURE) -> Seen:
    """Arrays (N, ...) of Gaussians, features (B, N, C); position (3,) and rotation (3, 3)."""
    position, rotation = pose
    local = (means - position) @ rotation
    distance = np.linalg.norm(local, axis=1)
    image = np.zeros((len(features), features.shape[2], grid.height, grid.width))
    light = np.ones((grid.height, grid.width))
    certain = np.ones((grid.height, grid.width), bool)
    reached, radii = np.zeros(len(means), bool), np.zeros(len(means))
    cutoff = optics.cutoff
    for i in np.lexsort((ids, distance)):
        if distance[i] <= optics.near:
            continue
        turn = np.eye(3)
        if np.abs(quats[i]).max() > 1e-18:
            turn = Rotation.from_quat(quats[i], scalar_first=True).as_matrix()
        axes = rotation.T @ turn * (scales[i] / distance[i])
        mark = _footprint(local[i] / distance[i], axes, grid, optics, unsure)
        if mark is None:
            continue
        nearness = np.clip(distance[i] / optics.near - 1, 0, 1)
        gain = nearness**2 * (3 - 2 * nearness) * (mark.share if optics.compensate else 1.0)
        emits = gain * opacities[i] * mark.shape
        strength = mark.shape if cutoff.relative else emits
        counts = strength >= cutoff.alpha
        certain &= mark.certain & (np.abs(strength - cutoff.alpha) > unsure * cutoff.alpha)
        certain &= ~counts | (np.abs(light - cutoff.transmittance) > unsure * cutoff.transmittance)
        peak = gain * opacities[i]
        reached[i] = peak > 0 and (mark.certain & (strength > (1 + unsure) * cutoff.alpha)).any()
        beyond = (1.0 if cutoff.relative else peak) / cutoff.alpha
        radii[i] = np.sqrt(2 * np.log(max(beyond, 1.0)) * mark.variance)
        counts &= light >= cutoff.transmittance
        weight = np.where(counts, np.minimum(emits, 0.99) * light, 0.0)
        image += weight * features[:, i, :, None, None]
        light = np.where(counts, light * (1 - np.minimum(emits, 0.99)), light)
    return Seen(image, light, certain, reached, radii)


def _footprint(n, axes, grid, optics, unsure) -> Footprint | None:
    """Of an angular Gaussian at n with its axes in columns (3, 3) [rad];
    None of one without area.
    """
    step = grid.elevation_step
    if optics.projection == "tangent":
        basis = null_space(n[None]) / step
        directions = grid.directions().numpy()
        cosine = directions @ n
        facing = cosine > 0.01
        certain = np.abs(cosine - 0.01) > unsure
        offsets = (directions / np.where(facing, cosine, 1.0)[..., None]) @ basis
    else:
        level = np.hypot(n[0], n[1])
        azimuth, elevation = (np.arctan2(n[1], n[0]) if level > 0 else 0.0), np.arctan2(n[2], level)
        east = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        north = np.cross(n, east)
        widened = np.hypot(level, step) * grid.azimuth_step
        basis = np.stack([east / widened, north / step], 1)
        closes = abs(grid.width * grid.azimuth_step - 2 * np.pi) < 1e-6
        turn = grid.width if closes else 2 * np.pi / grid.azimuth_step  # columns in a full circle
        turned = (grid.azimuths().numpy() - azimuth) / grid.azimuth_step
        turned = turned - turn * np.round(turned / turn)
        risen = (grid.elevations().numpy() - elevation) / step
        offsets = np.stack(np.broadcast_arrays(turned[None, :], risen[:, None]), -1)
        facing = np.ones(offsets.shape[:2], bool)
        certain = np.broadcast_to(turn / 2 - np.abs(turned) > unsure * turn, facing.shape)
    bare = basis.T @ axes
    # Of the covariance A A^T the factor R^T R by Householder reflections of A^T:
    # never the product itself.
    root = np.linalg.qr(np.hstack([bare, np.sqrt(optics.low_pass) * np.eye(2)]).T, mode="r")
    area, blurred = (
        abs(np.prod(np.diag(np.linalg.qr(bare.T, mode="r")))),
        abs(np.prod(np.diag(root))),
    )
    if blurred**2 <= np.finfo(float).tiny:
        return None
    p, q = offsets[..., 0] / root[0, 0], offsets[..., 1]
    form = p**2 + ((q - root[0, 1] * p) / root[1, 1]) ** 2
    variance = np.linalg.norm(root, 2) ** 2
    return Footprint(np.where(facing, np.exp(-0.5 * form), 0.0), certain, area / blurred, variance)
