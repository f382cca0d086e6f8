"""A trained method seen through settings that spare something: it answers, and does nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.method import FitReport, Method, Prediction
from gsparc.ops import Pose


class View(Method):
    """Answers for `inner`; the whole method is what is trained and stored.

    Args:
        inner: fitted.
    """

    def __init__(self, inner: Method) -> None:
        self.inner, self.name = inner, inner.name

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        return self.inner.predict(tx, rx)

    def size(self) -> int:
        """As the inner method's."""
        return self.inner.size()

    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Refused: `TypeError`."""
        raise TypeError("a view of a trained method is not trained")

    def state(self) -> dict[str, Any]:
        """Refused: `TypeError`."""
        raise TypeError("a view of a trained method is not stored")

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """Refused: `TypeError`."""
        raise TypeError("a view of a trained method is not stored")


class MeanOnly(View):
    """Leaves confidence and variance out of the answer."""

    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the mean alone."""
        return Prediction(self.inner.predict(tx, rx).mean)
