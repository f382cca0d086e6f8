"""What a splatted field can spare: places that its features are told by, pixels, the confidence."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.field.encoding import PositionEncoding, Smoothness
from gsparc.field.frozen import FrozenArray, freeze_array
from gsparc.field.model import FULL_SPHERE_ROWS, GaussianModel
from gsparc.field.response import ArrayResponse
from gsparc.models.method import Method
from gsparc.models.reduced import Interpolated, Settings, coarsen_grid
from gsparc.ops import Pose, SphereGrid
from gsparc.processes.features import correlation, pivoted_rows, place_features

if TYPE_CHECKING:
    from gsparc.models.splat.method import LearnedField


def reduction_settings(method: LearnedField) -> tuple[str, ...]:
    """See `Method.reduce`.

    Frozen through an array, Gaussians are one small matrix however many there are: what costs time
    are the places that the features are told by, which `keep` is a share of, and pixels.
    """
    model = method.fitted_model()
    if not model.settings.response.array:
        return ("confidence", "stride")
    return ("keep", "stride", "confidence") if model.tells_unknown else ("confidence",)


def reduction_inputs(
    method: LearnedField, data: Measurements, rows: np.ndarray
) -> dict[str, Tensor]:
    """Return `receiver` (4, 3), a static one's position [m] above its rotation; else nothing."""
    if method.fitted_model().site.static_end != "rx":
        return {}
    rx = data.batch(rows[:1]).rx
    pose = rx[0] if rx.batched else rx
    return {"receiver": torch.cat([pose.position[None], pose.rotation])}


def reduce_field(method: LearnedField, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """Return the field with what `settings` spare left out; the trained one stays as it is.

    Args:
        method: fitted.
        settings: `keep` share of places in (0, 1]; `stride` in pixels; `confidence` or not.
        measured: from `measure`.
    """
    twin = copy.copy(method)
    twin.model = model = copy.deepcopy(method.fitted_model())
    site, stride = model.site, int(settings.get("stride", 1))
    raster = model.settings.raster
    raster = replace(raster, low_pass=raster.low_pass / stride**2)  # as wide as before on the sky
    model.settings = replace(model.settings, raster=raster)
    by_places = model.settings.response.array and model.tells_unknown
    if "keep" in settings:
        distil_features(model, float(settings["keep"]))
    if not settings.get("confidence", True):
        model.confidence = model.error = None
    model.gaussians.version += 1  # a plan frozen before is stale
    if by_places:
        twin.frozen, grid = _freeze_coarse(method, model, measured["receiver"], stride)
        return Interpolated(twin, grid, stride) if stride > 1 else twin
    if stride == 1:
        return twin
    if not site.target.is_image:  # visibility is measured on fewer directions, nothing to fill in
        rows = FULL_SPHERE_ROWS // stride
        model.site = replace(site, grid=SphereGrid.full_sphere(rows, 2 * rows))
        return twin
    assert site.grid is not None
    model.site = replace(site, grid=coarsen_grid(site.grid, stride))
    return Interpolated(twin, site.grid, stride)


def _freeze_coarse(
    method: LearnedField, model: GaussianModel, receiver: Tensor, stride: int
) -> tuple[FrozenArray, SphereGrid]:
    """The field through its array with other features and on fewer pixels, and their full grid.

    What the array measures of each Gaussian is that of the full grid.
    """
    view = method.frozen_at(Pose(receiver[0], receiver[1:]))
    response, grid = model.response, model.site.grid
    assert (
        isinstance(view, FrozenArray) and isinstance(response, ArrayResponse) and grid is not None
    )
    renderer = response.coarse_renderer(stride, coarsen_grid(grid, stride)) if stride > 1 else None
    return freeze_array(model, view.view, renderer), grid


@torch.no_grad()
def distil_features(model: GaussianModel, share: float) -> None:
    """Keep the `share` of the places behind the emission's features that lie farthest apart.

    The emissions of the whole field at all its places, with their noise, are what the fewer
    features are fitted to; what they cannot tell counts as unknown.

    Args:
        model: changed in place; its features tell the unknown share.
        share: in (0, 1].
    """
    emission, old = model.emission, model.emission.encoding
    places, length, noise = old.anchors.double(), old.length, old.noise
    gram = correlation(places, places, length, old.kernel)
    gram.diagonal().add_(noise)
    count, width, channels = emission.weight2.shape
    weights = emission.weight2.permute(1, 0, 2).reshape(width, count * channels).double()
    chosen = pivoted_rows(places, length, 0.0, old.kernel, math.ceil(share * len(places)))
    features = place_features(places[chosen], places, length, noise, old.kernel)
    result = features.weigh @ (gram @ (old.whitening.double() @ weights))
    prior = Smoothness(
        features.places.float(), length, noise, old.kernel, features.whitening.float()
    )
    few = PositionEncoding(old.settings, torch.as_tensor(model.site.query_box), prior)
    emission.encoding = few.to(old.anchors.device)
    emission.weight2 = torch.nn.Parameter(
        result.float().view(-1, count, channels).permute(1, 0, 2).contiguous(),
        emission.weight2.requires_grad,
    )
    model.gaussians.version += 1
