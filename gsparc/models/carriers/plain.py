"""Plain methods of spectra at several carriers, beside which a field is shown."""

from __future__ import annotations

import torch

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.carriers.array import OneArray
from gsparc.models.carriers.geometry import SharedPaths
from gsparc.models.method import Prediction
from gsparc.physics.mirror_planes import NO_PLANES
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

BEAM = 0.5  # weight of the direct beam beside the mean image


class OtherCarriers(OneArray):
    """The mean of what all carriers saw at the place, or at the nearest one."""

    name = "other_carriers"
    baseline_order = 50
    stored = (*OneArray.stored, "means")

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """See `Method.fit`; `ValueError` where carriers have not one array."""
        watch = Stopwatch()
        images, groups = self.read_rows(data, fold.learned())
        self.means = torch.stack([images[rows].mean(0) for rows in groups])
        return FitReport(watch.seconds)

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        nearest = torch.cdist(query.tx.cpu().double(), self.places).argmin(1)
        return Prediction(self.answer_images(self.means[nearest], query))

    def count_components(self) -> int:
        """Return the number of places."""
        return len(self.places)


class DirectBeam(OneArray):
    """The array's image of the direct path beside the mean image."""

    name = "direct_beam"
    baseline_order = 60

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """See `Method.fit`; `ValueError` where carriers have not one array."""
        watch = Stopwatch()
        self.read_rows(data, fold.learned())
        return FitReport(watch.seconds)

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        ones = torch.ones(len(self.places), 1).double()
        beam = self.expected(
            SharedPaths(NO_PLANES, *self.pose(), self.places, ones), query.tx.cpu().double()
        )
        return Prediction(self.answer_images(self.mean.lerp(beam, BEAM), query))
