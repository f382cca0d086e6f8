"""Spectra at a static receiver from emissions alone: projection and depth order are computed once."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.field import edit
from gsparc.field.model import GaussianModel
from gsparc.field.response import ArrayResponse
from gsparc.ops import FrozenPlan, Pose, StalePlan

BLOCK = 128  # Gaussians whose images are in memory at once


@dataclass(frozen=True)
class FrozenView:
    """One pose's view of a field, valid for the parameters it was made from.

    Attributes:
        version: the field's counter at the time.
        plan: pixels by Gaussians.
        visible: the model reduced to the Gaussians that the receiver sees, in the plan's order: only their
            emissions are computed.
    """

    version: int
    plan: FrozenPlan
    visible: GaussianModel

    @torch.no_grad()
    def render(self, model: GaussianModel, tx: Tensor, rx: Pose) -> Tensor:
        """Spectra (B, H, W) at tx (B, 3) [m]; `rx` is the pose that was frozen.

        Raises:
            StalePlan: the field has changed since.
        """
        _check_version(self.version, model)
        return self.plan.compose(self.visible.features(tx, rx)).squeeze(1)


@dataclass(frozen=True)
class FrozenArray:
    """The same through an array: A times the view, and times the emission weights where those are linear.

    Attributes:
        version: the field's counter at the time.
        matrix: (N, M) complex64, emissions to array vectors; or (E, M), encoded positions to array vectors.
        offset: (M,) complex64, added in the second case; None in the first.
    """

    version: int
    matrix: Tensor
    offset: Tensor | None

    @torch.no_grad()
    def render(self, model: GaussianModel, tx: Tensor, rx: Pose) -> Tensor:
        """See `FrozenView.render`."""
        _check_version(self.version, model)
        assert isinstance(model.response, ArrayResponse)
        if self.offset is None:
            emitted = torch.view_as_complex(model.features(tx, rx).contiguous())
            return model.response.spectra(emitted @ self.matrix)
        encoded = model.emission.encoding(model.site.moving(tx, rx))
        return model.response.spectra(torch.addmm(self.offset, encoded.to(self.matrix.dtype), self.matrix))


@torch.no_grad()
def frozen_view(model: GaussianModel, rx: Pose) -> FrozenView | FrozenArray:
    """Freeze what a static receiver sees of a model of spectra."""
    version = int(model.gaussians.version)
    if not isinstance(model.response, ArrayResponse):
        plan = model.freeze(rx)
        return FrozenView(version, plan, _subset(plan.order, model))
    matrix, emission = seen_by_array(model, rx), model.emission
    if emission.settings.hidden or model.settings.attenuation.inverse_distance:
        return FrozenArray(version, matrix, None)
    weight, bias = (torch.view_as_complex(part.contiguous()) for part in (emission.weight2, emission.bias2))
    return FrozenArray(version, weight.T @ matrix, bias @ matrix)


def _check_version(version: int, model: GaussianModel) -> None:
    now = int(model.gaussians.version)
    if now != version:
        raise StalePlan(f"this view was frozen at version {version}, the field is at {now}: freeze again")


def _subset(rows: Tensor, model: GaussianModel) -> GaussianModel:
    """A copy with these Gaussians alone, in this order."""
    copy = deepcopy(model)
    none = torch.zeros(len(model.gaussians), dtype=torch.bool, device=rows.device)
    edit.apply(edit.Edit(none, rows), copy, copy.gaussians)
    return copy


@torch.no_grad()
def seen_by_array(model: GaussianModel, rx: Pose) -> Tensor:
    """A times the frozen view (N, M) complex64: array vector of each Gaussian's unit emission."""
    plan, version, response = model.freeze(rx), int(model.gaussians.version), model.response
    assert isinstance(response, ArrayResponse)
    parts = []
    for units in torch.eye(len(model.gaussians)).split(BLOCK, 1):
        seen = plan.render(units, version)
        parts.append(response.measured(torch.stack([seen, torch.zeros_like(seen)], 1)))
    return torch.cat(parts)
