"""A trained model as a field of snapshots:
mean and variance of all that would be heard at a place.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.apps.locate.snapshots import flatten_targets
from gsparc.data.query import Query
from gsparc.models.method import predict_with_threads
from gsparc.prediction.predictor import Predictor

# Values that are asked for at a time: all stations of some places, which share their work
CHUNK = 1024


@dataclass(frozen=True)
class HeardMoments:
    """What would be heard at G places.

    Attributes:
        mean: (G, P) as in `Snapshots.values`; NaN where a station has no prediction.
        variance: (G, P) expected squared error of a measurement, of powers in dB^2; of spectra (G,
            1).
    """

    mean: Tensor
    variance: Tensor


class SiteField:
    """Answers for all stations of a site together.

    Args:
        predictor: whose predictions have variances.

    Raises:
        ValueError: both ends move.
    """

    def __init__(self, predictor: Predictor) -> None:
        self.predictor, self.site = predictor, predictor.site
        if self.site.paired:
            raise ValueError("locate: both ends move; one that stands still is needed")
        self.count = len(self.site.every_station)

    @torch.no_grad()
    def moments_at(self, places: Tensor) -> HeardMoments:
        """Return what would be heard at places (G, 3) float64 [m, local].

        Raises:
            ValueError: the model states no variance.
        """
        parts = [self._chunk(chunk) for chunk in places.split(max(CHUNK // self.count, 1))]
        return HeardMoments(
            torch.cat([p.mean for p in parts]), torch.cat([p.variance for p in parts])
        )

    def _chunk(self, places: Tensor) -> HeardMoments:
        site = self.site
        station = (
            torch.arange(self.count).repeat(len(places)) if site.stations is not None else None
        )
        query = Query.from_places(site, places.float().repeat_interleave(self.count, 0), station)
        prediction = predict_with_threads(self.predictor.method, query)
        if prediction.variance is None:
            raise ValueError(
                f"locate: {self.predictor.method.name} states no variance of what is heard"
            )
        mean, variance = flatten_targets(prediction.mean), prediction.variance.double()[:, None]
        if site.target.is_image:
            return HeardMoments(mean.double(), variance)
        mean, variance = site.target.moments_in_error_unit(mean, variance)
        number = torch.complex128 if site.target.is_complex else torch.float64
        return self._joined(mean.to(number), variance.expand(mean.shape))

    def _joined(self, mean: Tensor, variance: Tensor) -> HeardMoments:
        """Of rows by place and station (G T, p): (G, T p)."""
        return HeardMoments(
            *(part.reshape(-1, self.count * part.shape[1]) for part in (mean, variance))
        )
