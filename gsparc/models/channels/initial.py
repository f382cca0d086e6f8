"""Which terms a field of channels has, and their powers, from training rows.

The isotropic process comes first, chosen as `model=complex_gp` chooses. Every further term is kept where the
marginal likelihood gains more than its parameters are worth (G. Schwarz, "Estimating the dimension of a
model", Ann. Statist. 6 (1978)) and rows are predicted better without their neighbours: each alone, in 32
cells of nearby places and in 8. Powers of many directions fit any field: theirs are those of other cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.models.channels import drift
from gsparc.models.channels.columns import Group, ends_of, gather, run_factors_of, thinned
from gsparc.models.channels.complex_gp import LENGTHS, NOISES
from gsparc.models.channels.covariance import BEYOND, Values, disturbance, signals
from gsparc.models.channels.evidence import (
    Cache,
    Compressed,
    Grouping,
    compressed,
    compressible,
    evidence,
    fit_powers,
    left_out,
    normalised,
    without,
)
from gsparc.models.channels.kernels import cells, directions, plain
from gsparc.models.channels.mirrors import find_mirrors
from gsparc.models.channels.probe import best_offset
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.factor import Factor
from gsparc.processes.left_out import groups_of
from gsparc.processes.worker import Cancelled, cancelled_by
from gsparc.training.time_budget import TimeBudget

COLUMNS = 8  # static ends, antennas or bands of tones that terms are decided on at most
ENDS = 64  # of several static ends, those that powers are learned on in the end
CONCENTRATION = 8.0  # of each direction, that of a von Mises-Fisher density
SHRINKAGE = 0.5  # of directions' powers towards their mean, in rows of the inverse Gamma prior
FOLDS = 4  # of cells, whose directions' powers are found from the others
DEPTHS = (5, 3)  # cells of places are halved this often: 32 of them, and 8
GAINS = (1.5, 6.0)  # wavelengths, candidates of the length over which a source's gain varies
LEAST = 1e-3  # of all powers: sources below are dropped
NEW = 0.2  # of the isotropic field's power, where that of a new term starts
SHORT = 8  # steps of a fit that compares lengths, or that is followed by another
ROUGH_ENDS, ROUGH_ROWS = 12, 150  # that planes are looked for with, before all ends say which it is
DENSE_ROWS, DENSE_COLUMNS = 300, 2  # learned on where places are so far apart that nothing can be compressed
WEAKEST = 0.03  # of the diffuse field's power, a direction's beyond that of the weakest, to be kept
BETTER = 0.995  # least ratio of left-out errors, after over before a term, at which it is kept
NO_WORSE = 1.1  # largest of any one of them


@dataclass(frozen=True)
class ChannelSettings:
    """Terms that are tried beside the isotropic diffuse field, and what they are learned on.

    Attributes:
        constant: what does not depend on the place (leakage).
        direct: the wave of the static end, with a fixed gain and one that varies over places.
        directions: unequal powers of the diffuse field's directions.
        correlated: noise that is correlated over the order of rows.
        angles: directions of the diffuse field, of a half sphere where all places are in one plane.
        rows: measurements that powers are learned on at most; `Effort.term_rows` in `initialise`.
        tied: directions whose powers depend on the angle to the end as well, of a half sphere where flat.
        narrow: concentration of each of these.
        knots: in that angle.
        mirrors: planes that several static ends share, at most; 0 for none.
    """

    constant: bool = True
    direct: bool = True
    directions: bool = True
    correlated: bool = True
    angles: int = 24
    rows: int = 400
    tied: int = 64
    narrow: float = 16.0
    knots: int = 9
    mirrors: int = 8


@dataclass(frozen=True)
class Candidate:
    """Terms with their powers, and how well they do.

    Attributes:
        nll: negative log marginal likelihood [nats], the same rows for all candidates, plus what the
            parameters must gain.
        errors: squared errors, left out one by one and in the cells of `DEPTHS`, relative to the power.
    """

    values: Values
    nll: float
    errors: np.ndarray

    def beats(self, other: Candidate) -> bool:
        """Whether likelihood and left-out places prefer this one."""
        ratio = self.errors / other.errors
        return self.nll < other.nll and bool(np.exp(np.log(ratio).mean()) < BETTER and ratio.max() < NO_WORSE)


def find_terms(
    data: Measurements, rows: np.ndarray, settings: ChannelSettings, budget: TimeBudget
) -> tuple[Values, tuple[str, ...]]:
    """Return the terms with their numbers, and notes about them.

    Args:
        data: kind csi.
        rows: (n,) measurements to learn from.
        settings: terms.
        budget: before it is over no further term is tried, so that there is time for the weights.

    Raises:
        ValueError: the data are no channels of a known carrier with one static end.
    """
    start, factors, notes = _isotropic(data, rows, budget)
    settings = replace(settings, rows=budget.effort.term_rows)
    search = _Search.of(data, rows, settings, start, factors)
    best, more = search.run(budget)
    return best.values, (*notes, *more)


def _isotropic(data: Measurements, rows: np.ndarray, budget: TimeBudget) -> tuple[Values, Tensor, list[str]]:
    """Envelope and noise on the grid of `complex_gp`, and the factors of runs, as measured."""
    groups = gather(data, rows, False)
    looked = thinned(groups, 8, budget.effort.chosen_on)
    runs = 1 if data.run is None else len(np.unique(data.run[rows]))
    wavelength = 2 * math.pi / groups[0].slot.wavenumber
    tried: list[tuple[float, Tensor, float, float]] = []
    for length in LENGTHS:
        bounded = [plain(g.places, g.places, g.slot.wavenumber, length * wavelength) for g in looked]
        for noise in NOISES:
            if tried and budget.over():
                break
            tried.append((*_grid_point(looked, bounded, noise, runs), length * wavelength, noise))
    _, factors, length, noise = min(tried, key=lambda t: t[0])
    everywhere = torch.cat([group.places for group in groups])
    extent = float(torch.linalg.vector_norm(everywhere.max(0).values - everywhere.min(0).values))
    values = Values(
        angles=torch.zeros(0, 3, dtype=torch.float64),
        concentration=CONCENTRATION,
        constant=False,
        direct=False,
        correlated=False,
        middle=everywhere.mean(0),
        reach=BEYOND * max(extent, wavelength),
        power=torch.tensor([1.0, noise], dtype=torch.float64),
        envelope=torch.tensor(length).double(),
        gain=torch.tensor(GAINS[0] * wavelength).double(),
        offset=torch.zeros(3, dtype=torch.float64),
    )
    note = f"waves: isotropic field, envelope {length:.3g} m, noise {noise:.0e} of its power"
    return values, factors, [note]


def _grid_point(
    groups: tuple[Group, ...], kernels: list[Tensor], noise: float, runs: int
) -> tuple[float, Tensor]:
    """Negative log likelihood with profiled scales, and factors of runs as measured."""
    solved = [Factor.of(kernel + noise * torch.eye(len(kernel), dtype=kernel.dtype)) for kernel in kernels]
    factors, nll = run_factors_of(groups, solved, runs), 0.0
    for group, factor in zip(groups, solved, strict=True):
        target = group.target / factors[group.run][:, None]
        count, outputs = target.shape
        fit = Conditioned(factor, target, factor.solved(target)).scale
        nll += outputs * (count * math.log(max(fit, 1e-300)) + float(factor.log_determinant))
        nll += 2 * outputs * float(factors.abs().log()[group.run].sum())
    return nll, factors


def _strongest(values: Values) -> Values:
    """What all directions have in common, and weak ones, made part of the isotropic field."""
    power, numbers = values.power, values.where("direction")
    beyond = power[numbers] - power[numbers].min()
    everywhere = power[values.where("isotropic") + numbers].sum()
    strong = beyond > WEAKEST * everywhere
    isotropic_power = everywhere - beyond[strong].sum()
    rest = power[len(numbers) + 1 :]
    powers = torch.cat([isotropic_power[None], beyond[strong], rest])
    return replace(values, angles=values.angles[strong], power=powers)


def _groupings(places: Tensor) -> list[Grouping]:
    """Rows (n,) left out one by one, then in the cells of each of `DEPTHS`."""
    deep = [groups_of(cells(places.numpy(), depth)) for depth in DEPTHS]
    return [None, *(groups if len(groups) < len(places) else None for groups in deep)]


def _left_out(part: Compressed, power: Tensor) -> np.ndarray:
    """Squared errors (1 + depths, n) of rows left out one by one and in cells."""
    errors = left_out(part, power, _groupings(part.group.places))
    return np.stack([error.abs().square().mean(1).numpy() for error in errors])


@dataclass(frozen=True)
class _Search:
    """What every candidate of a fit has in common."""

    settings: ChannelSettings
    groups: tuple[Group, ...]
    every: tuple[Group, ...]
    start: Values
    wavelength: float
    cache: Cache = field(default_factory=dict)

    @staticmethod
    def of(
        data: Measurements,
        rows: np.ndarray,
        settings: ChannelSettings,
        start: Values,
        factors: Tensor,
    ) -> _Search:
        every = gather(data, rows, True)
        every = tuple(normalised(replace(g, target=g.target / factors[g.run][:, None])) for g in every)
        groups = thinned(every, COLUMNS, settings.rows)
        if not compressible(groups[0], start):
            groups = thinned(every, DENSE_COLUMNS, min(settings.rows, DENSE_ROWS))
        wavelength = 2 * math.pi / every[0].slot.wavenumber
        return _Search(settings, groups, every, start, wavelength)

    def run(self, budget: TimeBudget) -> tuple[Candidate, list[str]]:
        """The terms that are kept, and notes; what the seconds end is as if it had not been tried."""
        notes: list[str] = []
        steps = [self._measured(self.start, self._compressed(self.start))]
        try:
            with cancelled_by(budget.over):
                self._grow(steps, notes)
        except Cancelled:
            notes.append("waves: the time limit ended the search for terms")
        return steps[-1], notes

    def _grow(self, steps: list[Candidate], notes: list[str]) -> None:
        """Append what each further term makes of the last of `steps`."""
        wanted = self.settings

        def step(after: Candidate, name: str) -> None:
            steps.append(self._step(steps[-1], after, name, notes))

        step(self._fitted(self.start), "powers by likelihood")
        one_end = self.one_end  # where both move, what waves have in common is not known
        known = all(bool(torch.isfinite(group.slot.end).all()) for group in self.groups)
        direct = (known or not one_end) and wanted.direct
        if direct or (wanted.constant and one_end):
            step(self._with_fixed(steps[-1], direct), "leakage and direct wave")
        if wanted.mirrors and steps[-1].values.direct and ends_of(self.every) > 1:
            mirrored = self._with_mirrors(steps[-1])
            if mirrored is not None:
                step(mirrored, f"mirror planes of all ends ({len(mirrored.values.planes)})")
        if wanted.directions and one_end:
            step(self._with_directions(steps[-1]), "directions")
        if ends_of(self.every) > 1:
            self._of_all_ends(steps, known, notes)
        if wanted.correlated:
            steps.append(self._with_drift(steps[-1], notes))

    def _step(self, before: Candidate, after: Candidate, name: str, notes: list[str]) -> Candidate:
        keep = after.beats(before)
        ratio = after.errors / before.errors
        gain = (before.nll - after.nll) / sum(group.target.numel() for group in self.groups)
        notes.append(
            f"waves: {name} {'kept' if keep else 'dropped'}: {gain:+.3f} nats per channel, left-out error of "
            f"rows, small and large cells times {ratio[0]:.3f}, {ratio[1]:.3f}, {ratio[2]:.3f}"
        )
        return after if keep else before

    def _compressed(self, values: Values) -> tuple[Compressed, ...]:
        return compressed(self.groups, values, self.cache)

    def _measured(self, values: Values, parts: tuple[Compressed, ...]) -> Candidate:
        """With what left-out rows say."""
        own = [part.own(values.power, values.towards) for part in parts]
        errors = np.mean(
            [_left_out(part, power).mean(1) for part, power in zip(parts, own, strict=True)], axis=0
        )
        nll = evidence(parts, values) + self._worth(values)
        return Candidate(values, nll, errors)

    def _fitted(self, values: Values) -> Candidate:
        """With powers of largest evidence; measured."""
        parts = self._compressed(values)
        return self._measured(fit_powers(parts, values, SHRINKAGE)[0], parts)

    def _worth(self, values: Values) -> float:
        """What the terms beside the isotropic field must gain [nats]."""
        parameters = (
            len(values.names) - 2 + values.direct + 3 * bool(values.offset.any()) + len(values.towards)
        )
        parameters += 3 * len(values.planes)
        numbers = sum(2 * group.target.numel() for group in self.groups)
        return 0.5 * parameters * math.log(numbers)

    @property
    def one_end(self) -> bool:
        """Whether one end stands."""
        return self.every[0].places.shape[1] == 3

    def _with_fixed(self, before: Candidate, direct: bool) -> Candidate:
        """With leakage and the direct wave; lengths by a short fit each, then powers."""
        old = before.values
        values = replace(old, constant=self.settings.constant and self.one_end, direct=direct)
        powers = {name: float(old.of(name).sum()) for name in old.names}
        start = [powers.get(name, NEW * powers["isotropic"]) for name in values.names]
        values = replace(values, power=torch.tensor(start, dtype=torch.float64))
        tried: list[tuple[Values, float]] = []
        for bound in sorted({float(values.envelope), LENGTHS[-1] * self.wavelength}):
            for gain in GAINS if direct else GAINS[:1]:
                envelope, vary = (torch.tensor(each).double() for each in (bound, gain * self.wavelength))
                trial = replace(values, envelope=envelope, gain=vary)
                tried.append(fit_powers(self._compressed(trial), trial, 0.0, SHORT))
        return self._moved(self._fitted(min(tried, key=lambda each: each[1])[0]))

    def _moved(self, candidate: Candidate) -> Candidate:
        """With static ends where they really are."""
        values = candidate.values
        if not values.direct or not self.one_end:
            return candidate
        offset = best_offset(self._compressed(values), values, self.wavelength)
        if offset is None:
            return candidate
        moved = self._fitted(replace(values, offset=offset))
        return moved if moved.nll < candidate.nll else candidate

    def _with_mirrors(self, before: Candidate) -> Candidate | None:
        """With images in planes that all ends share; None where none is found."""
        values = before.values
        rough = replace(self, groups=thinned(self.every, ROUGH_ENDS, ROUGH_ROWS))._compressed(values)
        wide = replace(self, groups=thinned(self.every, ENDS, self.settings.rows))
        parts = wide._compressed(values)
        most = self.settings.mirrors
        planes, sequences = find_mirrors(rough, parts, values, self.wavelength, most)
        if not sequences:
            return None
        power, end = values.power, values.where("noise")[0]
        level = NEW * float(values.of("isotropic")[0])
        fresh = torch.full((2 * len(sequences),), level, dtype=torch.float64)
        power = torch.cat([power[:end], fresh, power[end:]])
        mirrored = replace(values, sequences=sequences, planes=planes, power=power)
        return self._without_weak(self._fitted(mirrored))

    def _without_weak(self, candidate: Candidate) -> Candidate:
        """Without the images that have no power."""
        values, power = candidate.values, candidate.values.power
        fixed, varying = (torch.tensor(values.where(name)) for name in ("source", "source_smooth"))
        heard = power[fixed] + power[varying] > LEAST * power.sum()
        if bool(heard.all()) or not bool(heard.any()):
            return candidate
        silent = {*fixed[~heard].tolist(), *varying[~heard].tolist()}
        rest = power[[i for i in range(len(power)) if i not in silent]]
        seen = tuple(one for one, has in zip(values.sequences, heard.tolist(), strict=True) if has)
        return self._fitted(replace(values, sequences=seen, power=rest))

    def _with_directions(self, before: Candidate) -> Candidate:
        """With unequal powers of directions, which start equal; weak ones are told from none no longer."""
        values = self._directed(before, self.settings.angles, CONCENTRATION)
        parts = self._compressed(values)
        errors = self._crossed(parts, values)
        values, _ = fit_powers(parts, values, SHRINKAGE, 2 * SHORT)
        after = self._fitted(_strongest(values))
        return replace(after, errors=np.maximum(after.errors, errors))

    def _of_all_ends(self, steps: list[Candidate], known: bool, notes: list[str]) -> None:
        """Offset and powers from all ends; directions' powers by their angles to ends, where that gains."""
        wide, before = replace(self, groups=thinned(self.every, ENDS, self.settings.rows)), steps[-1]
        steps.append(wide._fitted(before.values))
        steps.append(wide._moved(steps[-1]))
        if known and self.settings.directions:
            steps.append(
                wide._step(steps[-1], wide._with_tied(steps[-1]), "directions by angles to ends", notes)
            )

    def _with_tied(self, before: Candidate) -> Candidate:
        """With powers of directions that depend on room and angle to the end, all equal at first."""
        values = self._directed(before, self.settings.tied, self.settings.narrow)
        towards = torch.zeros(self.settings.knots, dtype=torch.float64)
        return self._fitted(replace(values, towards=towards))

    def _directed(self, before: Candidate, count: int, concentration: float) -> Values:
        """With so many directions in place of those there are, of equal powers."""
        group, old, power = max(self.groups, key=len), len(before.values.angles), before.values.power
        angles = directions(group.places, group.slot.wavenumber, count)
        level = float(power[: 1 + old].sum())
        fresh = torch.tensor([0.3 * level] + [0.7 * level / len(angles)] * len(angles)).double()
        power = torch.cat([fresh, power[1 + old :]])
        return replace(before.values, angles=angles, concentration=concentration, power=power)

    def _crossed(self, parts: tuple[Compressed, ...], values: Values) -> np.ndarray:
        """Errors as `Candidate`'s, of rows that had no part in the powers they are predicted with."""
        number = [cells(part.group.places.numpy(), DEPTHS[0]) % FOLDS for part in parts]
        errors = np.zeros(1 + len(DEPTHS))
        for fold in range(FOLDS):
            in_fold = [np.equal(each, fold) for each in number]
            rest = tuple(
                without(part, torch.from_numpy(left)) for part, left in zip(parts, in_fold, strict=True)
            )
            power = fit_powers(rest, values, SHRINKAGE, 2 * SHORT)[0].power
            for part, left in zip(parts, in_fold, strict=True):
                errors += _left_out(part, power)[:, left].sum(1) / len(left) / len(parts)
        return errors

    def _with_drift(self, before: Candidate, notes: list[str]) -> Candidate:
        groups = drift.contiguous_rows(self.every)
        known = signals(groups, before.values)
        values, gain = drift.with_drift(groups, known, before.values)
        errors = np.zeros((2, 1 + len(DEPTHS)))
        for group, signal in zip(groups, known, strict=True):
            for sums, at in zip(errors, (before.values, values), strict=True):
                other = disturbance(at, group).to(torch.complex128)
                given = Conditioned.of(signal + other, group.target)
                left = [given.left_out_signal(other, rows)[0] for rows in _groupings(group.places)]
                sums += [float(error.abs().square().mean()) / len(groups) for error in left]
        worth = math.log(sum(2 * group.target.numel() for group in groups))  # of two powers
        after = Candidate(values, worth - gain, errors[1])
        start = replace(before, nll=0.0, errors=errors[0])
        return after if self._step(start, after, "noise correlated over rows", notes) is after else before
