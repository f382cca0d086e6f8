"""Layers of squares from predicted levels,
their deviations and what held-out rows tell of these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsparc.apps.maps.intervals import IntervalScales
from gsparc.apps.maps.strongest import (
    best_server,
    count_overlap,
    heard_chance,
    outage_probability,
    server_chance,
    sinr,
)
from gsparc.processes.uncertainty import half_width


@dataclass(frozen=True)
class Scoring:
    """What levels of T stations are scored by.

    Attributes:
        scales: of deviations.
        numbers: (T,) of the stations in the model.
        load, carrier: (T,), see `sinr`.
        floor: (T,) levels below which stations are not heard [dB].
        threshold_db: of outage.
        noise_db: see `sinr`.
        loss: (2,) of squares in buildings, and its deviation [dB]; None: none is mapped there.
    """

    scales: IntervalScales
    numbers: np.ndarray
    load: np.ndarray
    carrier: np.ndarray
    floor: np.ndarray
    threshold_db: float
    noise_db: float | None
    loss: np.ndarray | None

    def layers(
        self,
        mean: np.ndarray,
        spread: np.ndarray,
        related: np.ndarray,
        far: np.ndarray,
        indoors: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Return layers (..., n) of squares by name.

        Args:
            mean, spread: (T, n) levels and the model's own deviations [dB].
            related: (T, n) correlation of their errors with the strongest's.
            far: (T, n) distances from what was measured [m].
            indoors: (n,) bool, squares in buildings.
        """
        half, error = self.scales.half_and_error(spread, far, self.numbers[:, None])
        if self.loss is not None and indoors is not None:
            loss, doubt = np.outer(self.loss, indoors)
            wider, strongest = np.hypot(error, doubt), (mean.argmax(0), np.arange(len(indoors)))
            # What is not known of the loss is one error of all stations.
            related = (related * error * error[strongest] + doubt**2) / (wider * wider[strongest])
            mean, half, error = (
                mean - loss,
                np.hypot(half, half_width(self.scales.share) * doubt),
                wider,
            )
        # The strongest before anything is refused, to which `related` is the correlation.
        first, mean = best_server(mean), np.where(np.isfinite(half), mean, np.nan)
        error = np.where(np.isfinite(mean), error, np.nan)
        # To float32 before comparing: what is stored decides the best server.
        power, error = mean.astype(np.float32), error.astype(np.float32)
        best = best_server(power)
        strongest = np.maximum(best, 0), np.arange(len(best))
        below = self.scales.probability_below(self.threshold_db, power[strongest], error[strongest])
        alike = np.where(first == best, np.nan_to_num(related), 0.0)
        return {
            "power_db": power,
            "lower_db": mean - half,
            "upper_db": mean + half,
            "expected_error_db": error,
            "best_server": best,
            "sinr_db": sinr(power, self.load, self.noise_db, self.carrier),
            "server_chance": server_chance(power, error, self.floor, alike),
            "heard_chance": heard_chance(power, error, self.floor),
            "outage": outage_probability(power, error, self.threshold_db, alike, below),
            "overlap": count_overlap(power, self.carrier),
        }
