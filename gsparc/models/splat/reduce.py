"""What a splatted field can spare: Gaussians or places, pixels, the exact footprint, the confidence."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.field import edit
from gsparc.field.encoding import PositionEncoding, Prior
from gsparc.field.frozen import FrozenArray, frozen_array
from gsparc.field.model import FULL_SPHERE_ROWS, GaussianModel
from gsparc.field.response import ArrayResponse
from gsparc.models.method import Method
from gsparc.models.pareto import Settings
from gsparc.models.reduced import Filled, coarser
from gsparc.ops import Pose, SphereGrid, mean_weights
from gsparc.processes.features import correlation, farthest, with_places

if TYPE_CHECKING:
    from gsparc.models.splat.method import LearnedField

RIDGE = 1e-5  # relative to the mean footprint energy; footprints overlap
MOST_WEIGHTS = 25_000_000  # pixels times Gaussians held at once
MOST_ROWS = 64  # positions over which a contribution is averaged


def through_array(model: GaussianModel) -> bool:
    """Whether images are formed by an array from the splatted ones: on pixels of its own."""
    return model.settings.response.array


def knobs(model: GaussianModel) -> tuple[str, ...]:
    """See `Method.reduced`.

    Frozen through an array, Gaussians are one small matrix however many there are: what costs time are the
    places that the features are told by, which `keep` is a share of, and pixels.
    """
    if through_array(model):
        return ("keep", "stride" if model.tells_unknown else "projection", "confidence")
    return ("keep", "projection", "confidence", "stride")


@torch.no_grad()
def contributions(method: LearnedField, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
    """Return `contribution` (N,): what each Gaussian adds to predictions at training rows (n,) on average.

    Its weight summed over the directions of the receiver times the size of its emission. `receiver` (4, 3) is
    the pose of a static one, its position [m] above its rotation.
    """
    model = method.fitted()
    chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_ROWS)).astype(int)]
    total = torch.zeros(len(model.gaussians))
    for row in chosen:
        batch = data.batch(np.array([row]))
        emitted = model.features(batch.tx, batch.rx).abs().sum(-1).mean(0)
        total += emitted * _weights(model, batch.rx)
    result = {"contribution": total / len(chosen)}
    if model.site.static_end == "rx":
        rx = data.batch(chosen[:1]).rx
        result["receiver"] = torch.cat([rx.position.reshape(1, 3), rx.rotation.reshape(3, 3)])
    return result


def _weights(model: GaussianModel, rx: Pose) -> Tensor:
    g = model.gaussians
    return mean_weights(model.plan(rx), *g.geometry()).mean.reshape(-1, len(g))[0]


def reduced(method: LearnedField, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """Return the field with what `settings` spare left out; the trained one stays as it is.

    Args:
        method: fitted.
        settings: `keep` share of Gaussians, or of places, in (0, 1]; `stride` in pixels; `projection`;
            `confidence` or not.
        measured: from `measure`.
    """
    twin = copy.copy(method)
    twin.model = model = copy.deepcopy(method.fitted())
    site, stride = model.site, int(settings.get("stride", 1))
    raster = model.settings.raster
    raster = replace(
        raster, projection=settings.get("projection", raster.projection),
        low_pass=raster.low_pass / stride**2,  # as wide as before on the sky
    )  # fmt: skip
    model.settings = replace(model.settings, raster=raster)
    by_places = through_array(model) and model.tells_unknown
    if "keep" in settings and by_places:
        distil_features(model, float(settings["keep"]))
    elif "keep" in settings:
        share, total = float(settings["keep"]), len(model.gaussians)
        if _linear(model):
            _keep(model, spread(model, measured)[: math.ceil(share * total)])
            with torch.no_grad():
                model.gaussians.log_scales.sub_(0.5 * math.log(share))  # together they cover as much sky
            teach(model, method.fitted(), measured["receiver"])
        else:
            _keep(model, measured["contribution"].topk(math.ceil(share * total)).indices)
    if not settings.get("confidence", True):
        model.confidence = model.error = None
    model.gaussians.version += 1  # a plan frozen before is stale
    if by_places:
        twin.frozen, grid = _frozen_again(method, model, measured["receiver"], stride)
        return Filled(twin, grid, stride) if stride > 1 else twin
    if stride == 1:
        return twin
    if site.kind != "spectrum":  # visibility is measured on fewer directions, nothing to fill in
        rows = FULL_SPHERE_ROWS // stride
        model.site = replace(site, grid=SphereGrid.full_sphere(rows, 2 * rows))
        return twin
    assert site.grid is not None
    model.site = replace(site, grid=coarser(site.grid, stride))
    return Filled(twin, site.grid, stride)


def _frozen_again(
    method: LearnedField, model: GaussianModel, receiver: Tensor, stride: int
) -> tuple[FrozenArray, SphereGrid]:
    """The field through its array with other features and on fewer pixels, and their full grid.

    What the array measures of each Gaussian is that of the full grid.
    """
    view = method.frozen_at(Pose(receiver[0], receiver[1:]))
    response, grid = model.response, model.site.grid
    assert isinstance(view, FrozenArray) and isinstance(response, ArrayResponse) and grid is not None
    renderer = response.every(stride, coarser(grid, stride)) if stride > 1 else None
    return frozen_array(model, view.view, renderer), grid


def _keep(model: GaussianModel, rows: Tensor) -> None:
    keep = torch.zeros(len(model.gaussians), dtype=torch.bool)
    keep[rows] = True
    edit.apply(edit.Edit(keep, torch.zeros(0, dtype=torch.long)), model, model.gaussians)


def spread(model: GaussianModel, measured: dict[str, Tensor]) -> Tensor:
    """Return rows (N,) in an order whose every beginning is spread over the sky, the strongest first.

    Each is the one farthest from all before it. What is kept is taught anew, so places count, not strengths:
    an eighth of 2,000 Gaussians chosen by contribution leaves holes.
    """
    seen = torch.nn.functional.normalize(model.gaussians.means.detach() - measured["receiver"][0], dim=1)
    order = [int(measured["contribution"].argmax())]
    apart = 1 - seen @ seen[order[0]]
    while len(order) < len(seen):
        # Below every distance, so that what is chosen is not chosen again.
        apart[order[-1]] = -1.0
        order.append(int(apart.argmax()))
        apart = torch.minimum(apart, 1 - seen @ seen[order[-1]])
    return torch.tensor(order)


def _linear(model: GaussianModel) -> bool:
    """Whether images are linear in what the emission has learned: then fewer can be taught in closed form."""
    emission = model.settings.emission
    static = model.site.kind == "spectrum" and model.site.static_end == "rx"
    plain = not model.settings.attenuation.inverse_distance and not through_array(model)
    return static and plain and not emission.hidden and emission.activation == "linear"


@torch.no_grad()
def teach(few: GaussianModel, whole: GaussianModel, receiver: Tensor) -> None:
    """Set emissions of `few` that come nearest to images of the whole field, at all positions at once.

    Images are W E f(x) with weights W (pixels x Gaussians), read-outs E and features f: least squares over
    the pixels gives E of the few from W E of all.
    """
    rx, grid = Pose(receiver[0], receiver[1:]), whole.site.grid
    assert grid is not None
    entries = grid.height * grid.width * len(whole.gaussians)
    # The finest grid whose pixels times Gaussians fit in memory.
    fitting = [s for s in (1, 2, 3, 4, 5) if grid.width % s == 0 and entries <= MOST_WEIGHTS * s**2]
    grid = coarser(grid, fitting[0]) if fitting else grid
    wanted = _weights_of(whole, rx, grid)
    wanted = wanted @ torch.cat([whole.emission.weight2.squeeze(-1), whole.emission.bias2], 1)
    own = _weights_of(few, rx, grid)
    gram = own.mT @ own
    gram.diagonal().add_(RIDGE * gram.diagonal().mean() + 1e-12)
    result = torch.linalg.solve(gram, own.mT @ wanted)
    few.emission.weight2.copy_(result[:, :-1, None])
    few.emission.bias2.copy_(result[:, -1:])


def _weights_of(model: GaussianModel, rx: Pose, grid: SphereGrid) -> Tensor:
    """(pixels, N)."""
    view = copy.copy(model)
    view.site = replace(model.site, grid=grid)
    frozen = view.freeze(rx)
    return frozen.render(torch.eye(len(model.gaussians)), frozen.version).flatten(1).mT


@torch.no_grad()
def distil_features(model: GaussianModel, share: float) -> None:
    """Keep the `share` of the places behind the emission's features that lie farthest apart.

    The emissions of the whole field at all its places, with their noise, are what the fewer features are
    fitted to; what they cannot tell counts as unknown.

    Args:
        model: changed in place; its features tell the unknown share.
        share: in (0, 1].
    """
    emission, old = model.emission, model.emission.encoding
    places, length, noise = old.anchors.double(), old.length, old.noise
    own = correlation(places, places, length, old.kernel)
    own.diagonal().add_(noise)
    count, width, channels = emission.weight2.shape
    weights = emission.weight2.permute(1, 0, 2).reshape(width, count * channels).double()
    chosen = farthest(places, length, 0.0, old.kernel, math.ceil(share * len(places)))
    features = with_places(places[chosen], places, length, noise, old.kernel)
    result = features.weigh @ (own @ (old.whitening.double() @ weights))
    prior = Prior(features.places.float(), length, noise, old.kernel, features.whitening.float())
    few = PositionEncoding(old.settings, torch.as_tensor(model.site.query_box), prior)
    emission.encoding = few.to(old.anchors.device)
    emission.weight2 = torch.nn.Parameter(
        result.float().view(-1, count, channels).permute(1, 0, 2).contiguous(), emission.weight2.requires_grad
    )
    model.gaussians.version += 1
