"""Spectra at a static receiver from emissions alone:
projection and depth order are computed once.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc import ops
from gsparc.field import edit
from gsparc.field.encoding import unknown_share
from gsparc.field.model import GaussianModel, Rendered
from gsparc.field.response import SLOPE_ENDS, ArrayResponse
from gsparc.ops import FrozenPlan, Pose, StalePlan, queries
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.processes.features import matern_mixture


@dataclass(frozen=True)
class FrozenView:
    """One pose's view of a field, valid for the parameters it was made from.

    Attributes:
        version: the field's counter at the time.
        plan: pixels by Gaussians.
        visible: the model reduced to the Gaussians that the receiver sees, in the plan's order:
            only their emissions are computed.
    """

    version: int
    plan: FrozenPlan
    visible: GaussianModel

    @torch.no_grad()
    def render(self, model: GaussianModel, tx: Tensor, rx: Pose) -> Rendered:
        """Return spectra (B, H, W) at tx (B, 3) [m]; `rx` is the pose that was frozen.

        Raises:
            StalePlan: the field has changed since.
        """
        _check_version(self.version, model)
        image = model.to_spectra(self.plan.render_visible(self.visible.emissions(tx, rx)))
        return Rendered(image, None, self.visible.unknown_shares(tx, rx))


@dataclass(frozen=True)
class FrozenArray:
    """The same through an array: A times the view,
    and times the emission weights where those are linear.

    Attributes:
        version: the field's counter at the time.
        view: (N, M) complex64, emissions to array vectors.
        weights: (E, 2 M + 2) float32, encoded positions to real and imaginary parts of array
            vectors and, left at 0, of the unknown share; None where emissions are not linear in
            them.
        offset: (2 M + 2,) float32, added to them.
        renderer: array vectors to spectra where the unknown share is known; on the site's grid or a
            coarser.
    """

    version: int
    view: Tensor
    weights: Tensor | None
    offset: Tensor | None
    renderer: SpectrumRenderer

    def render(self, model: GaussianModel, tx: Tensor, rx: Pose) -> Rendered:
        """See `FrozenView.render`; spectra of a known share are cut off at 1.
        Differentiable in positions.
        """
        _check_version(self.version, model)
        response = model.response
        assert isinstance(response, ArrayResponse)
        if self.weights is None or self.offset is None:
            emitted = torch.view_as_complex(model.emissions(tx, rx).contiguous())
            unknown = model.unknown_shares(tx, rx)
            return Rendered(response.spectra(emitted @ self.view, unknown), None, unknown)
        moving, encoding = model.site.moving(tx, rx), model.emission.encoding
        # The compiled kernel is float32; float64, for slopes, goes the long way below.
        kernels = moving.dtype == torch.float32 and queries.has_query_kernel(moving, self.weights)
        if model.tells_unknown and kernels:
            mean, unknown = queries.array_spectrum(
                moving,
                (encoding.anchors, encoding.whitening),
                (self.weights, self.offset),
                self.renderer.tables,
                self.renderer.square,
                matern_mixture(encoding.length, encoding.kernel),
            )
            return Rendered(mean, None, unknown)
        encoded = encoding(moving)
        parts = torch.addmm(self.offset, encoded, self.weights).view(len(encoded), -1, 2)
        if not model.tells_unknown:
            return Rendered(response.spectra(torch.view_as_complex(parts)[:, :-1]), None)
        unknown = unknown_share(encoded)
        share = unknown.clamp_min(SLOPE_ENDS).sqrt()[:, None].to(parts.dtype.to_complex())
        vectors = torch.cat([torch.view_as_complex(parts)[:, :-1], share], 1)
        return Rendered(self.renderer(vectors).clamp(max=1), None, unknown)


@torch.no_grad()
def freeze_view(model: GaussianModel, rx: Pose) -> FrozenView | FrozenArray:
    """Freeze what a static receiver sees of a model of spectra."""
    version = int(model.gaussians.version)
    if isinstance(model.response, ArrayResponse):
        return freeze_array(model, gaussian_vectors(model, rx))
    plan = model.freeze(rx)
    return FrozenView(version, plan, _copy_gaussians(plan.order, model))


@torch.no_grad()
def freeze_array(
    model: GaussianModel, view: Tensor, renderer: SpectrumRenderer | None = None
) -> FrozenArray:
    """Freeze a model with an array from what the array measures of each Gaussian, `view` (N, M).

    Args:
        model: the field as it is now.
        view: of `gaussian_vectors`.
        renderer: None takes the response's own.
    """
    emission, response, version = model.emission, model.response, int(model.gaussians.version)
    assert isinstance(response, ArrayResponse)
    renderer = renderer or response.renderer
    # Hidden units and distances make emissions no linear function of features.
    if emission.settings.hidden or model.settings.attenuation.inverse_distance:
        return FrozenArray(version, view, None, None, renderer)
    weight, bias = (
        torch.view_as_complex(part.contiguous()) for part in (emission.weight2, emission.bias2)
    )
    # And the share
    lines = torch.nn.functional.pad(torch.cat([weight.T, bias[None]]) @ view, (0, 1))
    parts = torch.view_as_real(lines).flatten(1)
    return FrozenArray(version, view, parts[:-1].contiguous(), parts[-1], renderer)


def _check_version(version: int, model: GaussianModel) -> None:
    now = int(model.gaussians.version)
    if now != version:
        raise StalePlan(
            f"this view was frozen at version {version}, the field is at {now}: freeze again"
        )


def _copy_gaussians(rows: Tensor, model: GaussianModel) -> GaussianModel:
    """A copy with these Gaussians alone, in this order."""
    copy = deepcopy(model)
    # Kept rows stay in their order: all are appended anew in the plan's instead.
    none = torch.zeros(len(model.gaussians), dtype=torch.bool, device=rows.device)
    edit.apply_edit(edit.Edit(none, rows), copy, copy.gaussians)
    return copy


def gaussian_vectors(model: GaussianModel, rx: Pose) -> Tensor:
    """Return A times the frozen view (N, M) complex64:
    array vector of each Gaussian's unit emission.

    Both are linear: what a unit of every Gaussian adds to one antenna is the gradient of that
    antenna by emissions, so that the cost grows with footprints and antennas,
    not with the square of the Gaussians.
    """
    response, count = model.response, len(model.gaussians)
    assert isinstance(response, ArrayResponse) and model.site.grid is not None
    # Queries may come in inference mode, in which nothing is differentiated.
    with torch.inference_mode(False), torch.enable_grad():
        shape, device = (
            (1, 2, model.site.grid.height, model.site.grid.width),
            model.gaussians.means.device,
        )
        field = torch.zeros(shape, device=device, requires_grad=True)
        parts = torch.view_as_real(response.array_vectors(field)).flatten()
        by_pixel = [torch.autograd.grad(part, field, retain_graph=True)[0][0, 0] for part in parts]
        means, quats, scales, opacities = (part.detach() for part in model.gaussians.geometry())
        emitted = torch.zeros(count, len(parts), device=device, requires_grad=True)
        # Perhaps made in inference mode
        plan = model.plan(Pose(rx.position.clone(), rx.rotation.clone()))
        image = ops.composite(plan, means, quats, scales, opacities, emitted).image
        (seen,) = torch.autograd.grad(image, emitted, torch.stack(by_pixel).view_as(image))
    return torch.view_as_complex(seen.view(count, len(parts) // 2, 2))
