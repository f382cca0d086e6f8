"""Every threshold of the rasterizer, defined once and handed to each backend as an argument."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from gsparc.ops.geometry import SphereGrid
from gsparc.ops.projection import HORIZON_COSINE, PROJECTIONS, Projection

FARTHEST = 1e6
"""Largest coordinate of a Gaussian [m]; ops see local coordinates, float32 no squares of 1e19."""

SKEW = 2e-3
"""How far the products of the columns of a pose's rotation may be from those of a rotation."""

# Seen from .01 m, 1e5 m span 6e8 px of a degree: their determinant, 1e35 px^4,
# is below float32's 3.4e38.
WIDEST = 1e5
"""Largest standard deviation of a Gaussian [m];
at the near cut its determinant in px still is a float32.
"""

SHORTEST_QUATERNION = 1e-18
"""A quaternion whose longest component is not longer than this does not turn,
in either precision.
"""

# .99 as in Kerbl et al. 2023: behind a layer of alpha = 1 the gradient would be divided by 0.
ALPHA_MAX = 0.99
"""Largest opacity of one layer at one pixel;
a clamped layer passes no gradient to geometry or opacity.
"""

FAINTEST = 1e-30
"""A Gaussian whose alphas add up to less has a visible share without a gradient:
1 / sum is no float32.
"""


@dataclass(frozen=True)
class Cutoff:
    """When a Gaussian stops counting at a pixel.

    >>> Cutoff(alpha=2.0)
    Traceback (most recent call last):
        ...
    ValueError: cut-offs lie in (0, 1), got alpha 2.0, transmittance 0.0001

    Attributes:
        alpha: it counts where its layer opacity is at least this; 1/255 is right for images.
        transmittance: it counts where the light that reaches it is at least this.
        relative: compare `alpha` with the footprint itself, whose peak is 1, instead of with the
            opacity times the footprint. Right for CSI, where an absolute threshold would cut 39 %
            off a footprint of opacity 0.01.
    """

    # A grey level of 8 bits, and a transmittance of 1e-4: the thresholds of Kerbl et al. 2023.
    alpha: float = 1.0 / 255.0
    transmittance: float = 1e-4
    relative: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.alpha < 1.0 or not 0.0 <= self.transmittance < 1.0:
            raise ValueError(
                f"cut-offs lie in (0, 1), got alpha {self.alpha}, transmittance "
                f"{self.transmittance}"
            )


IMAGE_CUTOFF = Cutoff()
"""The paper's thresholds, for images."""


@dataclass(frozen=True)
class Optics:
    """How Gaussians become footprints.

    Attributes:
        projection: `tangent` evaluates the footprint on the plane touching the sphere at the
            Gaussian's own direction (no pole); `equirect` linearises azimuth and elevation there
            (the paper; inexact near the pole, where it replaces cos(elevation) by sqrt(cos^2 +
            step^2)).
        low_pass: variance added to every footprint [px^2]; a pixel of `tangent` is one elevation
            step.
        compensate: scale the opacity by sqrt(det before / det after the low-pass), which keeps the
            energy.
        near: Gaussians nearer than this are absent; they fade in up to twice this distance [m].
        cutoff: when a Gaussian stops counting.
    """

    projection: Projection = "tangent"
    low_pass: float = 0.3
    compensate: bool = True
    near: float = 0.01
    cutoff: Cutoff = IMAGE_CUTOFF

    def __post_init__(self) -> None:
        if self.projection not in PROJECTIONS:
            raise ValueError(
                f"projection is {' or '.join(map(repr, PROJECTIONS))}, got {self.projection!r}"
            )
        if not self.low_pass >= 0.0 or not self.near > 0.0:
            raise ValueError(
                f"low_pass >= 0 and near > 0 are needed, got {self.low_pass} and {self.near}"
            )


class KernelSettings(NamedTuple):
    """Grid, optics and thresholds as the kernels take them;
    the struct of that name in csrc/layout.h.
    """

    height: int
    width: int
    projection: int
    periodic: bool
    compensate: bool
    relative: bool
    first_elevation: float
    first_azimuth: float
    elevation_step: float
    azimuth_step: float
    low_pass: float
    near: float
    alpha_min: float
    transmittance_min: float
    alpha_max: float
    horizon_cosine: float


# Cached: grids and optics are few and immutable, and a plan is made at every step.
@lru_cache(maxsize=64)
def kernel_settings(grid: SphereGrid, optics: Optics) -> KernelSettings:
    """Return what a grid and optics are to the kernels."""
    return KernelSettings(
        height=grid.height,
        width=grid.width,
        projection=list(PROJECTIONS).index(optics.projection),
        periodic=grid.periodic,
        compensate=optics.compensate,
        relative=optics.cutoff.relative,
        first_elevation=grid.first_elevation,
        first_azimuth=grid.first_azimuth,
        elevation_step=grid.elevation_step,
        azimuth_step=grid.azimuth_step,
        low_pass=optics.low_pass,
        near=optics.near,
        alpha_min=optics.cutoff.alpha,
        transmittance_min=optics.cutoff.transmittance,
        alpha_max=ALPHA_MAX,
        horizon_cosine=HORIZON_COSINE,
    )
