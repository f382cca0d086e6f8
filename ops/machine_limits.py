"""Roofline of this CPU: peak rates that kernel timings are divided by; see csrc/machine_limits.h."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import _native
from gsparc.ops.cpu_kernels import addresses
from gsparc.ops.plan import Plan
from gsparc.ops.settings import kernel_settings


def exponentials(tasks: int) -> int:
    """Accumulate exponentials over a row of pixels in torch's threads; returns how many were evaluated."""
    return _native.mark_exponentials(tasks, torch.get_num_threads())


def copy(source: Tensor, target: Tensor) -> int:
    """Copy a contiguous tensor in torch's threads; returns the bytes read and written.

    Raises:
        ValueError: one is not contiguous, or their sizes differ.
    """
    size = source.numel() * source.element_size()
    if not source.is_contiguous() or not target.is_contiguous() or size != target.nbytes:
        raise ValueError("copying needs two contiguous tensors of the same size")
    _native.mark_copy(source.data_ptr(), target.data_ptr(), size, torch.get_num_threads())
    return 2 * size


def pairs(plan: Plan) -> int:
    """Pixel-Gaussian pairs inside the exact footprints of a CPU plan, over all its poses.

    Raises:
        ValueError: a plan of another backend.
    """
    if plan.backend != "cpu":
        raise ValueError(f"pairs are counted in plans of the cpu backend, this one is of {plan.backend!r}")
    double, settings = plan.means2d.dtype == torch.float64, kernel_settings(plan.grid, plan.optics)
    sizes = (plan.num_poses, plan.num_gaussians, torch.get_num_threads())
    return _native.mark_pairs(double, *sizes, settings, addresses(*plan.buffers))
