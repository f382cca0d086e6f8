"""Gaussians as a PLY file that viewers of Gaussian splats open.

Layout: the reference implementation of Kerbl et al. 2023 ("3D Gaussian Splatting for Real-Time
Radiance Field Rendering"), spherical harmonics of degree 0. Axes stay those of the site,
z upwards; units are metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError
from gsparc.base.files import write_whole
from gsparc.data.site_objects import GaussianCloud

FIELDS = (
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
)
Y00 = 0.28209479177387814  # spherical harmonic of degree 0: 1 / (2 sqrt(pi))
LEAST_M = 1e-6  # of a standard deviation, whose logarithm is stored
LEAST_SHARE = 1e-6  # of opacities, whose logits are


def write_ply(path: str | Path, cloud: GaussianCloud, colours: np.ndarray) -> None:
    """Write N Gaussians in colours (N, 3) uint8, whole or not at all.

    >>> write_ply("gaussians.ply", cloud, colours)

    Raises:
        DataError: there are none, or one is not finite.
    """
    share = np.clip(cloud.opacities, LEAST_SHARE, 1 - LEAST_SHARE)
    columns = np.column_stack(
        [
            cloud.means,
            np.zeros_like(cloud.means),
            (colours / 255 - 0.5) / Y00,
            np.log(share / (1 - share)),
            np.log(np.maximum(cloud.scales, LEAST_M)),
            cloud.quats,
        ]
    ).astype("<f4")
    if not len(columns) or not np.isfinite(columns).all():
        raise DataError("there are no Gaussians to write, or one is not finite")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(columns)}"]
    header += [*(f"property float {name}" for name in FIELDS), "end_header", ""]
    write_whole(path, "\n".join(header).encode() + columns.tobytes())
