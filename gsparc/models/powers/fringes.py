"""Powers of coherent waves where a wavelength is sampled,
averaged over solutions and with a process.

One solution predicts badly, as phases are ambiguous; the mean of many in decibels predicts well,
and half of that and half of the process better (bagging: L. Breiman, Mach. Learn. 24 (1996)). Each
solution is blind to one fold of places, so that rows are predicted by solutions that never saw
their surroundings; a few rows drawn evenly are kept from all solutions and tell how they do between
rows. What share the solutions get is a matter of both,
by least squares (stacking: D. H. Wolpert, Neural Networks 5 (1992)).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gsparc.data.spacing import neighbour_distance
from gsparc.models.powers.groups import SPREAD, number_squares, split_groups
from gsparc.models.powers.waves import FLOOR, PlaneWaveBasis, field_db, fit_wave_weights, make_basis
from gsparc.models.stack import best_weights
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.processes.density import TINY
from gsparc.processes.nearest import condition_on_nearest
from gsparc.processes.places import has_both_ends
from gsparc.processes.powers import MOST_ROWS as FACTORED
from gsparc.processes.powers import PowerRows, condition_on_powers
from gsparc.processes.prior import Posterior, Prior
from gsparc.processes.stored import Stored
from gsparc.processes.trend import TINY_M

FOLDS = 5  # of squares; each solution is blind to one
SIDES = 8  # squares along the longer side
TRIED = 10  # solutions after which it must pay
PROBES = 10  # one row of so many is kept from all solutions
MOST_ROWS = FACTORED // 2  # of one least-squares problem per solution
ROWS_PER_WAVE = 6  # two real unknowns each
BEYOND = (1.0, 2.0)  # wavelengths from all rows between which solutions lose their share


@dataclass(frozen=True)
class Blend(Stored):
    """How solutions and process share a prediction, by the distance to the nearest row.

    Attributes:
        distance: between rows and between groups left out [m].
        share: of the solutions at these two.
        left: squared errors of both together, of the process's alone, at these two.
    """

    distance: tuple[float, float]
    share: tuple[float, float]
    left: tuple[float, float]

    def share_and_inflation(self, distance: Tensor, wavelength: float) -> tuple[Tensor, Tensor]:
        """Return shares (n,) of the solutions, and factors (n,) of the process's variance."""
        near, far = self.distance
        # Linear between the two distances that were measured, constant beyond either.
        there = ((distance - near) / max(far - near, TINY_M)).clamp(0.0, 1.0)
        inside = ((BEYOND[1] - distance / wavelength) / (BEYOND[1] - BEYOND[0])).clamp(0.0, 1.0)
        share = (self.share[0] + (self.share[1] - self.share[0]) * there) * inside
        ratio = self.left[0] + (self.left[1] - self.left[0]) * there
        return share, 1 + (ratio - 1) * inside


@dataclass(frozen=True)
class Fringes(Stored):
    """Solutions, and what they are worth beside a process.

    Attributes:
        basis: of coherent fields.
        weights: (r, S) complex128.
        blind: (S,) the fold that each never saw.
        rows: (n,) rows that were learned, sorted.
        fold: (n,) of each; -1 where no solution saw it.
        level: mean power [dB].
        wavelength: [m].
        blend: with the process.
    """

    basis: PlaneWaveBasis
    weights: np.ndarray
    blind: np.ndarray
    rows: np.ndarray
    fold: np.ndarray
    level: float
    wavelength: float
    blend: Blend

    @cached_property
    def _mixture_weights(self) -> Tensor:
        return torch.from_numpy(self.basis.mixture @ self.weights)

    def solution_powers(self, places: Tensor) -> Tensor:
        """Return powers (n, S) [dB] at places (n, 3) float64 [m], with autograd."""
        phase = places @ torch.from_numpy(self.basis.waves).T
        field = torch.complex(phase.cos(), phase.sin()) @ self._mixture_weights
        return self.level + to_decibels(field.real.square() + field.imag.square() + FLOOR)

    def blend_solutions(
        self, decibels: Tensor, places: Tensor, distance: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return a process's means (n,) [dB] shared with the solutions, and factors (n,)
        of its variance.

        Args:
            decibels: (n,) of the process.
            places: (n, 3) [m].
            distance: (n,) to the nearest row that it knows [m].
        """
        return self._means_and_factors(decibels, self.solution_powers(places).mean(1), distance)

    def blend_blind_solutions(
        self, decibels: Tensor, places: Tensor, distance: Tensor, rows: np.ndarray
    ) -> tuple[Tensor, Tensor]:
        """Return the same at rows (n,) by those solutions that never saw them
        or their surroundings.
        """
        at = np.clip(np.searchsorted(self.rows, rows), 0, len(self.rows) - 1)
        fold = np.where(self.rows[at] == rows, self.fold[at], -1)
        mean = _held_out_mean(self.solution_powers(places).numpy(), fold, self.blind)
        return self._means_and_factors(decibels, torch.from_numpy(mean), distance)

    def _means_and_factors(
        self, decibels: Tensor, mean: Tensor, distance: Tensor
    ) -> tuple[Tensor, Tensor]:
        share, factor = self.blend.share_and_inflation(distance, self.wavelength)
        return decibels + share * (mean - decibels), factor


def resolves_wavelength(places: np.ndarray, wavelength: float | None) -> bool:
    """Tell whether places (n, 3) are closer than half a wavelength to their neighbours,
    most of them.
    """
    if wavelength is None or has_both_ends(places):
        return False
    return 0 < neighbour_distance(places) < wavelength / 2


def fit_fringes(
    rows: PowerRows, numbers: np.ndarray, plain: Prior, wavelength: float, seed: int, most: int
) -> tuple[Fringes | None, str]:
    """Return fringes where they pay beside a process, and what must be said of them.

    Args:
        rows: all heard.
        numbers: (n,) of the rows, sorted.
        plain: of the process.
        wavelength: [m].
        seed: of starts, folds and rows that are drawn.
        most: solutions that are sought.
    """
    rng, total = np.random.default_rng(seed), len(rows.places)
    order, probes = rng.permutation(total), total // PROBES
    count = min(total - probes, MOST_ROWS)
    tail = f" (of {count} of {total} rows)" if count < total - probes else ""
    squares, fold = number_squares(rows.places, SIDES), np.full(total, -1)
    parts = split_groups(squares, FOLDS, seed)
    for k, part in enumerate(parts):
        fold[part] = k
    fold[order[:probes]] = -1
    index = np.sort(order[: probes + count])
    all_rows, rows, numbers, group, fold = (
        rows,
        rows.subset(index),
        numbers[index],
        squares[index],
        fold[index],
    )
    level = float(to_decibels(from_decibels(rows.decibels).mean()))
    basis = make_basis(rows.places[fold >= 0], wavelength)
    columns = basis.columns(rows.places)
    if count < ROWS_PER_WAVE * columns.shape[1]:
        return None, f"no fringes: {count} rows are too few for {columns.shape[1]} coherent waves"
    error, distance = (
        values[index]
        for values in _errors_and_distances(all_rows, [*parts, order[:probes]], plain, seed)
    )
    weights: list[np.ndarray] = []
    fringes: Fringes | None = None
    # Mean of the squared errors at places left out, of the process less those of both [dB^2]
    gain = 0.0
    while len(weights) < most:
        # A solution of every fold a round: all rows have as many that are blind to them.
        for k in range(FOLDS):
            seen = (fold != k) & (fold >= 0)
            weights.append(fit_wave_weights(columns[seen], rows.decibels[seen] - level, rng))
        blind = np.arange(len(weights)) % FOLDS
        powers = level + field_db(columns @ np.stack(weights, 1))
        blend, gain = _fit_blend(rows, group, fold, powers, blind, error, distance)
        fringes = Fringes(
            basis, np.stack(weights, 1), blind, numbers, fold, level, wavelength, blend
        )
        if len(weights) >= TRIED and gain <= 0:
            break
    if fringes is None or gain <= 0:
        return None, (
            f"no fringes: {len(weights)} coherent solutions predict places left out no better{tail}"
        )
    share = " and ".join(f"{value:.0%}" for value in fringes.blend.share)
    note = (
        f"fringes of {columns.shape[1]} coherent waves, {len(weights)} solutions, with "
        f"{share} of the mean"
    )
    return fringes, f"{note} between rows and a block away, the process the rest{tail}"


def _held_out_mean(powers: np.ndarray, fold: np.ndarray, blind: np.ndarray) -> np.ndarray:
    """Means (n,) of powers (n, S) over the solutions blind to each row's fold;
    over all where that is -1.
    """
    counts = _blind_solutions(fold, blind)
    return (powers * counts).sum(1) / counts.sum(1)


def _blind_solutions(fold: np.ndarray, blind: np.ndarray) -> np.ndarray:
    return (fold[:, None] < 0) | (fold[:, None] == blind)


def _excess_variance(powers: np.ndarray, fold: np.ndarray, blind: np.ndarray) -> np.ndarray:
    """Squared error (n,) that the mean of blind solutions has beyond that of
    as many as there are.
    """
    counts = _blind_solutions(fold, blind)
    number, total = counts.sum(1), len(blind)
    mean = (powers * counts).sum(1) / number
    spread = ((powers - mean[:, None]) ** 2 * counts).sum(1) / np.maximum(number - 1, 1)
    # Errors of solutions are independent: the mean of m has variance s^2 / m.
    return spread * (1 / number - 1 / total)


def _errors_and_distances(
    rows: PowerRows, parts: list[np.ndarray], prior: Prior, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n,) of a process at rows of each part without that part, and distances (n,)
    to the rest [m].

    Of all rows, as it will answer: at some of them alone it would seem worse than it is.
    """
    error, distance = np.zeros((2, len(rows.places)))
    if big := len(rows.places) > MOST_ROWS:
        full = condition_on_nearest(prior, rows.means_at_places(), seed)
        at = full.near.tree.query(rows.places)[1]
    for part in parts:
        fit = np.setdiff1d(at, at[part]) if big else np.setdiff1d(np.arange(len(rows.places)), part)
        posterior: Posterior = (
            full.subset(fit, seed)
            if big
            else condition_on_powers(rows.subset(fit), prior, seed)[0].posterior
        )
        places = torch.from_numpy(rows.places[part])
        error[part] = posterior.mean_at(places)[:, 0].numpy() - rows.decibels[part]
        distance[part] = posterior.nearest_distance(places).numpy()
    return error, distance


def _fit_blend(
    rows: PowerRows,
    group: np.ndarray,
    fold: np.ndarray,
    powers: np.ndarray,
    blind: np.ndarray,
    error: np.ndarray,
    distance: np.ndarray,
) -> tuple[Blend, float]:
    """How to share predictions with a process of errors (n,),
    and what that gains at places left out.
    """
    probes = fold < 0
    errors = np.stack([error, _held_out_mean(powers, fold, blind) - rows.decibels], 1)
    gram = errors[:, :, None] * errors[:, None]
    # Less what would go if all solutions answered, as they do at new places.
    gram[:, 1, 1] -= _excess_variance(powers, fold, blind)
    shares, ratios, gains = [], [], []
    # Rows of a square left out err together and count as one; probes among rows err alone.
    for chosen, alike in ((probes, 1.0), (~probes, len(group) / len(np.unique(group)))):
        mean = gram[chosen].mean(0)
        plain = max(float(mean[0, 0]), TINY)
        # A prior of equal shares, of a deviation of `SPREAD`, is an error that each has of its own.
        penalty = plain * alike / chosen.sum() / (2 * SPREAD**2) * np.eye(2)
        weights = best_weights(mean + penalty)
        both = float(weights @ mean @ weights)
        shares.append(float(weights[1]))
        ratios.append(both / plain)
        gains.append(plain - both)
    middle = (float(np.median(distance[probes])), float(np.median(distance[~probes])))
    return Blend(middle, (shares[0], shares[1]), (ratios[0], ratios[1])), gains[1]
