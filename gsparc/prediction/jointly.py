"""Levels of several places or stations together, with the covariance of their errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsparc.models.abilities import HasJoint, HasProcess, JointLevels
from gsparc.models.station_views import OneStationView
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.query import Asked

TOGETHER, UNREAD = 64, 1e12  # places at a time; variance of what is not measured [dB^2]


class JointMixin(Asked):
    """What a `Predictor` of powers says of several places or stations at once."""

    def predict_joint(self, places: Any, stations: Any) -> JointLevels | None:
        """Return levels with the covariances of their errors, float64.

        Levels are in decibels of `site.level_unit`, the rest [dB^2]. None: nothing is known of how
        levels of stations go together.

        Args:
            places: (G, 3) of the moving end, world [m]; (G, k, 3): one for each of `stations`.
            stations: (k,) numbers.
        """
        method = self.method.joint_method()
        return (
            None
            if method is None
            else self._predict_levels(method, places, torch.as_tensor(stations))
        )

    def predict_new(
        self, places: Any, station: Any, sectors: Any, like: int | None = None
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return levels (G, k) and deviations [dB] of k sectors that are not there yet,
        see `predict_joint`.

        Args:
            places: (G, 3) of the moving end, world [m].
            station: (3,) where they are to stand, world [m].
            sectors: (k, 5) azimuth from north, -1 without a pattern, tilt, widths across and in
                height [deg], and power over the mean of those that stand [dB].
            like: number of a station of their band; None: of the first.
        """
        if (joint_method := self.method.joint_method()) is None:
            return None
        still = np.asarray(station, np.float64) - self.site.origin
        more = joint_method.add_station(still, torch.as_tensor(sectors, dtype=torch.float64), like)
        new = len(self.site.every_station) + torch.arange(len(sectors))
        level, covariance, _ = self._predict_levels(more, places, new)
        return level, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))

    def noise_by_others(self, places: Any, stations: Any, listed: np.ndarray) -> np.ndarray:
        """Return variances (G, k) that a measured place lacks
        of what measuring each station tells [dB^2].

        Infinite of a station that neither the place lists nor others tell of;
        below 0 where others tell more.

        Args:
            places, stations: see `predict_joint`.
            listed: (G, k) bool, stations that are measured.
        """
        more = np.where(listed, 0, np.inf)
        for part in np.array_split(np.arange(len(places)), len(places) // TOGETHER + 1):
            if (joint := self.predict_joint(places[part], stations)) is not None:
                field = joint.covariance - np.diag(joint.noise)
                read = (
                    field
                    + np.eye(len(stations)) * np.where(listed[part], joint.noise, UNREAD)[:, None]
                )
                reduction = field @ np.linalg.solve(read, field)
                variance, reduction = (
                    matrices.diagonal(axis1=1, axis2=2) for matrices in (field, reduction)
                )
                noise = variance * (variance - reduction) / np.maximum(reduction, 1 / UNREAD)
                # k stations tell as much as k measurements of one at best.
                more[part] = np.maximum(noise, joint.noise / len(stations)) - joint.noise
        return more

    def _predict_levels(self, known: HasJoint, places: Any, stations: torch.Tensor) -> JointLevels:
        moving = torch.from_numpy(np.asarray(places, np.float64) - self.site.origin)
        if moving.dim() == 2:
            moving = moving[:, None].expand(-1, len(stations), 3)
        level, covariance, noise = (part.numpy() for part in known.predict_joint(moving, stations))
        return JointLevels(level + to_decibels(self.site.target_scale), covariance, noise)

    def covariance(self, tx: Any = None, rx: Any = None) -> tuple[np.ndarray, float]:
        """Return the covariance (B, B) of the power's errors at B places,
        and a measurement's noise [dB^2].

        Of several stations of one of them, see `Predictor.select_station`.

        >>> covariance, noise = predictor.covariance(rx=[[2.0, 1.0, 1.5], [3.0, 1.0, 1.5]])
        >>> covariance.shape, bool(covariance[0, 1] < covariance[0, 0]), noise > 0
        ((2, 2), True, True)

        Samples of the field at these places together, for the risk of what is decided by it:

        >>> level = predictor.rssi(rx=[[2.0, 1.0, 1.5], [3.0, 1.0, 1.5]])[:, 0]
        >>> np.random.default_rng(0).multivariate_normal(level, covariance, 100).shape
        (100, 2)

        Raises:
            ValueError: the model states none.
        """
        query = self.queries.query(tx, rx, torch.float64).of_one()
        places = query.places(self.site)
        joint_method = self.method.joint_method()
        if isinstance(self.method, OneStationView) and joint_method is not None:
            station = torch.full((len(places),), self.method.number)
            _, covariance, noise = joint_method.predict_joint(places[None], station)
            return (covariance[0] - noise.diag()).numpy(), float(noise[0])
        process = self.method.process() if isinstance(self.method, HasProcess) else None
        if process is None:
            raise ValueError(
                f"covariance: {self.method.name} states none of errors; model=gp of powers does"
            )
        # Who learned all stations together tells them by their places:
        # there both ends are a query's.
        places = query.places(getattr(self.method, "site", None) or self.site)
        return process.covariance(places).numpy(), process.noise
