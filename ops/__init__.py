"""The rasterizer: plain-PyTorch reference, CPU kernels, CUDA kernels, one public face."""

if __name__ != "gsparc.ops":
    raise ImportError(f"this package is installed as gsparc.ops; import that instead of {__name__!r}")

from gsparc.ops.geometry import Pose, SphereGrid

__all__ = ["Pose", "SphereGrid"]
