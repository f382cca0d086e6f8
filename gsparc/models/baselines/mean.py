"""The mean of the training targets: what is known without knowing where one is."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsparc.data.blocks import row_blocks
from gsparc.data.ends import Ends
from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction
from gsparc.models.target_rows import heard_rows, training_targets
from gsparc.training.context import FitContext, FitReport


class Mean(Interpolator):
    """Predicts the training mean everywhere (of decibels for RSSI), of several stations that of each.

    Attributes:
        value: (T + 1, D) real numbers, the last of all rows, as stations of fewer than two have it; (1, D) of
            one station.
    """

    name = "mean"
    baseline_order = 20
    no_gradient = "predictions are the same everywhere"
    stored = ("value",)
    value: Tensor

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """See `Interpolator`; it knows stations apart."""
        report = super().fit(data, fold, context)
        if not data.site.several:
            return report
        rows, parts = heard_rows(data, fold.learned()), list[Tensor]()
        for number in range(len(data.site.every_station)):
            own = rows[data.stations_of(rows) == number]
            parts.append(self._average(training_targets(data, own)) if len(own) > 1 else self.value)
        self.value = torch.cat([*parts, self.value])
        return report

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        self.value = self._average(targets)
        return ()

    def _average(self, targets: np.ndarray) -> Tensor:
        total = np.zeros(int(np.prod(self.shape)) * self.target.numbers)
        for part in row_blocks(targets):  # thousands of byte images never become floats at once
            total += self.target.to_real(targets[part]).sum(0, dtype=np.float64)
        return torch.from_numpy(total / len(targets)).float()[None]

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        site = self.fitted_site
        number = Ends.from_query(site, query).station if site.several else torch.zeros(len(query)).long()
        return Prediction(self._to_targets(self.value.reshape(-1, self.value.shape[-1])[number]))

    def _look_up(self, queries: np.ndarray) -> Prediction:
        return Prediction(self._to_targets(self.value[-1:].expand(len(queries), -1).contiguous()))
