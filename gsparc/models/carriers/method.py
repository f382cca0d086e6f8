"""`model=carriers`: spectra at several carriers in one field, which tell of each other at a place.

The mean is what paths found from all spectra together are expected to look like, mixed with the mean image; a
process over places and carriers learns what is left: rows of a place observed at some carriers tell the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.carriers.array import SAME_PLACE, OneArray
from gsparc.models.carriers.geometry import SharedPaths, find_paths
from gsparc.models.method import Prediction
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import distances, matern32
from gsparc.processes.left_out import left_out_residuals, rows_of_groups
from gsparc.processes.neighbourhood import covering_rows
from gsparc.processes.stored import Stored
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

PIXELS = 500  # of an image, that settings are chosen on
LENGTHS = (0.1, 0.2, 0.4, 0.8)  # of the site's diagonal, that are tried
SHARES, NOISES = (0.5, 2.0, 8.0), (0.3, 1.0, 3.0)  # of what the carriers of a place share
NEAR_CARRIERS, OCTAVES = (0.0, 0.5), 1.0  # of the same, what carriers within some octaves share besides
OWN, ALONE = (
    (0.0, 2.0),
    0.2,
)  # of the same, what images have in common within .2 octaves at neighbouring places
NOISES_ALONE = (0.03, 0.1, 0.3, 1.0)  # of carriers that tell nothing of each other
MOST_ROWS, CHOSEN_ON = 4000, 500  # rows that are learned from, and that settings are chosen on


@dataclass(frozen=True)
class Covariance(Stored):
    """Covariance of residual images over places and carriers, in units of the part that a place shares.

    Attributes:
        length: over places [m].
        shared: of what neighbouring places share, at all carriers.
        near: of what near carriers of a place share.
        own: of what neighbouring places share at near carriers alone.
        noise: of each row.
        place: 1; 0 where carriers tell nothing of each other.
        amplitude: of the whole, per pixel.
    """

    length: float
    shared: float
    near: float
    own: float
    noise: float
    place: float = 1.0
    amplitude: float = 1.0

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return covariances (n, m) of rows (n, 4) and (m, 4): places [m], and log2 of carriers."""
        apart = distances(a[:, :3], b[:, :3])
        octaves = (a[:, None, 3] - b[None, :, 3]).abs()
        here, alike = (apart < SAME_PLACE).double(), matern32(octaves, OCTAVES)
        around, own = matern32(apart, self.length), self.own * matern32(octaves, ALONE)
        # Of a carrier alone: its mean image, and what varies over places.
        return self.shared * around + own * (1 + around) + here * (self.place + self.near * alike)

    def gram(self, rows: Tensor) -> Tensor:
        """Return covariances (n, n) of rows (n, 4) with their noise."""
        return self.between(rows, rows) + self.noise * torch.eye(len(rows), dtype=torch.float64)

    @property
    def prior(self) -> float:
        """Variance of a row without noise."""
        return self.shared + 2 * self.own + self.place + self.near


class CarrierField(OneArray):
    """Shared paths, and a process over places and carriers.

    Args:
        name: as it appears in tables.
    """

    effects = "line_of_sight, specular"
    stored = (*OneArray.stored, "paths", "weight", "covariance", "rows", "left")
    paths: SharedPaths
    covariance: Covariance
    _kept: Tensor | None = None

    def __init__(self, name: str = "carriers") -> None:
        self.name = name

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Find planes, then condition a process on what they do not explain.

        Raises:
            ValueError: not spectra of one array at several carriers, or too many.
        """
        watch, known = Stopwatch(), np.concatenate([fold.train, fold.val])
        whole, known = len(known), known[_at_covering_places(data.tx[known], MOST_ROWS)]
        images, groups = self.read_rows(data, known)
        carrier, grid, lags = data.carrier_hz, data.site.grid, self.lags()
        assert carrier is not None and grid is not None
        self.rows = torch.from_numpy(np.c_[data.tx[known], np.log2(carrier[known])])
        power = [images[rows].unflatten(1, (grid.height, grid.width)) ** self.exponent for rows in groups]
        seen = torch.stack([lags.to_lags(one).mean(0) for one in power])
        self.paths = find_paths(lags, seen, self.places, *self.pose())
        expected, which = self.expected(self.paths, self.places) - self.mean, torch.empty(len(known)).long()
        for place, rows in enumerate(groups):
            which[rows] = place
        few, images = _at_covering_places(data.tx[known], CHOSEN_ON), images.sub_(self.mean)
        of_few = rows_of_groups(which[few].numpy())
        self._choose(self.rows[few], images[few], expected[which[few]], of_few)
        left = images.sub_(self.weight * expected[which])
        self._kept, factor = None, Factor.from_gram(self.covariance.gram(self.rows))
        self.left = factor.solve(left.double()).float()
        planes = f"{len(self.paths.planes)} mirror planes, weight of paths {self.weight:.2g}"
        one = self.covariance
        parts = f"shared {one.shared:.3g}, near {one.near:.3g}, own {one.own:.3g}, noise {one.noise:.3g}"
        kernel = f"length {one.length:.3g} m, {parts}" + " (each carrier alone)" * (not one.place)
        notes = [f"{self.name}: {planes}; {kernel}, chosen on left-out places"]
        if len(known) < whole:
            some = f"{len(known)} of {whole} rows are learned from, at places all over the site"
            notes.append(f"{self.name}: {some}")
        return FitReport(watch.seconds, tuple(notes))

    def _choose(self, rows: Tensor, images: Tensor, expected: Tensor, groups: list[Tensor]) -> None:
        """Set the weight of paths and the covariance of least error at places and rows left out."""
        step = max(1, images.shape[1] // PIXELS)
        both = torch.cat([images[:, ::step], expected[:, ::step]], 1).double()
        diagonal = float((rows[:, :3].amax(0) - rows[:, :3].amin(0)).norm()) or 1.0
        best = math.inf
        together = (Covariance(1.0, *one) for one in product(SHARES, NEAR_CARRIERS, OWN, NOISES))
        apart = (Covariance(1.0, 0.0, 0.0, 1.0, noise, place=0.0) for noise in NOISES_ALONE)
        for length, one in product(LENGTHS, (*together, *apart)):
            one = replace(one, length=length * diagonal)
            inverse = Factor.from_gram(one.gram(rows)).inverse
            solved = inverse @ both
            away, variance = left_out_residuals(inverse, solved, groups)
            # Residuals are linear in what is taken off: the best weight is a quotient.
            image, path = away.chunk(2, dim=1)
            weight = float((image * path).sum() / path.square().sum().clamp_min(1e-9))
            weight = min(max(weight, 0.0), 1.0)
            missed = (image - weight * path).square().mean(1)
            image, path = left_out_residuals(inverse, solved)[0].chunk(2, dim=1)
            error = float(missed.mean()) * float((image - weight * path).square().mean())
            if error < best:
                best, self.weight = error, weight
                self.covariance = replace(one, amplitude=float((missed / variance).mean()))

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; `query.station` says which carrier.

        Raises:
            ValueError: it does not.
        """
        site = self.fitted_site
        assert site.stations is not None and site.stations.carrier_hz is not None
        if query.station is None:
            raise ValueError(
                f"{self.name}: which carrier? say station=, one of {', '.join(site.stations.shown)}"
            )
        places, which = torch.unique(query.tx.cpu().double(), dim=0, return_inverse=True)
        octaves = torch.from_numpy(np.log2(site.stations.carrier_hz))[query.station.cpu()]
        cross = self.covariance.between(torch.cat([places[which], octaves[:, None]], 1), self.rows)
        paths = self.expected(self.paths, places) - self.mean
        image = self.mean + self.weight * paths[which] + cross.float() @ self.left
        prior = self.covariance.prior
        certain = (cross @ self._inverse() * cross).sum(1)
        variance = (prior - certain).clamp(0, prior)
        error = self.covariance.amplitude * (variance + self.covariance.noise)
        mean = self.answer_images(image, query)
        return Prediction(mean, error.to(mean.dtype), (variance / prior).to(mean.dtype))

    def count_components(self) -> int:
        """Return the number of mirror planes."""
        return len(self.paths.planes)

    def _inverse(self) -> Tensor:
        if self._kept is None:
            self._kept = Factor.from_gram(self.covariance.gram(self.rows)).inverse
        return self._kept


def _at_covering_places(places: np.ndarray, most: int) -> np.ndarray:
    """Rows (m,) at places (n, 3) spread over all, every row of a place: about so many at most."""
    where, which = np.unique(places, axis=0, return_inverse=True)
    kept = covering_rows(where, max(2, most * len(where) // len(places)), 0)
    return np.flatnonzero(np.isin(which.reshape(-1), kept))
