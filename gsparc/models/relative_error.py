"""Expected relative error of a prediction, regressed on what is known of it without a measurement.

One regression for all methods whose own variance is not their error: that of a process on images
depends on the sampling density alone, that of sources in a snapshot on the sources that were found.
The error of rows that a fit did not see is a positive number over decades: its logarithm is
regressed, and the mean of the error itself is what is answered.

`gsparc.field.confidence.ErrorModel` is none of these: one variable, the unknown share, of which the
error is a power law up to places where nothing is known, beyond the range of any row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.processes.stored import Stored

LEAST_ERROR = 1e-6  # -60 dB: logarithms of smaller ones would decide the fit
LEAST_SCALE = 1e-3  # of a column that hardly varies
RIDGES = np.logspace(-2, 4, 13)  # chosen by leave-one-out
OUTLIERS = 1e-3  # share of the training errors beyond either bound of what is answered


@dataclass(frozen=True)
class RelativeErrorRegression(Stored):
    """Ridge regression of the logarithm of |e|^2 over a power on S columns and their products.

    Attributes:
        centre, scale: (S,) of the columns in training.
        low, high: (S,) their range, beyond which nothing is extrapolated.
        weights: (F,) of the standardised columns, then of their products.
        intercept: mean of the logarithm.
        least, largest: bounds of the logarithm.
        smearing: mean of the errors over that of the exponentials of their expected logarithms
            (Duan 1983).
    """

    centre: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor
    weights: Tensor
    intercept: float
    least: float
    largest: float
    smearing: float

    def expected_error(self, columns: Tensor) -> Tensor:
        """Return the expected relative error (m,) at columns (m, S)."""
        standard = (columns.clamp(self.low, self.high) - self.centre) / self.scale
        logarithm = self.intercept + _add_products(standard) @ self.weights
        return self.smearing * logarithm.clamp(self.least, self.largest).exp()

    @classmethod
    def from_rows(cls, columns: Tensor, relative_error: Tensor) -> RelativeErrorRegression:
        """Fit to columns (n, S) float32, and errors (n,) of rows that a fit did not see; n > 1."""
        from sklearn.linear_model import RidgeCV  # here, as it takes a second to import

        centre, scale = columns.mean(0), columns.std(0, correction=0).clamp_min(LEAST_SCALE)
        terms = _add_products((columns - centre) / scale).double().numpy()
        target = relative_error.clamp_min(LEAST_ERROR).log().double().numpy()
        model = RidgeCV(RIDGES).fit(terms, target)
        # What is regressed goes anywhere beyond its data: answers stay within what training saw.
        least, largest = np.quantile(target, [OUTLIERS, 1 - OUTLIERS])
        # The mean of an error is not the exponential of its logarithm's mean.
        expected = np.exp(model.predict(terms).clip(least, largest))
        smearing = np.exp(target.clip(max=largest)).mean() / expected.mean()
        return cls(
            centre,
            scale,
            columns.amin(0),
            columns.amax(0),
            torch.from_numpy(model.coef_).float(),
            float(model.intercept_),
            float(least),
            float(largest),
            float(smearing),
        )


def _add_products(x: Tensor) -> Tensor:
    """Columns (n, S) and their products, (n, S + S (S + 1) / 2)."""
    first, second = torch.triu_indices(x.shape[1], x.shape[1])
    return torch.cat([x, x[:, first] * x[:, second]], 1)
