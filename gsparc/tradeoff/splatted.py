"""What a splatted field can spare: Gaussians, pixels, faint edges, the frozen plan, the confidence."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsparc import surgery
from gsparc.data.schema import Measurements
from gsparc.learned import LearnedField
from gsparc.method import Method, Prediction
from gsparc.model import FULL_SPHERE_ROWS, GaussianModel
from gsparc.ops import Pose, SphereGrid, mean_weights
from gsparc.tradeoff.coarse import Filled, coarser
from gsparc.tradeoff.points import Settings
from gsparc.tradeoff.view import View

MOST_ROWS = 64  # positions over which a contribution is averaged


def knobs(method: LearnedField) -> tuple[str, ...]:
    """What can be turned."""
    model = method.fitted()
    static = model.site.kind == "spectrum" and model.site.static_end == "rx"
    through_array = getattr(getattr(model.settings, "response", None), "array", False)  # pixels of its own
    known = ("keep", "cutoff", "projection", "confidence")
    return (*known, *(() if through_array else ("stride",)), *(("frozen",) if static else ()))


@torch.no_grad()
def measure(method: LearnedField, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
    """`contribution` (N,): what each Gaussian adds to the predictions at training rows (n,), on average.

    Its weight summed over the directions of the receiver times the size of its emission.
    """
    model = method.fitted()
    chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_ROWS)).astype(int)]
    total = torch.zeros(len(model.gaussians))
    for row in chosen:
        batch = data.batch(np.array([row]))
        emitted = model.features(batch.tx, batch.rx).abs().sum(-1).mean(0)
        total += emitted * _weights(model, batch.rx)
    return {"contribution": total / len(chosen)}


def _weights(model: GaussianModel, rx: Pose) -> Tensor:
    g = model.gaussians
    return mean_weights(model.plan(rx), g.means, g.quats, g.scales, g.opacities).mean.reshape(-1, len(g))[0]


def reduced(method: LearnedField, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """The field with what `settings` spare left out; the trained one stays as it is.

    Args:
        method: fitted.
        settings: `keep` share of Gaussians in (0, 1]; `stride` in pixels; `cutoff` factor on the smallest
            alpha that counts; `projection`; `frozen` plan or not; `confidence` or not.
        measured: from `measure`.
    """
    twin = copy.copy(method)
    twin.model = model = copy.deepcopy(method.fitted())
    site, stride = model.site, int(settings.get("stride", 1))
    raster = model.settings.raster
    factor = float(settings.get("cutoff", 1))
    raster = replace(
        raster,
        projection=settings.get("projection", raster.projection),
        low_pass=raster.low_pass / stride**2,  # as wide as before on the sky
        alpha_cutoff=raster.alpha_cutoff * factor,
        relative_cutoff=raster.relative_cutoff * factor,
    )
    model.settings = replace(model.settings, raster=raster)
    if "keep" in settings:
        _keep(model, float(settings["keep"]), measured["contribution"])
    if not settings.get("confidence", True):
        model.confidence = None
    model.gaussians.version += 1  # a plan frozen before is stale
    found: Method = twin if settings.get("frozen", True) else Live(twin)
    if stride == 1:
        return found
    if site.kind != "spectrum":  # visibility is measured on fewer directions, nothing to fill in
        rows = FULL_SPHERE_ROWS // stride
        model.site = replace(site, grid=SphereGrid.full_sphere(rows, 2 * rows))
        return found
    assert site.grid is not None
    model.site = replace(site, grid=coarser(site.grid, stride))
    return Filled(found, site.grid, stride)


class Live(View):
    """A static receiver's plan made anew for every query, as a moving one's must be."""

    def __init__(self, inner: LearnedField) -> None:
        super().__init__(inner)
        self._model = inner.fitted()

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the mean alone."""
        mean = self._model(tx, rx).mean
        return Prediction(mean.clamp(0, 1) if self._model.site.kind == "spectrum" else mean)


def _keep(model: GaussianModel, share: float, contribution: Tensor) -> None:
    count = max(1, math.ceil(share * len(contribution)))
    keep = torch.zeros(len(contribution), dtype=torch.bool)
    keep[contribution.topk(count).indices] = True
    surgery.apply(surgery.Edit(keep, torch.zeros(0, dtype=torch.long)), model, model.gaussians)
