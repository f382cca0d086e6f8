"""Roofline of this CPU: peak rates that kernel timings are divided by; see csrc/machine_limits.h."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.results import Plan


def exponentials(tasks: int) -> int:
    """Accumulate exponentials over a row of pixels in torch's threads; returns how many were evaluated."""
    return calls.run("mark_exponentials", torch.empty(0), sizes=(tasks,))


def copy(source: Tensor, target: Tensor) -> int:
    """Copy a contiguous tensor in torch's threads; returns the bytes read and written.

    Raises:
        ValueError: one is not contiguous, or their sizes differ.
    """
    size = source.numel() * source.element_size()
    if not source.is_contiguous() or not target.is_contiguous() or size != target.nbytes:
        raise ValueError("copying needs two contiguous tensors of the same size")
    # Each byte is read once and written once.
    return 2 * calls.run("mark_copy", source, source, target, numbers=(size,))


def pairs(plan: Plan) -> int:
    """Count pixel-Gaussian pairs inside the exact footprints of a CPU plan, over all its poses.

    Raises:
        ValueError: a plan of another backend.
    """
    if plan.backend != "cpu":
        raise ValueError(f"pairs are counted in plans of the cpu backend, this one is of {plan.backend!r}")
    sizes = (plan.num_poses, plan.num_gaussians)
    return calls.run("mark_pairs", plan.means2d, *plan.buffers, sizes=sizes, settings=plan.settings)
