"""A field whose emissions are told by fewer places, taught what all of them told."""

from __future__ import annotations

import math

import torch

from gsparc.field.encoding import PositionEncoding, Prior
from gsparc.field.model import GaussianModel
from gsparc.processes.features import correlation, farthest, with_places


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
    found = features.weigh @ (own @ (old.whitening.double() @ weights))
    prior = Prior(features.places.float(), length, noise, old.kernel, features.whitening.float())
    few = PositionEncoding(old.settings, torch.as_tensor(model.site.query_box), prior)
    emission.encoding = few.to(old.anchors.device)
    emission.weight2 = torch.nn.Parameter(
        found.float().view(-1, count, channels).permute(1, 0, 2).contiguous(), emission.weight2.requires_grad
    )
    model.gaussians.version += 1
