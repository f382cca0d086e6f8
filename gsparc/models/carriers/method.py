"""`model=carriers`: spectra at several carriers in one field, which tell of each other at a place.

The mean is what paths found from all spectra together are expected to look like, mixed with the mean image; a
process over places and carriers learns what is left: rows of a place observed at some carriers tell the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import LIGHT, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.carriers.geometry import ExpectedSpectra, SharedPaths, find_paths
from gsparc.models.method import Method, Prediction
from gsparc.models.target_rows import training_targets
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.physics.lags import SpectrumLags, pixel_exponent
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import distances, matern32
from gsparc.processes.left_out import left_out_residuals, rows_of_groups
from gsparc.processes.stored import Stored, from_plain, to_plain
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

PIXELS = 1000  # of an image, that settings are chosen on
LENGTHS, SHARES, NOISES = (
    (0.1, 0.2, 0.4, 0.8),
    (0.1, 0.5, 2.0),
    (0.3, 1.0),
)  # of the site's diagonal; of the prior
NEAR_CARRIERS = (0.0, 0.5)  # of the prior, that carriers within `OCTAVES` share
OCTAVES = 1.0
SAME_PLACE = 1e-3  # [m]
MOST_ROWS = 4000


def carriers_obstacle(site: Site) -> str | None:
    """Return why spectra of this site are not those of one array at several carriers; None where they are."""
    stations = site.stations
    if site.kind != "spectrum" or stations is None or stations.carrier_hz is None:
        return "targets are no spectra at several carriers"
    if site.static_end != "rx" or np.ptp(stations.position, axis=0).max() > SAME_PLACE:
        return "receivers at several places"
    turned = stations.rotation
    if turned is not None and not np.allclose(turned, turned[0], atol=1e-6):
        return "receivers turned differently"
    if site.array is None or site.grid is None or len(site.array) < 2:
        return "the array is unknown"
    relative = _arrays(site) / (LIGHT / stations.carrier_hz)[:, None, None]
    return None if np.allclose(relative, relative[0], atol=1e-3) else "carriers see through different arrays"


def _arrays(site: Site) -> np.ndarray:
    """Elements (T, M, 3) [m] of the array at each carrier."""
    assert site.stations is not None and site.array is not None
    own = site.stations.array
    return np.repeat(site.array[None], len(site.stations), axis=0) if own is None else own


@dataclass(frozen=True)
class Covariance(Stored):
    """Covariance of residual images over places and carriers, in units of the part that a place shares.

    Attributes:
        length: over places [m].
        shared: of what neighbouring places share, at all carriers.
        near: of what near carriers of a place share.
        noise: of each row.
        amplitude: of the whole, per pixel.
    """

    length: float
    shared: float
    near: float
    noise: float
    amplitude: float = 1.0

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return covariances (n, m) of rows (n, 4) and (m, 4): places [m], and log2 of carriers."""
        apart = distances(a[:, :3], b[:, :3])
        octaves = (a[:, None, 3] - b[None, :, 3]).abs()
        here = (apart < SAME_PLACE).double()
        return self.shared * matern32(apart, self.length) + here * (
            1 + self.near * matern32(octaves, OCTAVES)
        )

    @property
    def prior(self) -> float:
        """Variance of a row without noise."""
        return self.shared + 1 + self.near


class CarrierField(Method):
    """Shared paths, and a process over places and carriers.

    Args:
        name: as it appears in tables.
    """

    effects = "line_of_sight, specular"
    both_ends = True
    no_gradient = "mirror images are weighed by the nearest places, which change in jumps"
    stored = ("paths", "weight", "covariance", "rows", "mean", "left", "exponent", "found")
    paths: SharedPaths
    covariance: Covariance

    def __init__(self, name: str = "carriers") -> None:
        self.name = name
        self._spectra: ExpectedSpectra | None = None

    def learns_jointly(self, site: Site) -> bool:
        """See `MethodFactory`."""
        return carriers_obstacle(site) is None

    def choose_stations(self, data: Measurements, fold: Fold, context: FitContext) -> Any:
        """See `MethodFactory`."""
        return "together", "carriers at one place have the same paths"

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Find planes, then condition a process on what they do not explain.

        Raises:
            ValueError: not spectra of one array at several carriers, or too many.
        """
        watch, known = Stopwatch(), np.concatenate([fold.train, fold.val])
        problem = carriers_obstacle(data.site)
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        if len(known) > MOST_ROWS:
            raise ValueError(
                f"{self.name}: {len(known)} rows are more than {MOST_ROWS}; split.train_count=N thins"
            )
        self.site, self._spectra = data.site, None
        images = torch.from_numpy(data.site.target.to_real(training_targets(data, known)))
        carrier = data.carrier_hz
        assert carrier is not None
        at = torch.from_numpy(np.c_[data.tx[known], np.log2(carrier[known])])
        self.rows, self.mean = at, images.mean(0)
        places, which = torch.unique(at[:, :3], dim=0, return_inverse=True)
        groups = rows_of_groups(which.numpy())
        lags, shape = self._lags(), tuple(data.target.shape[1:])
        some = images[:: max(1, len(images) // 16)].reshape(-1, *shape)
        self.exponent, _ = pixel_exponent(lags, some)
        seen = torch.stack(
            [lags.to_lags(images[g].reshape(-1, *shape) ** self.exponent).mean(0) for g in groups]
        )
        receiver, turned = (torch.from_numpy(np.asarray(v)).double() for v in self._pose())
        self.paths = find_paths(lags, seen, places, receiver, turned)
        expected = self._expected(places) - self.mean
        self._choose(images - self.mean, expected[which], groups)
        factor = Factor.from_gram(self._gram(self.covariance))
        left = images - self.mean - self.weight * expected[which]
        self.left = factor.solve(left.double()).float()
        self.found = len(places)
        planes = f"{len(self.paths.planes)} mirror planes, weight of paths {self.weight:.2g}"
        one = self.covariance
        kernel = (
            f"length {one.length:.3g} m, shared {one.shared:.3g}, near {one.near:.3g}, noise {one.noise:.3g}"
        )
        return FitReport(watch.seconds, (f"{self.name}: {planes}; {kernel}, chosen on left-out places",))

    def _choose(self, images: Tensor, expected: Tensor, groups: list[Tensor]) -> None:
        """Set the weight of paths and the covariance of least error at places and rows left out."""
        step = max(1, images.shape[1] // PIXELS)
        both = torch.cat([images[:, ::step], expected[:, ::step]], 1).double()
        diagonal = float((self.rows[:, :3].amax(0) - self.rows[:, :3].amin(0)).norm()) or 1.0
        best = math.inf
        for length, shared, near, noise in product(LENGTHS, SHARES, NEAR_CARRIERS, NOISES):
            one = Covariance(length * diagonal, shared, near, noise)
            inverse = Factor.from_gram(self._gram(one)).inverse
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
        assert site.stations is not None and site.stations.carrier_hz is not None and site.grid is not None
        if query.station is None:
            raise ValueError(
                f"{self.name}: which carrier? say station=, one of {', '.join(site.stations.shown)}"
            )
        places, which = torch.unique(query.tx.cpu().double(), dim=0, return_inverse=True)
        octaves = torch.from_numpy(np.log2(site.stations.carrier_hz))[query.station.cpu()]
        cross = self.covariance.between(torch.cat([places[which], octaves[:, None]], 1), self.rows)
        paths = self._expected(places) - self.mean
        image = self.mean + self.weight * paths[which] + cross.float() @ self.left
        prior = self.covariance.prior
        certain = (cross @ self._inverse() * cross).sum(1)
        variance = (prior - certain).clamp(0, prior)
        error = self.covariance.amplitude * (variance + self.covariance.noise)
        mean = image.clamp(0, 1).reshape(-1, site.grid.height, site.grid.width).to(query.tx.dtype)
        return Prediction(mean, error.to(mean.dtype), (variance / prior).to(mean.dtype))

    def count_components(self) -> int:
        """Return the number of mirror planes."""
        return len(self.paths.planes)

    def state(self) -> dict[str, Any]:
        """Return what was found and conditioned on."""
        return {name: to_plain(getattr(self, name)) for name in self.stored}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self._spectra, self._kept = site, None, None
        for name in self.stored:
            setattr(self, name, from_plain(state[name]))

    _kept: Tensor | None = None

    def _inverse(self) -> Tensor:
        if self._kept is None:
            self._kept = Factor.from_gram(self._gram(self.covariance)).inverse
        return self._kept

    def _gram(self, one: Covariance) -> Tensor:
        return one.between(self.rows, self.rows) + one.noise * torch.eye(len(self.rows), dtype=torch.float64)

    def _pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Place (3,) [m] and rotation (3, 3) of the receiver."""
        stations, turned = self.fitted_site.stations, self.fitted_site.rx_rotation
        assert stations is not None
        rotation = stations.rotation[0] if stations.rotation is not None else turned
        return stations.position[0], np.eye(3) if rotation is None else rotation

    def _array(self) -> tuple[np.ndarray, float]:
        """Elements (M, 3) [m] at the first carrier, and its wavelength [m]."""
        stations = self.fitted_site.stations
        assert stations is not None and stations.carrier_hz is not None
        return _arrays(self.fitted_site)[0], LIGHT / float(stations.carrier_hz[0])

    def _lags(self) -> SpectrumLags:
        array, wavelength = self._array()
        assert self.fitted_site.grid is not None
        return SpectrumLags(array, self.fitted_site.grid, wavelength)

    def _expected(self, places: Tensor) -> Tensor:
        """Mean images (n, P) of the paths to places (n, 3)."""
        if self._spectra is None:
            (array, wavelength), grid = self._array(), self.fitted_site.grid
            assert grid is not None
            renderer = SpectrumRenderer(array, grid, wavelength, torch.zeros(grid.height, grid.width))
            turns = torch.from_numpy(2 * np.pi / wavelength * array).float()
            how = self.fitted_site.normalisation
            self._spectra = ExpectedSpectra(renderer, turns, how, self.exponent)
        return self._spectra(self.paths.ways(places)[0], self.paths.powers(places))
