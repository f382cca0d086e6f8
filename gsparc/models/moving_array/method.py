"""`model=moving_array`: sources, their powers as smooth trends,
a Gaussian process on residual spectra.

The trend moves directions of arrival with the receiver, which interpolating images cannot; the
residual goes to a Gaussian process on images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.interpolation import Differentiable
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import Method, Prediction
from gsparc.models.moving_array.error_regression import fit_errors, image_features
from gsparc.models.moving_array.power_gp import PowerTrend, TrendSettings, fit_trend
from gsparc.models.moving_array.query import ImageRenderer, ReceivingArray, ReducedMean
from gsparc.models.moving_array.residual import Residual, error_and_likeliest_kernel, fit_residual
from gsparc.models.moving_array.triangulate import (
    MAX_UNEXPLAINED,
    SearchSettings,
    find_sources,
    nonnegative_powers,
    site_problem,
)
from gsparc.models.predicting import to_double
from gsparc.models.reduced import Interpolated, Settings
from gsparc.models.target_rows import heard_rows, training_targets
from gsparc.physics.lags import BLOCK, SpectrumLags, pixel_exponent
from gsparc.physics.separable import Separable, fit_separable
from gsparc.processes.kernel import Kernel
from gsparc.training.context import FitContext, FitReport

UNRESOLVED = 2e-4  # of the images' energy, that the basis of the residual leaves out per mode


@dataclass(frozen=True)
class Spectra:
    """Training spectra as few numbers.

    Attributes:
        places: (n, 3) float64 [m].
        lags: (n, Q) of their powers.
        values: (n, R) of their pixels in the residual's basis.
    """

    places: np.ndarray
    lags: Tensor
    values: Tensor

    @property
    def receivers(self) -> Tensor:
        """Return places (n, 3) float32 [m]."""
        return torch.from_numpy(self.places).float()

    def subset(self, rows: np.ndarray) -> Spectra:
        """Return some of them."""
        return Spectra(self.places[rows], self.lags[rows], self.values[rows])


class MovingArrayField(Differentiable, ClosedForm):
    """Triangulated sources seen through the receiver's array,
    and a Gaussian process on the residual images.

    Args:
        search: how sources are found.
        trend: how smooth their powers are.
        rest_rows: that the residual's kernel is chosen on; seconds grow with their cube.
        components: largest number of principal components of the residual; 0: the trends alone.
        seed: of the search.
        name: as it appears in tables.
    """

    effects = "moving_array"
    stored = ("found", "exponent", "residual", "positions", "errors")
    takes_effort = True
    found: PowerTrend  # sources and their powers

    def __init__(
        self,
        search: SearchSettings = SearchSettings(),
        trend: TrendSettings = TrendSettings(),
        rest_rows: int = 1500,
        components: int = 512,
        seed: int = 0,
        name: str = "moving_array",
    ) -> None:
        super().__init__()
        if rest_rows < 3:
            raise ValueError(f"{name}: model.rest_rows={rest_rows}: expected at least 3")
        self.search, self.trend = search, trend
        self.rest_rows, self.components = rest_rows, components
        self.seed, self.name = seed, name
        self.rows = np.zeros(0, np.int64)  # that it was conditioned on; none where it was restored

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Find sources, fit their powers and the residual.

        Raises:
            ValueError: not spectra of a moving receiver with a declared array that keeps its
                orientation.
        """
        problem = site_problem(data)
        if problem is not None:
            raise ValueError(f"{self.name}: {problem}")
        self._lags, self._steps = None, round(context.effort * self.search.steps)
        report = super().fit(data, fold, context)
        # The rows of `super().fit` in its order: `left_out` names its images by them.
        self.rows = heard_rows(data, fold.learned())
        return report

    @property
    def terms(self) -> tuple[str, ...]:
        """Name sources seen through the array, and a residual where one is fitted."""
        return ("moving_array", "residual") if len(self.residual.axes) else ("moving_array",)

    def reduction_settings(self) -> tuple[str, ...]:
        """See `Method.reduce`."""
        return ("keep", "stride", "confidence")

    def reduce(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Method.reduce`: the mean with the strongest components of the residual (`keep`).

        On fewer pixels (`stride`) and without its variance.

        Raises:
            ValueError: a stride that does not divide the columns.
        """
        assert self.site is not None and self.site.grid is not None
        if set(settings) <= {"confidence"} and settings.get("confidence", True):
            return self
        stride, grid = int(settings.get("stride", 1)), self.site.grid
        if grid.width % stride:
            message = f"stride={stride} does not divide the {grid.width} columns of the grid"
            raise ValueError(message)
        count = math.ceil(float(settings.get("keep", 1.0)) * len(self.residual.axes))
        lean = ReducedMean(self, self._make_renderer(self.residual.keep_axes(count), stride), count)
        return Interpolated(lean, grid, stride) if stride > 1 else lean

    # -- learning ----------------------------------------------------------------------------------

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        # Before any lags are taken: they are linear in power, not in amplitude.
        self.exponent = self._find_pixel_exponent(targets)
        self.basis = fit_separable(self._blocks(targets), UNRESOLVED)
        spectra = self._make_spectra(positions, targets)
        sources = self._find_sources(spectra)
        power = self._fit_powers(spectra, sources)
        modelled = self._fit_trend(
            spectra, sources, power, self._choose_kernel(spectra, sources, power)
        )
        rows = _spread_rows(len(positions), self.rest_rows)
        misfit, kernel = error_and_likeliest_kernel(
            positions[rows], spectra.values[rows] - modelled[rows]
        )
        self._fit_residual(spectra, modelled, kernel, targets)
        error, count = misfit / targets[0].size, self.count_components()
        note = f"{self.name}: {count} sources, leave-one-out error {error:.4g}"
        fitted = (
            f"length {kernel.length:.3g} m and noise {kernel.noise:.3g}, chosen on {len(rows)} rows"
        )
        return (note, f"{self.name}: residual of {fitted}, {len(self.residual.axes)} components")

    @torch.no_grad()
    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Solve powers, trends, residual and errors anew,
        with the sources and kernels of the fit.
        """
        self.rows = rows = heard_rows(data, rows)
        if not len(rows):
            raise ValueError(f"{self.name}: the training set is empty")
        targets, self.seen = training_targets(data, rows), len(rows)
        spectra, trend = self._make_spectra(data.moving[rows], targets), self.found
        modelled = self._fit_trend(
            spectra, trend.sources, self._fit_powers(spectra, trend.sources), trend.kernel
        )
        self._fit_residual(spectra, modelled, self.residual.kernel, targets)

    def _find_pixel_exponent(self, targets: np.ndarray) -> int:
        """Whether pixels are amplitude (2) or power (1).

        Raises:
            ValueError: neither is a spectrum of the declared array.
        """
        exponent, rest = pixel_exponent(
            self.lags(), self._to_images(targets[_spread_rows(len(targets), 16)])
        )
        if rest > MAX_UNEXPLAINED:
            raise ValueError(
                f"{self.name}: the declared array cannot have measured these spectra "
                f"({rest:.0%} of their energy is outside its lags)"
            )
        return exponent

    def _make_spectra(self, places: np.ndarray, targets: np.ndarray) -> Spectra:
        both = [
            (self.lags().to_lags(b**self.exponent), self.basis.project(b))
            for b in self._blocks(targets)
        ]
        lags, values = (torch.cat(part) for part in zip(*both, strict=True))
        return Spectra(places, lags, values)

    def _find_sources(self, spectra: Spectra) -> Tensor:
        """Sources (K, 3) [m]."""
        assert self.site is not None and self.site.grid is not None
        few = spectra.subset(_spread_rows(len(spectra.places), self.search.rows))
        still = self.site.static_position
        first = None if still is None else torch.from_numpy(np.asarray(still)).float()
        return find_sources(
            few.lags,
            few.receivers,
            first,
            self.rotation(),
            self.lags(),
            self.site.grid,
            replace(self.search, steps=self._steps),
            self.seed,
        )

    def _fit_powers(self, spectra: Spectra, sources: Tensor) -> np.ndarray:
        """Powers (n, K) float64 that explain each row best."""
        array = self.receiving_array()
        return (
            torch.cat(
                [
                    nonnegative_powers(part, array.atoms(sources, places), self.search.ridge)
                    for part, places in zip(
                        spectra.lags.split(BLOCK), spectra.receivers.split(BLOCK), strict=True
                    )
                ]
            )
            .double()
            .numpy()
        )

    def _fit_trend(
        self, spectra: Spectra, sources: Tensor, power: np.ndarray, kernel: Kernel
    ) -> Tensor:
        """Fit the trend of powers (n, K); its left-out images (n, R)."""
        self.found, trend_power = fit_trend(sources, kernel, spectra.places, power)
        return self._render_coefficients(spectra, sources, torch.from_numpy(trend_power).float())

    def _render_coefficients(self, spectra: Spectra, sources: Tensor, power: Tensor) -> Tensor:
        """Images (n, R) of sources of powers (n, K)."""
        array = self.receiving_array()
        return torch.cat(
            [
                self.basis.project(array.render(sources, places, part))
                for places, part in zip(
                    spectra.receivers.split(BLOCK), power.split(BLOCK), strict=True
                )
            ]
        )

    def _choose_kernel(self, spectra: Spectra, sources: Tensor, power: np.ndarray) -> Kernel:
        """Kernel of a trend, by leave-one-out error."""
        rows = _spread_rows(len(spectra.places), self.trend.rows)
        # Lengths are shares of the site's diagonal, of 1 m where all rows are at one place.
        some, diagonal = (
            spectra.subset(rows),
            float(np.linalg.norm(np.ptp(spectra.places, axis=0))) or 1.0,
        )
        errors = {}
        for length in self.trend.lengths:
            kernel = Kernel.from_length(length * diagonal, self.trend.noise)
            trend_power = torch.from_numpy(
                fit_trend(sources, kernel, some.places, power[rows])[1]
            ).float()
            missed = some.values - self._render_coefficients(some, sources, trend_power)
            errors[kernel] = error_and_likeliest_kernel(some.places, missed)[0]
        return min(errors, key=lambda kernel: errors[kernel])

    def _fit_residual(
        self, spectra: Spectra, modelled: Tensor, kernel: Kernel, targets: np.ndarray
    ) -> None:
        """The process on what left-out trends (n, R) miss, and the error model of the sum."""
        self.positions, missed = spectra.places, spectra.values - modelled
        self.residual, added = fit_residual(kernel, spectra.places, missed, self.components)
        self._left, self._query = modelled + added, None
        energy = added.square().sum(1) / targets[0].size
        relative, features, errors = [], [], []
        for start, image in zip(range(0, len(targets), BLOCK), self._blocks(targets), strict=True):
            part = slice(start, start + BLOCK)
            # Clamped as answers are: the error model is of what is answered.
            images = self.basis.images(self._left[part]).clamp_(0, 1)
            error = (images - image).square().mean((1, 2))
            relative.append(error / image.square().mean((1, 2)).clamp_min(1e-12))
            errors.append(error)
            features.append(image_features(images, energy[part]))
        # Two images drawn at random differ by twice the variance.
        prior = (
            2
            * float((spectra.values - spectra.values.mean(0)).square().mean(0).sum())
            / targets[0].size
        )
        reach = self.found.kernel.length
        self.errors = fit_errors(
            spectra.places, torch.cat(relative), torch.cat(features), kernel, reach, prior
        )
        self._left_error = torch.cat(errors)

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """See `ClosedForm`; images."""
        if not len(self.rows):
            raise ValueError(
                f"{self.name}: condition it first, a stored one has no rows to leave out"
            )
        mean = torch.cat([self.basis.images(part).clamp_(0, 1) for part in self._left.split(BLOCK)])
        return LeftOutRows(self.rows, mean, self._left_error)

    # -- answering ---------------------------------------------------------------------------------

    def _predict_at(self, queries: Tensor, dtype: torch.dtype) -> Prediction:
        """See `Differentiable`; `explained` are the sources' images alone."""
        query, errors = self.renderer(), self.errors
        if dtype == torch.float64:
            query, errors = query.in_float64, to_double(errors)
        answer = query(queries)
        # Stored pixels lie in [0, 1]; sources and residual need not add up to such.
        mean = answer.image.clamp_(0, 1)
        features = image_features(mean, answer.added / mean[0].numel())
        power = mean.flatten(1).square().mean(1)
        unknown, variance = errors.unknown_and_variance(answer.far, features, power)
        return Prediction(mean, variance, unknown, answer.explained.clamp(0, 1))

    def renderer(self) -> ImageRenderer:
        """Return answers with all that was found, made once."""
        if self._query is None:
            self._query = self._make_renderer(self.residual, 1)
        return self._query

    def _make_renderer(self, residual: Residual, stride: int) -> ImageRenderer:
        """Answers with a residual, on every `stride`-th pixel."""
        basis = self.basis if stride == 1 else self.basis.subsample_pixels(stride)
        places = torch.from_numpy(self.positions)
        return ImageRenderer(self.receiving_array(stride), basis, self.found, residual, places)

    def count_components(self) -> int:
        """Return the number of sources."""
        return len(self.found.sources) if "found" in vars(self) else 0

    def receiving_array(self, stride: int = 1) -> ReceivingArray:
        """Return the array, which looks at every `stride`-th pixel."""
        return ReceivingArray(self.lags(), self.rotation(), self.exponent, stride)

    def rotation(self) -> Tensor:
        """Return the rotation (3, 3) of the array, receiver to world."""
        assert self.site is not None and self.site.rx_rotation is not None
        return torch.from_numpy(np.asarray(self.site.rx_rotation)).float()

    def lags(self) -> SpectrumLags:
        """Return the array's lags, computed once."""
        if self._lags is None:
            self._lags = SpectrumLags(*self.fitted_site.array_geometry())
        return self._lags

    _lags: SpectrumLags | None = None
    _query: ImageRenderer | None = None

    def _to_images(self, targets: np.ndarray) -> Tensor:
        return torch.from_numpy(self.fitted_site.target.to_real(targets)).reshape(targets.shape)

    def _blocks(self, targets: np.ndarray) -> Iterator[Tensor]:
        return (self._to_images(targets[i : i + BLOCK]) for i in range(0, len(targets), BLOCK))

    def _relearn(self, state: dict[str, Any]) -> None:
        super()._relearn(state)
        self._lags = self._query = None
        self.basis = Separable(**state["basis"])

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {**super().state(), "basis": vars(self.basis)}


def _spread_rows(count: int, limit: int) -> np.ndarray:
    """At most `limit` of `count` rows, evenly."""
    return np.unique(np.linspace(0, count - 1, min(limit, count)).round().astype(int))
