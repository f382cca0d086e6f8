"""How wrong predictions are on the very band that the link uses, and what confidences say of it."""

from __future__ import annotations

import numpy as np

from gsparc.commands.link.channels import Channels
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.methods.confidence_scores import Evidence, expected_score, rivals
from gsparc.methods.method import Prediction


def on_band(band: Channels, data: Measurements, fold: Fold, rows: np.ndarray) -> Evidence:
    """Evidence of `rows`, whose channels `band` holds: a fade of this band is no fade of another."""
    power = band.true.abs().square().mean((1, 2))
    error = (band.predicted - band.true).abs().square().mean((1, 2)) / power.clamp_min(1e-30)
    said = Prediction(band.predicted, band.confidence, band.variance)
    own = {"learned": band.confidence, "expected": expected_score(said)}
    scores = {kind: s.double().numpy() for kind, s in own.items() if not s.isnan().any()}
    return Evidence(rows, data.moving[rows], error.double().numpy(), scores | rivals(data, fold, rows))
