"""The linear read-out of emissions, solved again after an edit so
that the field renders what it did.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.data.query import Batch
from gsparc.field import edit
from gsparc.field.frozen import gaussian_vectors
from gsparc.field.model import GaussianModel
from gsparc.field.response import ArrayResponse
from gsparc.ops import Pose
from gsparc.processes.factor import Factor

# Of the mean energy of a view: footprints overlap, and less lets weights cancel each other
RIDGE = 1e-3


@dataclass(frozen=True)
class SolvedReadout:
    """The read-out of a field after an edit.

    Attributes:
        weight, bias: of the emission's last layer.
        change: of what is rendered: mean square over a batch (), this process's part of it.
    """

    weight: Tensor
    bias: Tensor
    change: Tensor


@torch.no_grad()
def solve_readout(model: GaussianModel, change: edit.Edit, batch: Batch) -> SolvedReadout | None:
    """Return the read-out with which an edited field renders what it does now;
    the field stays as it is.

    Weights of the edited field are corrected by least squares, for all features at once.

    Args:
        model: of spectra and a static receiver.
        change: that is planned.
        batch: of which the change is measured.

    Returns:
        None where emissions are not linear in their features.
    """
    emission = model.emission.settings
    if emission.hidden or emission.activation != "linear":
        return None
    rendered = _feature_weights(model) @ _unit_views(model, batch.rx)
    trial = copy.deepcopy(model)
    edit.apply_edit(change, trial, trial.gaussians)
    view = _unit_views(trial, batch.rx)
    # float64: eigenvalues of footprints that overlap are lost in float32's rounding.
    gram = (view @ view.mH).to(torch.complex128 if view.is_complex() else torch.float64)
    ridge = RIDGE * gram.diagonal().real.mean() * torch.eye(len(gram), device=gram.device)
    missing = (rendered - _feature_weights(trial) @ view) @ view.mH
    lines = Factor.from_gram(gram + ridge).solve(missing.to(gram.dtype).mH).mH.to(view.dtype)
    correction = torch.view_as_real(lines) if lines.is_complex() else lines.unsqueeze(-1)
    trial.emission.weight2.add_(correction[:-1].transpose(0, 1))
    trial.emission.bias2.add_(correction[-1])
    error = trial(batch.tx, batch.rx).mean - model(batch.tx, batch.rx).mean
    return SolvedReadout(
        trial.emission.weight2, trial.emission.bias2, batch.share * error.square().mean()
    )


def _feature_weights(model: GaussianModel) -> Tensor:
    """Weights of all features and the constant (E + 1, N), complex where an array measures."""
    parts = torch.cat([model.emission.weight2.transpose(0, 1), model.emission.bias2[None]])
    return torch.view_as_complex(parts.contiguous()) if parts.shape[-1] == 2 else parts.squeeze(-1)


def _unit_views(model: GaussianModel, rx: Pose) -> Tensor:
    """What unit emissions of all Gaussians look like (N, P), or (N, M) complex to the array.

    Attenuation is that of the middle of the moving end's box: it hardly differs between a Gaussian
    and what it is split into.
    """
    if isinstance(model.response, ArrayResponse):
        view = gaussian_vectors(model, rx)
    else:
        each = torch.eye(len(model.gaussians), device=model.gaussians.means.device)
        view = model.freeze(rx).render(each, int(model.gaussians.version)).flatten(1)
    middle = (
        torch.as_tensor(model.site.box)
        .float()
        .mean(0, keepdim=True)
        .to(model.gaussians.means.device)
    )
    attenuation = model.attenuation(model.relative_distances(middle))
    return view if attenuation is None else view * attenuation[0, :, None]
