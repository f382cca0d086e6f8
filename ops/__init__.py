"""The rasterizer: plain-PyTorch reference, C++ and CUDA kernels, one interface.

`rasterize` = `make_plan` (footprints, visibility, depth order) + `composite` (linear in the features);
`mean_weights` is its weights-only twin, `freeze` turns a static receiver's plan into a sparse matrix.
"""

if __name__ != "gsparc.ops":
    raise ImportError(f"this package is installed as gsparc.ops; import that instead of {__name__!r}")

from gsparc.ops.backends import BackendUnavailable
from gsparc.ops.frozen import FrozenPlan, StalePlan
from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.projection import Projection
from gsparc.ops.rasterizer import composite, freeze, make_plan, mean_weights, rasterize
from gsparc.ops.results import Plan, Raster, Weights
from gsparc.ops.settings import Cutoff, Optics
from gsparc.ops.validation import UnsoundGaussian

__all__ = [
    "BackendUnavailable",
    "Cutoff",
    "FrozenPlan",
    "Optics",
    "Plan",
    "Pose",
    "Projection",
    "Raster",
    "SphereGrid",
    "StalePlan",
    "UnsoundGaussian",
    "Weights",
    "composite",
    "freeze",
    "make_plan",
    "mean_weights",
    "rasterize",
]
