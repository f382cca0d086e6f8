"""What spectra of one array at several carriers have in common, whatever is learned of them."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from gsparc.data.ends import SAME_PLACE_M
from gsparc.data.query import Query
from gsparc.data.schema import LIGHT, Measurements, Site, Stations
from gsparc.data.splits import Fold
from gsparc.models.carriers.geometry import ExpectedSpectra, SharedPaths
from gsparc.models.method import Method
from gsparc.models.reduced import coarsen_grid
from gsparc.models.target_rows import training_targets
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.physics.lags import SpectrumLags, pixel_exponent
from gsparc.processes.left_out import rows_of_groups
from gsparc.training.context import FitContext


def carriers_obstacle(site: Site) -> str | None:
    """Return why spectra of this site are not those of one array at several carriers;
    None where they are.
    """
    stations = site.every_station
    if not site.target.is_image or stations.carrier_hz is None:
        return "targets are no spectra at several carriers"
    if site.static_end != "rx" or np.ptp(stations.position, axis=0).max() > SAME_PLACE_M:
        return "receivers at several places"
    turned = stations.rotation
    if turned is not None and not np.allclose(turned, turned[0], atol=1e-6):
        return "receivers turned differently"
    if site.array is None or site.grid is None or len(site.array) < 2:
        return "the array is unknown"
    relative = _arrays(site) / (LIGHT / stations.carrier_hz)[:, None, None]
    return (
        None
        if np.allclose(relative, relative[0], atol=1e-3)
        else ("carriers see through different arrays")
    )


def _arrays(site: Site) -> np.ndarray:
    """Elements (T, M, 3) [m] of the array at each carrier."""
    assert site.array is not None
    elements = site.every_station.array
    return (
        np.repeat(site.array[None], len(site.every_station), axis=0)
        if elements is None
        else elements
    )


class OneArray(Method):
    """A method of spectra at several carriers, of which one array, alike in wavelengths,
    saw all.
    """

    stored: ClassVar[tuple[str, ...]] = ("exponent", "places", "mean")
    both_ends = True
    no_gradient = "what is nearest changes in jumps"
    exponent: int  # of a pixel that is its power
    places: Tensor  # (n, 3) float64 [m], local, of training rows, each once
    mean: Tensor  # (H * W,) of all training rows

    @classmethod
    def stands_beside(cls, data: Measurements, fold: Fold) -> bool:
        """See `MethodFactory.stands_beside`: of one array at several carriers."""
        return carriers_obstacle(data.site) is None

    _spectra: ExpectedSpectra | None = None

    def learns_jointly(self, site: Site) -> bool:
        """See `MethodFactory`."""
        return carriers_obstacle(site) is None

    def choose_stations(
        self, data: Measurements, fold: Fold, context: FitContext
    ) -> tuple[Literal["each", "together"], str]:
        """See `MethodFactory`."""
        return "together", "carriers at one place have the same paths"

    def read_rows(self, data: Measurements, rows: np.ndarray) -> tuple[Tensor, list[Tensor]]:
        """Return images (n, H * W) of rows (n,), and which of them are of each place.

        Raises:
            ValueError: not spectra of one array at several carriers.
        """
        problem = carriers_obstacle(data.site)
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        self.site, self._spectra = data.site, None
        images = torch.from_numpy(data.site.target.to_real(training_targets(data, rows)))
        self.places, which = torch.unique(
            torch.from_numpy(data.tx[rows]), dim=0, return_inverse=True
        )
        few = images[:: max(1, len(images) // 16)].unflatten(1, data.target.shape[1:])
        self.exponent, self.mean = pixel_exponent(self.lags(), few)[0], images.mean(0)
        return images, rows_of_groups(which.numpy())

    def answer_images(self, images: Tensor, query: Query) -> Tensor:
        """Return images (B, H * W) as targets (B, H, W), in the query's precision."""
        grid = self.fitted_site.grid
        assert grid is not None
        return images.clamp(0, 1).unflatten(1, (grid.height, grid.width)).to(query.tx.dtype)

    def add_carrier(self, frequency_hz: float) -> Self:
        """See `AddsCarriers`."""
        result = copy(self)
        result.site = replace(self.fitted_site, stations=self._stations.add_carrier(frequency_hz))
        return result

    @property
    def _stations(self) -> Stations:
        return self.fitted_site.every_station

    def pose(self) -> tuple[Tensor, Tensor]:
        """Return place (3,) float64 [m] and rotation (3, 3) of the receiver."""
        stations, turned = self._stations, self.fitted_site.rx_rotation
        rotation = stations.rotation[0] if stations.rotation is not None else turned
        turned = np.eye(3) if rotation is None else rotation
        return torch.from_numpy(stations.position[0]), torch.from_numpy(
            np.asarray(turned, np.float64)
        )

    def array(self) -> tuple[np.ndarray, float]:
        """Return elements (M, 3) [m] at the first carrier, and its wavelength [m]."""
        carrier = self._stations.carrier_hz
        assert carrier is not None
        return _arrays(self.fitted_site)[0], LIGHT / float(carrier[0])

    def lags(self) -> SpectrumLags:
        """Return the array's lags."""
        array, wavelength = self.array()
        assert self.fitted_site.grid is not None
        return SpectrumLags(array, self.fitted_site.grid, wavelength)

    @property
    def stride(self) -> int:
        """Rows and columns of pixels per one that `expected` computes."""
        return 1

    def expected(self, paths: SharedPaths, places: Tensor) -> Tensor:
        """Return mean images (n, pixels) of the paths to places (n, 3),
        every `stride`-th row and column.
        """
        if self._spectra is None:
            (array, wavelength), grid = self.array(), self.fitted_site.grid
            assert grid is not None
            grid = coarsen_grid(grid, self.stride)
            renderer = SpectrumRenderer(
                array, grid, wavelength, torch.zeros(grid.height, grid.width)
            )
            turns = torch.from_numpy(2 * np.pi / wavelength * array).float()
            how = self.fitted_site.normalisation
            self._spectra = ExpectedSpectra(renderer, turns, how, self.exponent)
        return self._spectra(paths.ways(places)[0], paths.powers(places))
