"""Which terms a field of channels has, and their powers, from training rows.

The isotropic process comes first, chosen as `model=complex_gp` chooses. Every further term is kept where the
marginal likelihood gains and rows are predicted better without their neighbours: each alone, in 32 cells of
nearby places and in 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.methods.time_budget import TimeBudget
from gsparc.multipath.complex_gp import CHOSEN_ON, LENGTHS, NOISES
from gsparc.multipath.ridge import cholesky
from gsparc.multipath.run_factors import aligning, run_quadratic
from gsparc.multipath.waves import drift
from gsparc.multipath.waves.columns import Group, gather, thinned
from gsparc.multipath.waves.covariance import BEYOND, Shape, Values
from gsparc.multipath.waves.evidence import (
    Compressed,
    compressed,
    evidence,
    fit_powers,
    left_out_cells,
    normalised,
)
from gsparc.multipath.waves.field import ChannelField
from gsparc.multipath.waves.kernels import cells, directions, envelope, isotropic
from gsparc.multipath.waves.offset import best_offset
from gsparc.multipath.waves.settings import ChannelSettings

DEPTHS = (5, 3)  # cells of places are halved this often: 32 of them, and 8
GAINS = (1.5, 6.0)  # wavelengths, candidates of the length over which a source's gain varies
LEAST = 1e-4  # of all powers: those below are dropped
BETTER = 0.995  # least ratio of left-out errors, after over before a term, at which it is kept
NO_WORSE = 1.02  # largest of any one of them
STARTS = {"constant": 0.1, "direct": 0.1, "direct_smooth": 0.1}  # powers, relative to the diffuse field's


@dataclass(frozen=True)
class Candidate:
    """Terms with their powers, and how well they do.

    Attributes:
        nll: negative log marginal likelihood [nats], the same rows for all candidates.
        errors: squared errors, left out one by one and in the cells of `DEPTHS`, relative to the power.
    """

    shape: Shape
    values: Values
    nll: float
    errors: np.ndarray

    def beats(self, other: Candidate) -> bool:
        """Whether likelihood and left-out places prefer this one."""
        ratio = self.errors / other.errors
        return self.nll < other.nll and bool(np.exp(np.log(ratio).mean()) < BETTER and ratio.max() < NO_WORSE)


def initialise(
    data: Measurements,
    rows: np.ndarray,
    settings: ChannelSettings,
    seed: int = 0,
    budget: TimeBudget | None = None,
    sources: np.ndarray | None = None,
    target: np.ndarray | None = None,
) -> tuple[ChannelField, tuple[str, ...]]:
    """A field conditioned on the rows, and notes about it.

    Args:
        data: kind csi.
        rows: (n,) measurements to learn from.
        settings: terms.
        seed: nothing is random.
        budget: when it is over, no further term is tried.
        sources: (N, 3) [m], local: Gaussians as virtual sources; None for none.
        target: (n, A, K) in place of the rows' targets, such as another model's left-out residual.

    Raises:
        ValueError: the data are no channels of a known carrier with one static end.
    """
    del seed
    rows, budget = np.asarray(rows), budget or TimeBudget()
    if target is not None:
        whole = np.zeros_like(data.target)
        whole[rows] = target.reshape(len(rows), *data.target.shape[1:])
        data = replace(data, target=whole)
    places = np.zeros((0, 3)) if sources is None else np.asarray(sources, np.float64)
    plain, factors, notes = _isotropic(data, rows)
    search = _Search.of(data, rows, settings, torch.from_numpy(places), plain, factors)
    best, more = search.run(budget)
    channel = (int(data.target.shape[1]), int(data.target.shape[2]))
    field = ChannelField(data.site, best.shape, best.values, channel)
    field.condition(data, rows)
    return field, (*notes, *more)


def isotropic_shape(middle: Tensor, reach: float) -> Shape:
    """The diffuse field from everywhere alike, and no other term."""
    return Shape(torch.zeros(0, 3, dtype=torch.float64), 8.0, False, False, False, 0, middle, reach)


def _isotropic(data: Measurements, rows: np.ndarray) -> tuple[tuple[Shape, Values], Tensor, list[str]]:
    """Envelope and noise on the grid of `complex_gp`, and the factors of runs, as measured."""
    groups = gather(data, rows, False)
    looked = thinned(groups, 8, CHOSEN_ON)
    runs = 1 if data.run is None else len(np.unique(data.run[rows]))
    wavelength = 2 * math.pi / groups[0].slot.wavenumber
    tried = []
    for length in LENGTHS:
        bounded = [_plain_kernel(group, length * wavelength) for group in looked]
        for noise in NOISES:
            tried.append((*_grid_point(looked, bounded, noise, runs), length * wavelength, noise))
    _, factors, length, noise = min(tried, key=lambda t: t[0])
    everywhere = torch.cat([group.places for group in groups])
    extent = float(torch.linalg.vector_norm(everywhere.max(0).values - everywhere.min(0).values))
    shape = isotropic_shape(everywhere.mean(0), BEYOND * max(extent, wavelength))
    zero = torch.zeros(3, dtype=torch.float64)
    one = torch.tensor([1.0, noise], dtype=torch.float64)
    lengths = torch.tensor(length).double(), torch.tensor(GAINS[0] * wavelength).double()
    values = Values(one, *lengths, zero, torch.zeros(0, 3, dtype=torch.float64))
    note = f"waves: isotropic field, envelope {length:.3g} m, noise {noise:.0e} of its power"
    return (shape, values), factors, [note]


def _plain_kernel(group: Group, length: float) -> Tensor:
    distance = torch.cdist(group.places, group.places)
    return isotropic(distance, group.slot.wavenumber) * envelope(distance, length)


def _grid_point(
    groups: tuple[Group, ...], kernels: list[Tensor], noise: float, runs: int
) -> tuple[float, Tensor]:
    """Negative log likelihood with profiled scales, and factors of runs as measured."""
    solved, total, size = [], np.zeros((runs, runs), np.complex128), np.zeros(runs)
    for group, kernel in zip(groups, kernels, strict=True):
        covariance = kernel.clone()
        covariance.diagonal().add_(noise)
        solved.append(cholesky(covariance))
        if runs > 1:
            level = float(group.target.abs().square().mean())
            run = group.run.numpy()
            own = run_quadratic(torch.cholesky_inverse(solved[-1]).numpy(), group.target.numpy(), run)
            total[: len(own), : len(own)] += own / max(level, 1e-300)
            size += np.bincount(run, minlength=runs) * group.target.shape[1]
    factors = np.ones(runs, np.complex128)
    heard = size > 0
    if runs > 1:
        factors[heard] = aligning(total[np.ix_(heard, heard)], size[heard])
    turn, nll = torch.from_numpy(factors), 0.0
    for group, lower in zip(groups, solved, strict=True):
        target = group.target * turn[group.run][:, None]
        white = torch.cat([target.real, target.imag], 1)
        count, outputs = target.shape
        fit = float((white * torch.cholesky_solve(white, lower)).sum()) / (count * outputs)
        nll += outputs * (count * math.log(max(fit, 1e-300)) + 2 * float(lower.diagonal().log().sum()))
        nll -= 2 * outputs * float(turn.abs().log()[group.run].sum())
    return nll, 1 / turn


@dataclass(frozen=True)
class _Search:
    """What every candidate of a fit has in common."""

    settings: ChannelSettings
    groups: tuple[Group, ...]
    every: tuple[Group, ...]
    plain: tuple[Shape, Values]
    sources: Tensor
    wavelength: float

    @staticmethod
    def of(
        data: Measurements,
        rows: np.ndarray,
        settings: ChannelSettings,
        sources: Tensor,
        plain: tuple[Shape, Values],
        factors: Tensor,
    ) -> _Search:
        every = gather(data, rows, True)
        every = tuple(normalised(replace(g, target=g.target / factors[g.run][:, None])) for g in every)
        groups = thinned(every, settings.columns, settings.rows)
        return _Search(settings, groups, every, plain, sources, 2 * math.pi / every[0].slot.wavenumber)

    def run(self, budget: TimeBudget) -> tuple[Candidate, list[str]]:
        """The terms that are kept, and notes."""
        wanted, notes = self.settings, []
        best = self._measured(*self.plain, self._compressed(*self.plain))
        best = self._step(best, self._fitted(*self.plain)[0], "auto", "powers by likelihood", notes)
        ends = all(bool(torch.isfinite(group.slot.end).all()) for group in self.groups)
        told = wanted.constant is not False or (ends and wanted.direct is not False) or len(self.sources) > 0
        if told and not budget.over():
            fresh = self._with_told(best, ends and wanted.direct is not False)
            forced = wanted.constant is True or wanted.direct is True or len(self.sources) > 0
            best = self._step(best, fresh, forced or "auto", "leakage, direct wave, sources", notes)
        if wanted.directions is not False and not budget.over():
            best = self._step(best, self._with_directions(best), wanted.directions, "directions", notes)
        if wanted.correlated is not False and not budget.over():
            best = self._with_drift(best, notes)
        return best, notes

    def _step(
        self, before: Candidate, after: Candidate, wanted: bool | str, name: str, notes: list[str]
    ) -> Candidate:
        keep = wanted is True or after.beats(before)
        ratio = after.errors / before.errors
        gain = (before.nll - after.nll) / sum(group.target.numel() for group in self.groups)
        notes.append(
            f"waves: {name} {'kept' if keep else 'dropped'}: {gain:+.3f} nats per channel, left-out error of "
            f"rows, small and large cells times {ratio[0]:.3f}, {ratio[1]:.3f}, {ratio[2]:.3f}"
        )
        return after if keep else before

    def _compressed(self, shape: Shape, values: Values) -> tuple[Compressed, ...]:
        return compressed(self.groups, shape, values)

    def _measured(self, shape: Shape, values: Values, parts: tuple[Compressed, ...]) -> Candidate:
        """With what left-out rows say."""
        errors = np.zeros(1 + len(DEPTHS))
        for part in parts:
            places = part.group.places.numpy()
            grouping = [np.arange(len(places)), *(cells(places, depth) for depth in DEPTHS)]
            for number, cell in enumerate(grouping):
                error = left_out_cells(part, values.power, cell)
                errors[number] += float(error.abs().square().mean()) / len(parts)
        return Candidate(shape, values, evidence(parts, values.power), errors)

    def _fitted(self, shape: Shape, values: Values) -> tuple[Candidate, tuple[Compressed, ...]]:
        """With powers of largest evidence; measured."""
        parts = self._compressed(shape, values)
        power, _ = fit_powers(parts, shape, values.power, self.settings.shrinkage)
        fresh = replace(values, power=power)
        return self._measured(shape, fresh, parts), parts

    def _with_told(self, before: Candidate, direct: bool) -> Candidate:
        """With leakage, the direct wave and sources; the best of a few lengths."""
        shape = replace(
            before.shape,
            constant=self.settings.constant is not False,
            direct=direct,
            sources=len(self.sources),
        )
        level = float(before.shape.of("isotropic", before.values.power)[0])
        noise = float(before.shape.of("noise", before.values.power)[0])
        starts = {**STARTS, "isotropic": 1.0, "noise": noise / level}
        share = 0.3 / max(len(self.sources), 1)
        power = torch.tensor([starts.get(name, share) for name in shape.names], dtype=torch.float64)
        values = replace(before.values, power=power, sources=self.sources)
        found = []
        lengths = {float(before.values.envelope), LENGTHS[-1] * self.wavelength}
        gains = GAINS if direct or len(self.sources) else GAINS[:1]
        for bound in sorted(lengths):
            for gain in gains:
                tried = replace(
                    values,
                    envelope=torch.tensor(bound).double(),
                    gain=torch.tensor(gain * self.wavelength).double(),
                )
                found.append(self._fitted(shape, tried))
        best, parts = min(found, key=lambda each: each[0].nll)
        if direct and self.settings.offset:
            offset = best_offset(parts, shape, best.values, self.wavelength)
            if offset is not None:
                moved, _ = self._fitted(shape, replace(best.values, offset=offset))
                if moved.nll + 1.5 * math.log(sum(g.target.numel() for g in self.groups)) < best.nll:
                    best = moved
        return self._pruned(best)

    def _with_directions(self, before: Candidate) -> Candidate:
        """With unequal powers of directions, which start equal."""
        group = max(self.groups, key=len)
        angles = directions(group.places, group.slot.wavenumber, self.settings.angles)
        shape = replace(before.shape, angles=angles, concentration=self.settings.concentration)
        old = before.values.power
        level = float(before.shape.of("isotropic", old)[0])
        power = torch.tensor([0.3 * level] + [0.7 * level / len(angles)] * len(angles)).double()
        values = replace(before.values, power=torch.cat([power, old[1:]]))
        return self._pruned(self._fitted(shape, values)[0])

    def _pruned(self, found: Candidate) -> Candidate:
        """Without directions and other terms whose powers vanish."""
        shape, power = found.shape, found.values.power
        weak = power < LEAST * power.sum()
        if not bool(weak[shape.where("direction")].any()):
            return found
        kept = [i for i, name in enumerate(shape.names) if name != "direction" or not weak[i]]
        angles = shape.angles[~weak[shape.where("direction")]]
        return replace(
            found, shape=replace(shape, angles=angles), values=replace(found.values, power=power[kept])
        )

    def _with_drift(self, before: Candidate, notes: list[str]) -> Candidate:
        groups = drift.stretches(self.every)
        shape, values, gain = drift.with_drift(groups, before.shape, before.values)
        errors = [
            self._drift_errors(groups, *each) for each in ((before.shape, before.values), (shape, values))
        ]
        spread = replace(before, nll=0.0, errors=errors[0])
        after = Candidate(shape, values, -gain, errors[1])
        kept = self._step(spread, after, self.settings.correlated, "noise correlated over rows", notes)
        return after if kept is after else before

    @staticmethod
    def _drift_errors(groups: tuple[Group, ...], shape: Shape, values: Values) -> np.ndarray:
        errors = np.zeros(1 + len(DEPTHS))
        for group in groups:
            places = group.places.numpy()
            grouping = [np.arange(len(places)), *(cells(places, depth) for depth in DEPTHS)]
            for number, cell in enumerate(grouping):
                error = drift.left_out_cells(group, shape, values, cell)
                errors[number] += float(error.abs().square().mean()) / len(groups)
        return errors
