"""`model=complex_gp`: a Gaussian process on complex channels from the carrier alone,
without sources.

Waves from all around make neighbouring channels correlated as sin(kd) / (kd) (R. K. Cook et al.,
"Measurement of correlation coefficients in reverberant sound fields", J. Acoust. Soc. Am. 27
(1955)); a Matern-3/2 envelope over distance bounds the correlation. Real and imaginary parts share
one kernel: the circular complex process. Rows of a run (`Measurements.run`) share an unknown
complex factor, estimated by likelihood; predictions at places are those of the largest run, those
of measured rows their own run's where it is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby, product
from typing import cast

import numpy as np
import torch
from torch import Tensor

from gsparc.data.blocks import take
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.spacing import neighbour_distance
from gsparc.data.splits import Fold
from gsparc.models.channels.columns import Group, Slot, fit_run_factors, negative_log_likelihood
from gsparc.models.closed_form import ClosedForm
from gsparc.models.method import Prediction
from gsparc.models.run_factors import RunFactors
from gsparc.models.station_sites import stations_of_fold
from gsparc.processes.averages import mean_at_places
from gsparc.processes.density import TINY
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.fit_kernel import fit_two_lengths, initial_kernel
from gsparc.processes.kernel import IsotropicWaves, Kernel, WhiteNoise
from gsparc.processes.nearest import (
    NeighbourSample,
    PlaceValues,
    condition_on_nearest,
    nearest_density,
)
from gsparc.processes.neighbourhood import Neighbourhood
from gsparc.processes.places import ORIGIN
from gsparc.processes.posterior import Exact, Posterior, approximation_label
from gsparc.processes.powers import MOST_ROWS
from gsparc.processes.prior import Prior
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort
from gsparc.training.stopwatch import Stopwatch

LENGTHS = (0.25, 1.0, 4.0, 16.0)  # wavelengths, candidates of the envelope's length
NOISES = (10.0 ** np.arange(-4, 1)).tolist()  # of the signal's power, candidates
CHOSEN_ON = Effort.chosen_on  # rows that length and noise are chosen on: each look factors a matrix
NEAREST = 100  # rows that tell of a query: waves from all around are not screened as shadows are
TRIED_ON = 300  # of these, rows whose density given their neighbours chooses the settings
ENTRIES = 64  # of their channels
REFINED = 3  # walks to the two lengths
NAMED = 6  # factors of runs that a note gives
ANY = Slot(0, (), (), ORIGIN, ORIGIN, 0.0)  # kernels know of no end


class ComplexGP(ClosedForm):
    """`sinc(2 d / wavelength) * Matern-3/2(d / length)`; length and noise by likelihood on a grid.

    Where both ends move the covariance is the product of both ends'.
    """

    name = "complex_gp"
    baseline_order = 100
    stored = ("posterior", "runs", "shape")
    kinds = ("csi",)
    both_ends = True
    count_gaussians = 0  # type: ignore[assignment]

    def __init__(self) -> None:
        self.site: Site | None = None
        self.posterior: Posterior | None = None

    @classmethod
    def stands_beside(cls, data: Measurements, fold: Fold) -> bool:
        """See `MethodFactory.stands_beside`: carrier and all stations must be known."""
        if not super().stands_beside(data, fold) or not np.isfinite(data.site.carriers).all():
            return False
        return data.station is None or not stations_of_fold(cls(), data, fold).only_tested.any()

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        return approximation_label(self.name, self.posterior)

    @property
    def kernel(self) -> Kernel:
        """Its length, noise and power."""
        return self.require_fitted(self.posterior).prior.kernel

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Fit to `train` and `val`; `ValueError` unless the data are channels
        of a known carrier.
        """
        started = Stopwatch()
        if not data.site.has_waves:
            raise ValueError(
                "complex_gp: needs complex channels (csi) of a known carrier; take model=gp"
            )
        fit_rows = fold.learned()
        self.site, self.shape = data.site, tuple(data.target.shape[1:])
        one_run = len(np.unique(data.runs_of(fit_rows))) == 1  # factors of several need all rows
        many = len(fit_rows) > MOST_ROWS and one_run
        notes = (
            self._fit_by_neighbours(data, fit_rows)
            if many
            else self._fit_one_factor(data, fit_rows)
        )
        length, noise = float(self.kernel.length), self.kernel.noise
        envelope = f"envelope {length:.3g} m, noise {noise:.0e} of the signal's power"
        return FitReport(started.seconds, tuple(f"complex_gp: {n}" for n in (envelope, *notes)))

    @property
    def _wavelength(self) -> float:
        wavelength = self.fitted_site.wavelength
        assert wavelength is not None  # `fit` asks
        return wavelength

    def _choose_two_lengths(self, places: Tensor, values: Tensor) -> Kernel | None:
        """The kernel of values (n, R) at places (n, D) [m] that were turned to neighbours;
        else None.
        """
        if self.fitted_site.phase_reference != "neighbours":
            return None
        at = places.numpy()
        kernel, rows = (
            initial_kernel(self._wavelength, neighbour_distance(at)),
            (at, values.numpy()),
        )
        for _ in range(REFINED):
            kernel = fit_two_lengths(*rows, self._wavelength, kernel)
        return replace(kernel, amplitude=1.0)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`; with the kernel that was chosen, where one factor holds all rows."""
        if isinstance(self.posterior, Exact):
            self.site = data.site
            self._fit_one_factor(data, rows, replace(self.kernel, amplitude=1.0))
        else:
            super().condition(data, rows)

    def _fit_one_factor(
        self, data: Measurements, known: np.ndarray, kernel: Kernel | None = None
    ) -> list[str]:
        """Rows (n,) with one factor, settings chosen on some unless given; factors of runs."""
        places, notes, order = torch.from_numpy(data.moving[known]), [], torch.arange(len(known))
        target = (
            torch.from_numpy(np.asarray(data.target[known]))
            .reshape(len(known), -1)
            .to(torch.complex128)
        )
        runs = data.runs_of(known)
        names, run = np.unique(runs, return_inverse=True)
        slot = replace(ANY, wavenumber=2 * math.pi / self._wavelength)
        rows = Group(slot, places, order, target, torch.from_numpy(run), order.double())
        if kernel is None:
            few = rows.thin_rows(CHOSEN_ON)
            if len(few) < len(rows):
                notes.append(f"settings chosen on {CHOSEN_ON} of {len(known)} rows, drawn evenly")
            kernel = self._choose_two_lengths(few.places, few.target)
            kernel = kernel or choose_waves((few,), len(names))[0]
        factors, ((_, solution),) = fit_run_factors((rows,), [kernel.gram(places)], len(names))
        prior = Prior(
            replace(kernel, amplitude=max(float(solution.values.abs().square().mean()), TINY))
        )
        self.posterior = Exact.from_values(prior, places, solution.values, None, solution.factor)
        self.runs = RunFactors(names.astype(np.int64), factors)
        if len(names) > 1:
            notes.append(self._describe_factors(names, run))
        return notes

    def _fit_by_neighbours(self, data: Measurements, known: np.ndarray) -> list[str]:
        """Rows (n,) of one run, too many for one factor: their channels,
        and settings given neighbours.

        A hundred nearest rows of one place, where a robot waited, tell of no other:
        its mean is taken once.
        """
        targets = take(data.target, known).reshape(len(known), -1)
        first, means, count = mean_at_places(data.moving[known], targets)
        values = PlaceValues(
            data.moving[known[first]], torch.from_numpy(means), torch.from_numpy(count).double()
        )
        squares = mean_at_places(data.moving[known], _mean_square(targets))[1]
        scatter = torch.from_numpy((count * (squares - _mean_square(means))).clip(0))
        near = Neighbourhood.from_places(values.places, 0)
        row = covering_rows(values.places, TRIED_ON, 0)
        rows = np.c_[row, near.nearest_rows(values.places[row], row, NEAREST)]
        entries = np.random.default_rng(0).permutation(targets.shape[1])[:ENTRIES]
        at = torch.from_numpy(values.places)
        some = values.values[rows][..., entries]
        sample = NeighbourSample(at[rows], some, values.count[rows], scatter[row])
        waves = wave_kernels(self._wavelength)
        kernel = self._choose_two_lengths(at, values.values)
        kernel = kernel or min(waves, key=lambda one: float(nearest_density(one, sample, 0.0)[0]))
        power = max(float(some[:, 0].abs().square().mean()), TINY)
        prior = Prior(replace(kernel, amplitude=power))
        self.posterior = condition_on_nearest(prior, values, 0, neighbours=NEAREST)
        self.runs = RunFactors.identity()
        of = f"of {len(count)} places, of" if len(count) < len(known) else "of"
        by = f"each query is predicted from the {NEAREST} nearest {of} {len(known)} rows (Vecchia)"
        return [by, f"settings chosen on {len(row)} of them, each given its nearest"]

    def _describe_factors(self, names: np.ndarray, run: np.ndarray) -> str:
        """A note of the factors of runs (n,), numbers into `names` (runs,)."""
        factors = self.runs.factors.numpy()[:NAMED]
        listed = ", ".join(
            f"{name:g}: {abs(factor):.3g} at {np.degrees(np.angle(factor)):.0f} degrees"
            for name, factor in zip(names, factors, strict=False)
        )
        more = f", and {len(names) - NAMED} more" if len(names) > NAMED else ""
        return (
            f"factors of runs, relative to run {names[np.bincount(run).argmax()]:g}: {listed}{more}"
        )

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        process, dtype = self.require_fitted(self.posterior), query.tx.dtype
        posterior = process.answer(query.places(self.fitted_site), dtype == torch.float64)
        share = posterior.variance / (1 + self.kernel.noise)
        mean = posterior.mean.to(dtype.to_complex()).reshape(-1, *self.shape)
        prediction = Prediction(
            mean, (self.kernel.amplitude * share).to(dtype), share.to(dtype).clamp(0, 1)
        )
        return self.runs.apply_factors(prediction, query.run)

    def count_components(self) -> int:
        """Return the number of training samples kept."""
        return 0 if self.posterior is None else len(self.posterior.places)


def _mean_square(channels: np.ndarray) -> np.ndarray:
    """Mean square (n,) float64 of channels (n, R)."""
    return (np.abs(channels) ** 2).mean(1, dtype=np.float64)


def wave_kernels(wavelength: float) -> Iterator[Kernel]:
    """Yield candidates of an envelope's length, and for each of them of noise."""
    for length, noise in product(LENGTHS, NOISES):
        yield Kernel(
            (IsotropicWaves(length * wavelength, 1.0, 2 * math.pi / wavelength), WhiteNoise(noise))
        )


def choose_waves(groups: tuple[Group, ...], runs: int) -> tuple[Kernel, Tensor]:
    """Return the likeliest waves, of the first group's wavelength, and factors of runs,
    as measured.
    """
    trials: list[tuple[float, Kernel, Tensor]] = []
    candidates = wave_kernels(2 * math.pi / groups[0].slot.wavenumber)
    for _, kernels in groupby(candidates, lambda one: one.signals[0]):
        first, *others = kernels
        isotropic = cast(IsotropicWaves, first.signals[0])
        waves = [replace(isotropic, wavenumber=group.slot.wavenumber) for group in groups]
        alike = [
            wave.covariance(rows.places, rows.places)
            for wave, rows in zip(waves, groups, strict=True)
        ]
        for kernel in (first, *others):
            grams = [each + kernel.noise * torch.eye(len(each), dtype=each.dtype) for each in alike]
            factors, solutions = fit_run_factors(groups, grams, runs)
            trials.append((negative_log_likelihood(factors, solutions), kernel, factors))
    return min(trials, key=lambda one: one[0])[1:]
