"""Which terms a field of channels has, and their powers, from training rows.

The isotropic process comes first, chosen as `model=complex_gp` chooses. Every further term is kept
where the marginal likelihood gains more than its parameters are worth (G. Schwarz, "Estimating the
dimension of a model", Ann. Statist. 6 (1978)) and rows are predicted better without their
neighbours: each alone, in 32 cells of nearby places and in 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.models.channels import drift
from gsparc.models.channels.columns import (
    Group,
    count_static_ends,
    fit_run_factors,
    group_channels,
    thin_groups,
)
from gsparc.models.channels.complex_gp import LENGTHS, choose_waves
from gsparc.models.channels.evidence import (
    BasisGroup,
    Grouping,
    compress_groups,
    fit_powers,
    left_out_errors,
    negative_log_evidence,
    normalise_power,
)
from gsparc.models.channels.kernels import number_cells_by_bisection, spread_directions
from gsparc.models.channels.mirrors import find_mirrors
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.probe import find_static_offset
from gsparc.models.channels.terms import Direct, Directions, Images, Isotropic, Leakage, Noise
from gsparc.models.channels.terms.compressed import Cache
from gsparc.models.channels.terms.term import Frame
from gsparc.models.run_factors import RunFactors
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.left_out import rows_of_groups
from gsparc.processes.places import ORIGIN, has_both_ends
from gsparc.training.effort import Effort

BEYOND = 10.0  # extents of the places after which nothing is known any more
COLUMNS = 8  # static ends, antennas or bands of tones that terms are decided on at most
ENDS = 64  # of several static ends, those that powers are learned on in the end
CONCENTRATION = 8.0  # of each direction, that of a von Mises-Fisher density
SHRINKAGE = 0.5  # of directions' powers towards their mean, in rows of the inverse Gamma prior
# Rows that tell factors of runs: two degrees from those of 2,400, in a third of the time
ALIGNED = 1_500
DEPTHS = (5, 3)  # cells of places are halved this often: 32 of them, and 8
GAINS = (1.5, 6.0)  # wavelengths, candidates of the length over which a source's gain varies
LEAST = 1e-3  # of all powers: sources below are dropped
SHARED = 0.3  # of the power, what directions have in common before they are learned
NEW = 0.2  # of the isotropic field's power, where that of a new term starts
SHORT = 8  # steps of a fit that compares lengths, or that is followed by another
ROUGH_ENDS, ROUGH_ROWS = 12, 150  # that planes are looked for with, before all ends say which it is
# Learned on where places are so far apart that nothing can be compressed
DENSE_ROWS, DENSE_COLUMNS = 300, 2
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
        rows: measurements that powers are learned on at most; `Effort.term_rows` in `find_terms`.
        tied: directions whose powers depend on the angle to the end as well, of a half sphere where
            flat.
        narrow: concentration of each of these.
        knots: in that angle.
        mirrors: planes that several static ends share, at most; 0 for none.
    """

    constant: bool = True
    direct: bool = True
    directions: bool = True
    correlated: bool = True
    angles: int = 24
    rows: int = Effort.term_rows
    tied: int = 64
    narrow: float = 16.0
    knots: int = 9
    mirrors: int = 8


@dataclass(frozen=True)
class TermCandidate:
    """Terms with their powers, and how well they do.

    Attributes:
        nll: negative log marginal likelihood [nats], the same rows for all candidates, plus what
            the parameters must gain.
        errors: squared errors, left out one by one and in the cells of `DEPTHS`, relative to the
            power.
    """

    prior: ChannelPrior
    nll: float
    errors: np.ndarray

    def beats(self, other: TermCandidate) -> bool:
        """Tell whether likelihood and left-out places prefer this one."""
        ratio = self.errors / other.errors
        return self.nll < other.nll and bool(
            np.exp(np.log(ratio).mean()) < BETTER and ratio.max() < NO_WORSE
        )


def find_terms(
    data: Measurements, rows: np.ndarray, settings: ChannelSettings, effort: Effort
) -> tuple[ChannelPrior, tuple[str, ...]]:
    """Return the terms with their numbers, and notes about them.

    Args:
        data: kind csi.
        rows: (n,) measurements to learn from.
        settings: terms.
        effort: rows that numbers are learned on.

    Raises:
        ValueError: the data are no channels of a known carrier with one static end.
    """
    start, factors, note = _fit_isotropic(data, rows, effort)
    all_groups = group_channels(data, rows, True)
    all_groups = tuple(
        normalise_power(replace(g, target=g.target / factors[g.run][:, None])) for g in all_groups
    )
    most = effort.term_rows
    groups, cache = thin_groups(all_groups, COLUMNS, most), Cache()
    if compress_groups(groups[:1], start, cache)[0].is_uncompressed:
        groups = thin_groups(all_groups, DENSE_COLUMNS, min(most, DENSE_ROWS))
    notes, wavelength = [note], 2 * math.pi / all_groups[0].slot.wavenumber
    search = _Search(replace(settings, rows=most), groups, all_groups, wavelength, cache)
    steps = [search._measure(start, search._compress(start))]
    search.add_terms(steps, notes)
    return steps[-1].prior, tuple(notes)


def estimate_run_factors(data: Measurements, rows: np.ndarray, effort: Effort) -> RunFactors:
    """Return the factor of each run of channels at rows (n,), by the waves that explain them."""
    # Directions turn factors by a degree and double the seconds.
    few = ChannelSettings(directions=False, correlated=False, mirrors=0)
    prior, _ = find_terms(data, rows, few, effort)
    groups = thin_groups(group_channels(data, rows, True), COLUMNS, ALIGNED)
    both = zip(prior.signal_covariances(groups), groups, strict=True)
    runs = np.unique(data.runs_of(rows))
    factors, _ = fit_run_factors(
        groups, [a + prior.disturbance(group) for a, group in both], len(runs)
    )
    return RunFactors(runs, factors)


def _fit_isotropic(
    data: Measurements, rows: np.ndarray, effort: Effort
) -> tuple[ChannelPrior, Tensor, str]:
    """Envelope and noise on the grid of `complex_gp`, the factors of runs, as measured,
    and a note.
    """
    groups = group_channels(data, rows, False)
    looked = thin_groups(groups, COLUMNS, effort.chosen_on)
    runs = len(np.unique(data.runs_of(rows)))
    wavelength = 2 * math.pi / looked[0].slot.wavenumber
    kernel, factors = choose_waves(looked, runs)
    length, noise = kernel.length, kernel.noise
    everywhere = torch.cat([group.places for group in groups])
    extent = float(torch.linalg.vector_norm(everywhere.max(0).values - everywhere.min(0).values))
    reach, none = BEYOND * max(extent, wavelength), ORIGIN
    frame = Frame(everywhere.mean(0), reach, length, GAINS[0] * wavelength, none)
    ones = torch.ones(1, dtype=torch.float64)
    note = f"waves: isotropic field, envelope {length:.3g} m, noise {noise:.2g} of its power"
    return ChannelPrior((Isotropic(frame, ones), Noise(frame, noise * ones))), factors, note


def _drop_weak_directions(prior: ChannelPrior) -> ChannelPrior:
    """What all directions have in common, and weak ones, made part of the isotropic field."""
    isotropic, directions = prior[Isotropic], prior[Directions]
    beyond = directions.power - directions.power.min()
    everywhere = isotropic.power + directions.power.sum()
    strong = beyond > WEAKEST * everywhere
    return prior.with_terms(
        replace(isotropic, power=everywhere - beyond[strong].sum()),
        replace(directions, angles=directions.angles[strong], power=beyond[strong]),
    )


def _left_out_groupings(places: Tensor) -> list[Grouping]:
    """Rows (n,) left out one by one, then in the cells of each of `DEPTHS`."""
    deep = [rows_of_groups(number_cells_by_bisection(places.numpy(), depth)) for depth in DEPTHS]
    return [None, *(groups if len(groups) < len(places) else None for groups in deep)]


def _left_out_squares(part: BasisGroup, prior: ChannelPrior) -> np.ndarray:
    """Mean squared errors (1 + depths,) of rows left out one by one and in cells."""
    errors = left_out_errors(part, part.powers(prior), _left_out_groupings(part.group.places))
    return np.stack([error.abs().square().mean().numpy() for error in errors])


@dataclass(frozen=True)
class _Search:
    """What every candidate of a fit has in common."""

    settings: ChannelSettings
    groups: tuple[Group, ...]
    every: tuple[Group, ...]
    wavelength: float
    cache: Cache

    def add_terms(self, steps: list[TermCandidate], notes: list[str]) -> None:
        """Append what each further term makes of the last of `steps`."""
        wanted = self.settings

        def append_better(after: TermCandidate, name: str) -> None:
            steps.append(self._choose(steps[-1], after, name, notes))

        append_better(self._refit(steps[-1].prior), "powers by likelihood")
        one_end = self.has_static_end  # where both move, what waves have in common is not known
        has_places = all(bool(torch.isfinite(group.slot.end).all()) for group in self.groups)
        direct = (has_places or not one_end) and wanted.direct
        if direct or (wanted.constant and one_end):
            append_better(
                self._add_leakage_and_direct(steps[-1], direct), "leakage and direct wave"
            )
        if (
            wanted.mirrors
            and steps[-1].prior.find_term(Direct)
            and count_static_ends(self.every) > 1
        ):
            mirrored = self._add_mirrors(steps[-1])
            if mirrored is not None:
                append_better(
                    mirrored, f"mirror planes of all ends ({len(mirrored.prior[Images].planes)})"
                )
        if wanted.directions and one_end:
            append_better(self._add_directions(steps[-1]), "directions")
        if count_static_ends(self.every) > 1:
            self._refit_on_all_ends(steps, has_places, notes)
        if wanted.correlated:
            steps.append(self._add_drift(steps[-1], notes))

    def _choose(
        self, before: TermCandidate, after: TermCandidate, name: str, notes: list[str]
    ) -> TermCandidate:
        keep = after.beats(before)
        ratio = after.errors / before.errors
        gain = (before.nll - after.nll) / sum(group.target.numel() for group in self.groups)
        notes.append(
            f"waves: {name} {'kept' if keep else 'dropped'}: error times {ratio[0]:.3f} at "
            "left-out rows, "
            f"{ratio[1]:.3f} and {ratio[2]:.3f} in small and large squares; "
            f"log likelihood {gain:+.3f} a channel"
        )
        return after if keep else before

    def _compress(self, prior: ChannelPrior) -> tuple[BasisGroup, ...]:
        return compress_groups(self.groups, prior, self.cache)

    def _measure(self, prior: ChannelPrior, parts: tuple[BasisGroup, ...]) -> TermCandidate:
        """With what left-out rows say."""
        errors = np.mean([_left_out_squares(part, prior) for part in parts], axis=0)
        numbers = sum(2 * group.target.numel() for group in self.groups)
        # What the terms beside the isotropic field must gain [nats].
        worth = 0.5 * (sum(term.count_learned for term in prior.terms) - 2) * math.log(numbers)
        return TermCandidate(prior, negative_log_evidence(parts, prior) + worth, errors)

    def _refit(self, prior: ChannelPrior) -> TermCandidate:
        """With powers of largest evidence; measured."""
        parts = self._compress(prior)
        return self._measure(fit_powers(parts, prior, SHRINKAGE)[0], parts)

    @property
    def has_static_end(self) -> bool:
        """Whether one end stands."""
        return not has_both_ends(self.every[0].places)

    def _add_leakage_and_direct(self, before: TermCandidate, direct: bool) -> TermCandidate:
        """With leakage and the direct wave; lengths by a short fit each, then powers."""
        prior, frame = before.prior, before.prior.frame
        level = NEW * prior[Isotropic].power
        if self.settings.constant and self.has_static_end:
            prior = prior.with_terms(Leakage(frame, level))
        if direct:
            prior = prior.with_terms(Direct(frame, level.repeat(2)))
        fits: list[tuple[ChannelPrior, float]] = []
        for bound in sorted({frame.envelope, LENGTHS[-1] * self.wavelength}):
            for gain in GAINS if direct else GAINS[:1]:
                trial = prior.change_frame(envelope=bound, gain=gain * self.wavelength)
                fits.append(fit_powers(self._compress(trial), trial, 0.0, SHORT))
        return self._move_static_ends(self._refit(min(fits, key=lambda each: each[1])[0]))

    def _move_static_ends(self, candidate: TermCandidate) -> TermCandidate:
        """With static ends where they really are."""
        prior = candidate.prior
        if prior.find_term(Direct) is None or not self.has_static_end:
            return candidate
        offset = find_static_offset(self._compress(prior), prior, self.wavelength)
        if offset is None:
            return candidate
        moved = self._refit(prior.change_frame(offset=offset))
        return moved if moved.nll < candidate.nll else candidate

    def _add_mirrors(self, before: TermCandidate) -> TermCandidate | None:
        """With images in planes that all ends share; None where none is found."""
        prior = before.prior
        rough = replace(self, groups=thin_groups(self.every, ROUGH_ENDS, ROUGH_ROWS))._compress(
            prior
        )
        wide = replace(self, groups=thin_groups(self.every, ENDS, self.settings.rows))
        most = self.settings.mirrors
        planes = find_mirrors(rough, wide._compress(prior), prior, self.wavelength, most)
        if not len(planes):
            return None
        images = Images.from_planes(prior.frame, planes, NEW * float(prior[Isotropic].power))
        mirrored = self._refit(prior.with_terms(images))
        images, power = mirrored.prior[Images], mirrored.prior.power
        heard = images.power.view(2, -1).sum(0) > LEAST * power.sum()
        if bool(heard.all()) or not bool(heard.any()):
            return mirrored
        heard_images = replace(
            images, power=images.power[heard.repeat(2)], planes=images.planes[heard]
        )
        return self._refit(mirrored.prior.with_terms(heard_images))

    def _add_directions(self, before: TermCandidate) -> TermCandidate:
        """With unequal powers of directions, which start equal;
        weak ones are told from none no longer.
        """
        prior = self._set_directions(before.prior, self.settings.angles, CONCENTRATION)
        prior, _ = fit_powers(self._compress(prior), prior, SHRINKAGE, 2 * SHORT)
        return self._refit(_drop_weak_directions(prior))

    def _refit_on_all_ends(self, steps: list[TermCandidate], known: bool, notes: list[str]) -> None:
        """Offset and powers from all ends; directions' powers by their angles to ends,
        where that gains.
        """
        wide = replace(self, groups=thin_groups(self.every, ENDS, self.settings.rows))
        steps.append(wide._refit(steps[-1].prior))
        steps.append(wide._move_static_ends(steps[-1]))
        if known and self.settings.directions:
            setup = self.settings
            tied = wide._refit(
                self._set_directions(steps[-1].prior, setup.tied, setup.narrow, setup.knots)
            )
            steps.append(wide._choose(steps[-1], tied, "directions by angles to ends", notes))

    def _set_directions(
        self, prior: ChannelPrior, count: int, concentration: float, knots: int = 0
    ) -> ChannelPrior:
        """With so many directions in place of those there are, of equal powers and factors."""
        group, isotropic, old = (
            max(self.groups, key=len),
            prior[Isotropic],
            prior.find_term(Directions),
        )
        angles = spread_directions(group.places, group.slot.wavenumber, count)
        level = isotropic.power if old is None else isotropic.power + old.power.sum()
        power = ((1 - SHARED) * level / len(angles)).repeat(len(angles))
        towards = torch.zeros(knots, dtype=torch.float64)
        fresh = Directions(
            prior.frame, power, angles=angles, concentration=concentration, towards=towards
        )
        return prior.with_terms(replace(isotropic, power=SHARED * level), fresh)

    def _add_drift(self, before: TermCandidate, notes: list[str]) -> TermCandidate:
        groups = drift.sample_stretches(self.every)
        signals = before.prior.signal_covariances(groups)
        prior, gain = drift.fit_drift(groups, signals, before.prior)
        errors = np.zeros((2, 1 + len(DEPTHS)))
        for group, signal in zip(groups, signals, strict=True):
            for sums, at in zip(errors, (before.prior, prior), strict=True):
                other = at.disturbance(group).to(torch.complex128)
                gp = Conditioned.from_gram(signal + other, group.target)
                residuals = [
                    gp.left_out_signal(other, rows)[0] for rows in _left_out_groupings(group.places)
                ]
                sums += [float(error.abs().square().mean()) / len(groups) for error in residuals]
        worth = math.log(sum(2 * group.target.numel() for group in groups))  # of two powers
        after = TermCandidate(prior, worth - gain, errors[1])
        start = replace(before, nll=0.0, errors=errors[0])
        return (
            after
            if self._choose(start, after, "noise correlated over rows", notes) is after
            else before
        )
