"""`model=carriers`: spectra at several carriers in one field, which tell of each other at a place.

The mean is what paths found from all spectra together are expected to look like, mixed with the
mean image; a process over places and carriers learns what is left: rows of a place observed at some
carriers tell the rest. Beside it stand processes of each carrier alone, weighed by rows that were
left out. All of it is computed in the strongest principal components of the images.
"""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from torch import Tensor

from gsparc.data.ends import SAME_PLACE_M
from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import principal_components
from gsparc.models.carriers.alone import CarriersAlone
from gsparc.models.carriers.array import OneArray
from gsparc.models.carriers.geometry import SharedPaths, find_paths
from gsparc.models.carriers.joint import Covariance, choose_joint, row_noise
from gsparc.models.method import Prediction
from gsparc.models.stack import error_products, weigh
from gsparc.models.target_rows import training_targets
from gsparc.physics.separable import Separable, separate_axes
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.left_out import rows_of_groups
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

COMPONENTS = 100  # of images: more of them hold under 1e-3 of what varies
# Of the energy of these by numbers of rows and columns; a component that is none
LOST, TINY = 1e-4, 1e-12
MOST_ROWS, CHOSEN_ON = 4000, 500  # rows that are learned from, and that settings are chosen on
COARSE = 24  # rows of pixels, at least, that expected images are computed on


class CarrierField(OneArray):
    """Shared paths, a process over places and carriers, and processes of each carrier alone.

    Args:
        name: as it appears in tables.
    """

    effects = "line_of_sight, specular"
    stored = (
        *OneArray.stored,
        "paths",
        "weight",
        "covariance",
        "rows",
        "left",
        "pixels",
        "middle",
        "axes",
        "lost",
        "alone",
        "shares",
        "carried",
        "noise",
    )
    paths: SharedPaths
    weight: float  # of paths
    covariance: Covariance
    rows: Tensor  # (n, 4) float64, places [m] and log2 of carriers
    left: Tensor  # (n, P) float64, what paths do not explain as weights of the rows' covariances
    # Rows (H, R) and columns (C, W) of images, by whose products are told
    pixels: tuple[Tensor, Tensor]
    middle: Tensor  # (R * C,) the mean image
    axes: Tensor  # (P, R * C) principal components, orthonormal in pixels
    lost: float  # mean square per pixel that the components leave out
    alone: CarriersAlone
    shares: tuple[float, float]  # of `alone` at new places, and at places with rows
    # Share of what is told of a carrier without rows; the rest is the mean image
    carried: float = 1.0
    noise: Tensor | float = 1.0  # (n,) of the rows, of the usual
    _inverse: Tensor | None = None
    # The mean (p,) and what gives components (p, P) of pixels
    _thin: tuple[Tensor, Tensor] | None = None

    def __init__(self, name: str = "carriers") -> None:
        self.name = name

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Find planes, then condition processes on what they do not explain.

        Raises:
            ValueError: not spectra of one array at several carriers.
        """
        watch, fit_rows = Stopwatch(), fold.learned()
        whole, fit_rows = len(fit_rows), fit_rows[_at_covering_places(data.tx[fit_rows], MOST_ROWS)]
        images, groups = self.read_rows(data, fit_rows)
        carrier, grid, lags = data.carrier_hz, data.site.grid, self.lags()
        assert carrier is not None and grid is not None
        power = [
            images[rows].unflatten(1, (grid.height, grid.width)) ** self.exponent for rows in groups
        ]
        seen = torch.stack([lags.to_lags(powers).mean(0) for powers in power])
        self.paths = find_paths(lags, seen, self.places, *self.pose())
        few = _at_covering_places(data.tx[fit_rows], CHOSEN_ON)
        targets = training_targets(data, fit_rows[few])
        axes = torch.from_numpy(principal_components(targets, data.site.target, COMPONENTS).axes)
        images.sub_(self.mean)
        values = (images @ axes.T).double()
        size = values.square().mean(0).sqrt().float()[:, None].clamp_min(TINY)
        basis, self.middle, sized = separate_axes(
            self.mean, axes * size, (grid.height, grid.width), LOST
        )
        self.axes, self.pixels = sized / size, (basis.rows, basis.columns)
        beyond = float(images.square().sum(dtype=torch.float64)) - float(values.square().sum())
        self.lost = max(beyond, 0.0) / images.numel()

        self.rows = torch.from_numpy(np.c_[data.tx[fit_rows], np.log2(carrier[fit_rows])])
        place, station = (
            torch.empty(len(fit_rows)).long(),
            torch.from_numpy(data.stations_of(fit_rows)),
        )
        for number, rows in enumerate(groups):
            place[rows] = number
        self._inverse = self._thin = None
        paths = self._expected_values(self.places)[place]
        self.noise = noise = row_noise(values, groups)
        self._choose(values[few], paths[few], noise[few], place[few], station[few], few)
        factor = Factor.from_gram(self.covariance.gram(self.rows, self.noise))
        self.left = factor.solve(values - self.weight * paths)
        self.alone = self.alone.condition(self.rows[:, :3], values, station)
        planes = f"{len(self.paths.planes)} mirror planes, weight of paths {self.weight:.2g}"
        planes = planes if self.weight else "paths explain nothing here"
        shares = ("{:.0%} of new places and {:.0%} of known ones by carriers alone").format(
            *self.shares
        )
        shares += f", {self.carried:.0%} of it for carriers without rows"
        chosen = f"{planes}; {self.covariance.description}; {shares}, chosen on rows left out"
        notes = [f"{self.name}: {chosen}"]
        if len(fit_rows) < whole:
            some = f"{len(fit_rows)} of {whole} rows are learned from, at places all over the site"
            notes.append(f"{self.name}: {some}")
        return FitReport(watch.seconds, tuple(notes))

    def _choose(
        self,
        values: Tensor,
        paths: Tensor,
        noise: Tensor,
        place: Tensor,
        station: Tensor,
        rows: np.ndarray,
    ) -> None:
        """Set settings by some rows (n,) whose places and carriers (n,) are numbered."""
        at, count, entries = self.rows[rows], len(self._stations), len(self.mean)
        places, carriers = (rows_of_groups(numbers.numpy()) for numbers in (place, station))
        joint = choose_joint(at, values, paths, noise, places, carriers, entries)
        self.covariance, self.weight = joint.covariance, joint.weight
        self.alone = CarriersAlone.learn(at[:, :3], values, station, count, entries)
        has_process = self.alone.has_process(station)
        missed, unit = self.alone.left_out(station)[has_process], place[has_process]
        new, seen = (
            _share_of_second(unexplained[has_process], missed, unit)
            for unexplained in (joint.new, joint.seen)
        )
        self.shares = new, seen
        # One carrier alone tells nothing of others.
        several = len(station.unique()) > 1
        self.carried = _share_of_second(values, joint.carrier, station) if several else 1.0

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; `query.station` says which carrier.

        Raises:
            ValueError: it does not.
        """
        if query.station is None:
            names = ", ".join(self._stations.shown)
            raise ValueError(f"{self.name}: which carrier? say station=, one of {names}")
        station, at = query.station.cpu(), query.tx.cpu().double()
        places, which = torch.unique(at, dim=0, return_inverse=True)
        carrier = self._stations.carrier_hz
        assert carrier is not None
        rows = torch.cat([at, torch.from_numpy(np.log2(carrier))[station][:, None]], 1)
        cross, covariance = self.covariance.between(rows, self.rows), self.covariance
        value = cross @ self.left
        if self.weight:  # else the paths, which are most of a query, explain nothing
            value = value + self.weight * self._expected_values(places)[which]
        measured = self.alone.has_process(station)
        value = torch.where(measured[:, None], value, self.carried * value)
        variance = (covariance.prior - (cross @ self._inverse_of_rows() * cross).sum(1)).clamp(
            0, covariance.prior
        )
        unknown, error = (
            variance / covariance.prior,
            covariance.amplitude * (variance + covariance.noise),
        )
        near = torch.cdist(places, self.places).amin(1)[which] < SAME_PLACE_M
        share = torch.tensor(self.shares, dtype=torch.float64)[near.long()] * measured
        if share.any():
            mean, carrier_error = (part.nan_to_num() for part in self.alone.answer(at, station))
            spread = (mean - value).square().sum(1) / len(self.mean)
            value = value.lerp(mean, share[:, None])
            # Law of total variance
            error = error.lerp(carrier_error, share) + share * (1 - share) * spread
        image = Separable(*self.pixels).images(torch.addmm(self.middle, value.float(), self.axes))
        image = self.answer_images(image.flatten(1), query)
        return Prediction(image, (error + self.lost).to(image.dtype), unknown.to(image.dtype))

    def add_carrier(self, frequency_hz: float) -> Self:
        """See `AddsCarriers`."""
        self._inverse_of_rows()  # which the copies share: else each would make its own
        result = super().add_carrier(frequency_hz)
        result.alone = self.alone.add_unknown()
        return result

    def _inverse_of_rows(self) -> Tensor:
        """Inverse (n, n) of the rows' covariance, made once."""
        if self._inverse is None:
            self._inverse = Factor.from_gram(self.covariance.gram(self.rows, self.noise)).inverse
        return self._inverse

    def count_components(self) -> int:
        """Return the number of mirror planes."""
        return len(self.paths.planes)

    @property
    def stride(self) -> int:
        """See `OneArray`: an array of few elements sees nothing finer."""
        grid = self.fitted_site.grid
        assert grid is not None
        return next(
            (
                value
                for value in (4, 3, 2)
                if not grid.width % value and grid.height >= value * COARSE
            ),
            1,
        )

    def _expected_values(self, places: Tensor) -> Tensor:
        """Components (n, P) float64 of what paths to places (n, 3) are expected to look like."""
        if self._thin is None:
            some = Separable(*self.pixels).subsample_pixels(self.stride)
            mean, axes = (
                some.images(images).flatten(1) for images in (self.middle[None], self.axes)
            )
            self._thin = mean[0], torch.linalg.pinv(axes)
        mean, to_values = self._thin
        return ((self.expected(self.paths, places) - mean) @ to_values).double()


def _share_of_second(first: Tensor, second: Tensor, unit: Tensor) -> float:
    """Weight of the second of two predictions by errors (n, P) of rows of units (n,);
    0 without rows.
    """
    if not len(unit):
        return 0.0
    products = error_products([first, second], torch.zeros_like(first))
    return float(weigh(products, unit.numpy(), "log", sure=0.0)[1])


def _at_covering_places(places: np.ndarray, most: int) -> np.ndarray:
    """Rows (m,) at places (n, 3) spread over all, every row of a place: about so many at most."""
    where, which = np.unique(places, axis=0, return_inverse=True)
    place_numbers = covering_rows(where, max(2, most * len(where) // len(places)), 0)
    return np.flatnonzero(np.isin(which.reshape(-1), place_numbers))
