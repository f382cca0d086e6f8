"""The rasterizer: plain-PyTorch reference, C++ and CUDA kernels, one interface.

`rasterize` = `make_plan` (footprints, visibility, depth order) + `composite` (linear in the
features); `mean_weights` is its weights-only twin,
`freeze` turns a static receiver's plan into a sparse matrix.

>>> import torch
>>> mean, rotation = torch.tensor([[4.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
>>> scene = mean, rotation, torch.full((1, 3), 0.5), torch.tensor([0.8])  # scales [m], opacity
>>> plan = make_plan(*scene, Pose.identity(torch.zeros(3)), SphereGrid.hemisphere(9, 36))
>>> composite(plan, *scene, torch.ones(1, 2)).image.shape  # of two channels
torch.Size([1, 2, 9, 36])
>>> mean_weights(plan, *scene).share  # nothing hides it
tensor([[1.]])
>>> freeze(plan, *scene, version=0).render(torch.ones(1, 2), version=0).shape
torch.Size([2, 9, 36])
"""

if __name__ != "gsparc.ops":
    raise ImportError(
        f"this package is installed as gsparc.ops; import that instead of {__name__!r}"
    )

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
