"""All rows of the configured sizes."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from gsparc.ops.projection import Projection
from gsparc.prediction.bench import kernels, layers
from gsparc.prediction.bench.measure import Case
from gsparc.prediction.bench.scene import NETWORK, scene

log = logging.getLogger(__name__)

MOVING = (kernels.plan, kernels.moving, kernels.weights)  # a batch is as many plans
RASTERIZER = (*MOVING[:2], kernels.static, kernels.frozen, kernels.backward, kernels.weights)
MOST_PLANNED = 1_000_000  # Gaussians times poses in one call


def cases(counts: Sequence[int], projections: Sequence[Projection], batches: Sequence[int]) -> Iterator[Case]:
    """One alive at a time: for every number of Gaussians, projection and batch."""
    for count in counts:
        for projection in projections:
            field = scene(count, projection)
            for make in RASTERIZER:
                for batch in batches:
                    if make in MOVING and count * batch > MOST_PLANNED:
                        log.info("%s of %d x %d Gaussians left out: too long", make.__name__, batch, count)
                        continue
                    yield make(field, batch)
            yield layers.channel(field, 1, 1, 1)
            yield layers.channel(field, *layers.MANY, 1)
        for batch in batches:
            yield layers.emission(count, batch)
            yield layers.emission(count, batch, NETWORK)
            yield layers.emission_backward(count, batch)
    for batch in batches:
        yield layers.loss(batch)
    for projection in projections:
        yield layers.step(projection)
