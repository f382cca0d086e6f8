"""Ridge regression from the uplink's tones to the downlink's: one linear map,
learned from all places.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.method import Prediction
from gsparc.models.uplink.interface import UplinkMethod, mean_power, root_mean_power
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

PENALTIES = (10.0 ** np.arange(-6, 1)).tolist()  # of the Gram matrix's mean diagonal


class Ridge(UplinkMethod):
    """Complex ridge regression; penalty and scaling are chosen on validation rows,
    then both are learned.

    Args:
        inputs: `own`: each antenna's downlink from its own uplink (26 to 26); `all`: from all
            antennas'.
    """

    name = "ridge"
    baseline_order = 110
    stored = ("maps", "unit", "inputs")

    @classmethod
    def stands_beside(cls, data: Measurements, fold: Fold) -> bool:
        """See `MethodFactory.stands_beside`: of a band beside another."""
        return data.uplink is not None

    def __init__(self, inputs: Literal["own", "all"] = "own") -> None:
        if inputs not in ("own", "all"):
            raise ValueError(f"ridge: inputs={inputs!r} is none of own, all")
        self.inputs = inputs

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Solve the normal equations for each penalty and scaling, keep what validates best."""
        started = Stopwatch()
        self.site = self._require_uplink(data)
        best: tuple[float, float, bool] | None = None
        for unit in (True, False):
            normal = self._normal_equations(data, fold.train, unit)
            for penalty in PENALTIES:
                self.maps, self.unit = _solve_ridge(*normal, penalty), unit
                batch = data.batch(fold.val if len(fold.val) else fold.train)
                miss = self.predict(batch).mean - batch.target
                # Mean of logarithms: a few channels in deep fades would decide a mean of ratios.
                value = float((mean_power(miss) / mean_power(batch.target)).log10().mean())
                if best is None or value < best[0]:
                    best = value, penalty, unit
        assert best is not None
        # Validation rows chose the penalty, and are learned from after that.
        learned = fold.learned()
        self.unit = best[2]
        self.maps = _solve_ridge(*self._normal_equations(data, learned, self.unit), best[1])
        note = f"ridge: penalty {best[1]:g}, rows {'of unit power' if best[2] else 'as they are'}"
        return FitReport(started.seconds, (note,))

    def _normal_equations(
        self, data: Measurements, rows: np.ndarray, unit: bool
    ) -> tuple[Tensor, Tensor]:
        """Gram matrices (M, F, F) and products with the targets (M, F, O)."""
        batch = data.batch(rows)
        assert batch.uplink is not None
        scale = root_mean_power(batch.uplink) if unit else torch.ones(len(rows))
        targets = batch.target.flatten(1)[:, None] if self.inputs == "all" else batch.target
        x = (self._inputs(batch.uplink) / scale[:, None, None]).transpose(0, 1)
        y = (targets / scale[:, None, None]).transpose(0, 1)
        adjoint = x.transpose(1, 2).conj()
        return adjoint @ x, adjoint @ y

    def _inputs(self, uplink: Tensor) -> Tensor:
        """(B, M, F): M maps of F inputs each."""
        return uplink.flatten(1)[:, None] if self.inputs == "all" else self.select_antennas(uplink)

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; of the uplink alone."""
        mean = torch.einsum("bmf,mfo->bmo", self._inputs(self.query_uplinks(query)), self.maps)
        assert self.site is not None and self.site.antennas is not None
        return Prediction(mean.reshape(len(query), len(self.site.antennas), -1))


def _solve_ridge(gram: Tensor, product: Tensor, penalty: float) -> Tensor:
    level = torch.diagonal(gram, dim1=1, dim2=2).real.mean(1)
    level = torch.where(level > 0, penalty * level, 1.0)  # a dead antenna has nothing to solve for
    ridge = level[:, None, None] * torch.eye(gram.shape[1])
    return torch.linalg.solve(gram + ridge, product)
