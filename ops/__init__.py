"""The rasterizer: plain-PyTorch reference, C++ CPU kernels, one public face.

`rasterize` = `make_plan` (geometry: who is seen where) + `composite` (linear in the features); `mean_weights`
is its weights-only twin, `freeze` turns a static receiver's plan into a sparse matrix.
"""

if __name__ != "gsparc.ops":
    raise ImportError(f"this package is installed as gsparc.ops; import that instead of {__name__!r}")

from gsparc.ops.backends import BackendUnavailable
from gsparc.ops.door import UnsoundGaussian
from gsparc.ops.frozen import FrozenPlan, StalePlan
from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.plan import Plan
from gsparc.ops.rasterizer import composite, freeze, make_plan, mean_weights, rasterize
from gsparc.ops.results import Raster, Weights
from gsparc.ops.settings import Cutoff, Optics

__all__ = [
    "BackendUnavailable",
    "Cutoff",
    "FrozenPlan",
    "Optics",
    "Plan",
    "Pose",
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
