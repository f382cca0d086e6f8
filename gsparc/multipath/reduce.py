"""Reductions of the image-source model: fewer searches, fewer sources, no variance."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsparc.methods.method import Method
from gsparc.methods.pareto import Settings
from gsparc.methods.reduced import MeanOnly
from gsparc.multipath.phased_gp import PhasedPosterior, PhasedScene
from gsparc.multipath.query import Query

if TYPE_CHECKING:
    from gsparc.multipath.image_source_gp import ImageSourceGP


@torch.no_grad()
def reduced(method: ImageSourceGP, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """The process with fewer `searches` (of largest weight), fewer sources (`keep`, a share), no variance.

    The gains of the remaining sources are fitted anew: one factorisation here, nothing at queries.
    """
    twin = copy.copy(method)
    count = min(int(settings.get("searches", len(method.members))), len(method.members))
    chosen = method.weights.topk(count).indices.sort().values
    twin.members = [method.members[i] for i in chosen]
    twin.weights = method.weights[chosen] / method.weights[chosen].sum()
    if "keep" in settings:
        share = float(settings["keep"])
        twin.members = [
            _fewer(m, share, measured[f"contribution{i}"]) for m, i in zip(twin.members, chosen, strict=True)
        ]
    if settings.get("confidence", True):
        twin.query = Query(twin.members)
        return twin
    twin.query = MeanQuery(twin.members, variance_rows=1)
    return MeanOnly(twin)


def _fewer(member: PhasedPosterior, share: float, contribution: Tensor) -> PhasedPosterior:
    count = max(1, math.ceil(share * len(contribution)))
    loudest = set(contribution.topk(count).indices.tolist())
    kept = sorted(loudest | {0})  # the words of all others start at the transmitter
    phased = member.phased
    scene = PhasedScene(phased.scene.only(kept), phased.phase[kept], phased.quadrature)
    return PhasedPosterior(member.rows, scene, member.noise_floor)


class MeanQuery(Query):
    """Means alone: the variance is most of a query's time."""

    def _variance(self, part: Tensor, *unused: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(part)), torch.ones(len(part))
