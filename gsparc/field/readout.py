"""The linear read-out of emissions, solved again after an edit so that the field renders what it did."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.field.frozen import seen_by_array
from gsparc.field.model import GaussianModel
from gsparc.field.response import ArrayResponse
from gsparc.ops import Pose

RIDGE = 1e-5  # of the mean energy of a view: footprints overlap, and less lets weights cancel each other


@dataclass(frozen=True)
class Readout:
    """What a field with linear emissions renders: features times weights times view.

    Attributes:
        rendered: (E + 1, P) pixels, or (E + 1, M) complex array vectors, of each feature and the constant.
    """

    rendered: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: GaussianModel, rx: Pose) -> Readout | None:
        """Return what it renders at a pose; None where emissions are not linear in their features."""
        emission = model.emission.settings
        if emission.hidden or emission.activation != "linear":
            return None
        return cls(_lines(model) @ _view(model, rx))

    @torch.no_grad()
    def solve_again(self, model: GaussianModel, rx: Pose) -> None:
        """Correct the weights of an edited field by least squares, so that it renders the same."""
        view = _view(model, rx)
        gram = (view @ view.mH).to(torch.complex128 if view.is_complex() else torch.float64)
        ridge = RIDGE * gram.diagonal().real.mean() * torch.eye(len(gram), device=gram.device)
        missing = (self.rendered - _lines(model) @ view) @ view.mH
        lines = torch.linalg.solve(gram + ridge, missing.to(gram.dtype).mH).mH.to(view.dtype)
        change = torch.view_as_real(lines) if lines.is_complex() else lines.unsqueeze(-1)
        model.emission.weight2 += change[:-1].transpose(0, 1)
        model.emission.bias2 += change[-1]


def _lines(model: GaussianModel) -> Tensor:
    """Weights of all features and the constant (E + 1, N), complex where an array measures."""
    parts = torch.cat([model.emission.weight2.transpose(0, 1), model.emission.bias2[None]])
    return torch.view_as_complex(parts.contiguous()) if parts.shape[-1] == 2 else parts.squeeze(-1)


def _view(model: GaussianModel, rx: Pose) -> Tensor:
    """What unit emissions of all Gaussians look like (N, P), or (N, M) complex to the array.

    Attenuation is that of the middle of the moving end's box: it hardly differs between a Gaussian and what
    it is split into.
    """
    if isinstance(model.response, ArrayResponse):
        view = seen_by_array(model, rx)
    else:
        each = torch.eye(len(model.gaussians), device=model.gaussians.means.device)
        view = model.freeze(rx).render(each, int(model.gaussians.version)).flatten(1)
    middle = torch.as_tensor(model.site.box).float().mean(0, keepdim=True).to(model.gaussians.means.device)
    attenuation = model.attenuation(model.distances(middle))
    return view if attenuation is None else view * attenuation[0, :, None]
