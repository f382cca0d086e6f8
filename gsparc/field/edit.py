"""The one place that adds and removes Gaussians: parameters, Adam moments and ids together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from gsparc.field.gaussians import GaussianField


@dataclass(frozen=True)
class Edit:
    """Rows to keep and rows to append.

    Attributes:
        keep: (N,) bool.
        parents: (M,) int64, row each appended Gaussian is copied from.
        replace: values (M, ...) that differ from the parents', by parameter name.
    """

    keep: Tensor
    parents: Tensor
    replace: Mapping[str, Tensor] = field(default_factory=dict)


def row_parameters(root: nn.Module, count: int) -> dict[str, nn.Parameter]:
    """Return every parameter that belongs to single Gaussians, by dotted name;
    their first axis is N.
    """
    rows = {}
    for name, module in root.named_modules():
        if not getattr(module, "per_gaussian", False):
            continue
        for key, parameter in module.named_parameters(recurse=False):
            if parameter.dim() and parameter.shape[0] == count:
                rows[f"{name}.{key}" if name else key] = parameter
    return rows


def apply_edit(
    edit: Edit, root: nn.Module, gaussians: GaussianField, optimizer: Optimizer | None = None
) -> None:
    """Edit all per-Gaussian state at once.

    Appended rows start with zero Adam moments and get fresh ids; kept rows stay bit-identical.

    Args:
        edit: what to keep and what to append.
        root: module that holds the field and every other per-Gaussian parameter.
        gaussians: the field inside `root`.
        optimizer: one parameter tensor per group.
    """
    rows = row_parameters(root, len(gaussians))
    groups = {} if optimizer is None else {id(g["params"][0]): g for g in optimizer.param_groups}
    for name, old in rows.items():
        added = edit.replace.get(name, old.detach()[edit.parents])
        new = nn.Parameter(
            torch.cat([old.detach()[edit.keep], added.to(old.dtype)]), old.requires_grad
        )
        _set_parameter(root, name, new)
        group = groups.get(id(old))
        # A parameter that is not learned has no group.
        if optimizer is None or group is None:
            continue
        group["params"][0] = new
        # Adam's moments are stored by tensor, and must move to the new one.
        state = optimizer.state.pop(old, None)
        if state is not None:
            for key in ("exp_avg", "exp_avg_sq"):
                moment = state[key]
                state[key] = torch.cat(
                    [moment[edit.keep], torch.zeros_like(added, dtype=moment.dtype)]
                )
            optimizer.state[new] = state
    fresh = gaussians.next_id + torch.arange(len(edit.parents), device=gaussians.ids.device)
    gaussians.ids = torch.cat([gaussians.ids[edit.keep], fresh])
    gaussians.next_id += len(edit.parents)
    # Views frozen before are refused from now on (`StalePlan`).
    gaussians.version += 1


def resize_gaussians(root: nn.Module, gaussians: GaussianField, count: int) -> None:
    """Give every per-Gaussian tensor `count` rows of zeros,
    so that a state dict of that size fits.
    """
    for name, old in row_parameters(root, len(gaussians)).items():
        _set_parameter(
            root, name, nn.Parameter(old.new_zeros(count, *old.shape[1:]), old.requires_grad)
        )
    gaussians.ids = gaussians.ids.new_zeros(count)


def _set_parameter(root: nn.Module, dotted: str, parameter: nn.Parameter) -> None:
    path, _, leaf = dotted.rpartition(".")
    setattr(root.get_submodule(path), leaf, parameter)
