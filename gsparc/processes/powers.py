"""Powers in decibels given rows, silent ones included: what a process says of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from gsparc.base.hashes import shuffle_rows
from gsparc.processes.averages import MeanVariance, mixture_moments
from gsparc.processes.censored import CERTAIN, ConditionalGaussian, fit_by_ep
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import covering_rows, first_rows
from gsparc.processes.fit_kernel import KernelRows
from gsparc.processes.kernel import Kernel, distances
from gsparc.processes.nearest import Nearest, PlaceValues, condition_on_nearest
from gsparc.processes.neighbourhood import NEIGHBOURS
from gsparc.processes.posterior import Exact, Posterior
from gsparc.processes.prior import Prior
from gsparc.processes.stored import Stored
from gsparc.processes.trend import Law, Trend

# Whose covariance is factored as one: of more, each place is predicted from the nearest
MOST_ROWS = 6_000
LEAST_SILENT, MOST_SILENT = 200, 3_000  # silent ones of them: no more than were heard, but for few
DOUBTED, LEAST_DOUBTED = 0.5, 30  # silent rows in doubt, for each that was heard, and at least
BOUNDS = {1: "where nothing was heard are below", -1: "in saturation are above"}
REACH = 0.25  # diagonals of the known places, by which a law's confidence falls to 1/e


@dataclass(frozen=True)
class PowerRows:
    """Powers and where they were measured.

    >>> levels, sides = np.array([-60.0, -95.0, -70.0]), np.array([0, 1, 0], np.int8)
    >>> rows = PowerRows(np.zeros((3, 3)), levels, sides)
    >>> rows.silent, len(rows.measured_rows.decibels)  # the second lies below its level
    (array([False,  True, False]), 2)

    Attributes:
        places: (n, 3) of the moving end, or (n, 6) of both [m].
        decibels: (n,) powers, or levels [dB].
        side: (n,) int8, 1 where the power lies below its level, -1 where above, 0 where it was
            measured.
    """

    places: np.ndarray
    decibels: np.ndarray
    side: np.ndarray

    @property
    def silent(self) -> np.ndarray:
        """Rows (n,) bool of which a level is known, not a power."""
        return self.side != 0

    def subset(self, chosen: np.ndarray | slice) -> Self:
        """Return the rows `chosen`."""
        return type(self)(*(part[chosen] for part in vars(self).values()))

    @property
    def measured_rows(self) -> Self:
        """Those that were measured."""
        return self.subset(np.flatnonzero(~self.silent))

    @property
    def heard_rows(self) -> Self:
        """Those that were measured, or all where none was."""
        return self if self.silent.all() else self.measured_rows

    def means_at_places(self) -> PlaceValues:
        """Return means (m, 1) [dB] over the rows of each place."""
        return PlaceValues.from_rows(self.places, torch.from_numpy(self.decibels)[:, None])

    def view(self, trend: Trend, kernel: Kernel | None = None) -> KernelRows:
        """Return the rows [dB] less the mean of a trend and with its terms,
        as a kernel's settings see them.

        Of a `kernel` to which more than distances counts, places (n, D) [m] stand for these.
        """
        places = torch.from_numpy(self.places)
        rest = torch.from_numpy(self.decibels) - trend.mean(places)
        geometry = distances(places, places) if kernel is None or kernel.is_isotropic else places
        return KernelRows(
            geometry, trend.columns(places), rest[:, None], torch.from_numpy(self.side)
        )

    def draw_subset(self, count: int, seed: int) -> Self:
        """Draw at most so many, in their order; at least half of them were heard
        where as many were.
        """
        order = shuffle_rows(seed, self.places, self.decibels)
        return self.subset(first_rows(order, count, np.zeros(len(order)), self.silent))


def trend_about_rows(rows: PowerRows, law: Law | None) -> Trend:
    """Return a trend about a law; about the mean of what was heard where that is None."""
    if law is not None:
        return Trend.from_law(law, torch.from_numpy(rows.places))
    return Trend(float(rows.heard_rows.decibels.mean()))


class PowerAnswer(NamedTuple):
    """What is said of B places.

    Attributes:
        mean: (B,) [dB].
        variance: (B,) of a measurement [dB^2].
        unknown: (B,) in [0, 1].
    """

    mean: Tensor
    variance: Tensor
    unknown: Tensor


@dataclass(frozen=True)
class PowerProcess(Stored):
    """A process of powers given rows, or several whose weighed mean is the answer.

    Attributes:
        posterior: of decibels (P = 1).
        heard: variance of the rows that were heard, of the amplitude.
        others: further processes given the same rows, with their shares; the rest is this one's.
    """

    posterior: Posterior
    heard: float
    others: tuple[tuple[float, PowerProcess], ...] = ()

    @cached_property
    def members(self) -> tuple[tuple[float, PowerProcess], ...]:
        """Every process alone, with its share, this one first."""
        first_share = 1 - sum(share for share, _ in self.others)
        return (first_share, replace(self, others=()) if self.others else self), *self.others

    @property
    def kernel(self) -> Kernel:
        """Kernel of the prior."""
        return self.posterior.prior.kernel

    @property
    def trend(self) -> Trend:
        """Trend of the prior."""
        return self.posterior.prior.known_trend

    @property
    def places(self) -> np.ndarray:
        """Places of the rows (n, 3) or (n, 6) [m]."""
        return self.posterior.places.numpy()

    def answer(self, queries: Tensor, far: Tensor | None = None) -> PowerAnswer:
        """Predict powers at places (B, 3) or (B, 6) [m], `far` (B,)
        from all rows where that is known [m].

        Unknown is the variance as a share of that of the known rows. What the mean law explains of
        them counts as known near them only: its slope says nothing of places far from all data.
        """
        far = self.posterior.nearest_distance(queries) if far is None else far
        if self.others:
            parts = [(share, *member.answer(queries, far)) for share, member in self.members]
            mean, variance = mixture_moments([part[:3] for part in parts])
            return PowerAnswer(
                mean, variance, sum((p[0] * p[3] for p in parts), torch.zeros_like(mean))
            )
        result = self.posterior.answer(queries)
        prior_variance = 1 + self.kernel.noise
        whole = max(self.heard, prior_variance)
        by_law = 1 - prior_variance / whole  # share of that variance
        # What the law explains counts as unknown where no row is near.
        unknown = result.variance / whole + by_law * (
            1 - (-(far / self._trend_reach).square()).exp()
        )
        return PowerAnswer(
            result.mean[:, 0], self.kernel.amplitude * result.variance, unknown.clamp_max(1.0)
        )

    @cached_property
    def _trend_reach(self) -> float:
        return max(self.posterior.extent * REACH, 1e-9)

    def mean_at(self, queries: Tensor) -> Tensor:
        """Return the mean alone (B,) [dB] at (B, 3) or (B, 6) float64 [m], with autograd."""
        return sum(
            (share * member.posterior.mean_at(queries)[:, 0] for share, member in self.members),
            queries.new_zeros(len(queries)),
        )

    def left_out(self, places: np.ndarray, some: np.ndarray | None = None) -> MeanVariance:
        """Return mean [dB] and variance [dB^2] of a measurement at each heard row without its own.

        Args:
            places: (n,) numbers of the rows' places, where the nearest alone are looked at.
            some: numbers (m,) of those that are asked for, among the heard ones; None: all.
        """
        parts = []
        for share, member in self.members:
            exact = member.posterior if isinstance(member.posterior, Exact) else None
            heard = (
                torch.from_numpy(places) if exact is None else (exact.extra == 0).nonzero()[:, 0]
            )
            if some is None:
                mean, variance = (part[heard] for part in member.posterior.left_out())
            else:
                mean, variance = member.posterior.left_out(heard[some])
            parts.append((share, mean[:, 0], member.kernel.amplitude * variance))
        return mixture_moments(parts)

    def with_exact_posterior(self) -> PowerProcess:
        """Return it with covariances between places; of many rows, given some of them."""
        others = tuple((share, part.with_exact_posterior()) for share, part in self.others)
        nearest = self.posterior
        if not isinstance(nearest, Nearest):
            return replace(self, others=others)
        few = covering_rows(self.places, MOST_ROWS, 0)
        places, prior = torch.from_numpy(self.places[few]), nearest.prior
        extra = nearest.noise[few] - prior.kernel.noise
        values = nearest.rest[few] + prior.mean(places)
        exact = Exact.from_values(prior, places, values, extra)
        return replace(self, posterior=exact, others=others)

    @property
    def noise(self) -> float:
        """Variance of a measurement's noise [dB^2]."""
        return sum(share * m.kernel.amplitude * m.kernel.noise for share, m in self.members)

    @torch.no_grad()
    def covariance(self, queries: Tensor) -> Tensor:
        """Return the covariance (B, B) [dB^2] of levels at places (B, 3) or (B, 6) [m]; what
        members disagree about is part of it.
        """
        exact, middle = self.with_exact_posterior(), self.mean_at(queries)
        whole = queries.new_zeros(len(queries), len(queries))
        for share, member in exact.members:
            assert isinstance(member.posterior, Exact)
            off = member.mean_at(queries) - middle
            whole += share * (member.posterior.covariance(queries) + off.outer(off))
        return whole


def rows_in_doubt(rows: PowerRows, prior: Prior) -> PowerRows:
    """Return rows that were heard, and half as many silent ones: those that these leave most in
    doubt.
    """
    view = rows.view(prior.known_trend, prior.kernel)
    gram, values = prior.kernel.amplitude * view.gram(prior.kernel), view.values[:, 0]
    silent = torch.from_numpy(rows.silent)
    most = max(round(DOUBTED * int((~rows.silent).sum())), LEAST_DOUBTED)
    gaussian = ConditionalGaussian.from_gram(gram, values, silent)
    doubt = torch.from_numpy(rows.side)[silent] * gaussian.z_score(values[silent])
    used = ~rows.silent
    used[np.flatnonzero(rows.silent)[doubt.argsort()[:most]]] = True
    return rows.subset(np.flatnonzero(used))


def condition_on_powers(
    rows: PowerRows, prior: Prior, seed: int, least: int = LEAST_SILENT
) -> tuple[PowerProcess, tuple[str, ...]]:
    """Return the process given all rows, and what must be said of the silent ones.

    Args:
        rows: at least one.
        prior: settings as they are.
        seed: of rows that are drawn where there are too many.
        least: silent rows that are used where fewer were heard.
    """
    # Rows of one end, however far the other is, tell of its own shadows: no few are the nearest.
    if len(rows.places) <= MOST_ROWS or rows.silent.all() or not prior.kernel.is_isotropic:
        process, notes = _condition_exactly(rows.draw_subset(MOST_ROWS, seed), prior, least)
        drawn = len(rows.places) > MOST_ROWS and not rows.silent.all()
        remark = f"{MOST_ROWS} of {len(rows.places)} rows, drawn evenly, are learned from"
        return process, (remark,) * drawn + notes
    loud = rows.measured_rows
    values = loud.means_at_places()
    share = values.count / values.count.sum()
    middle = (share * values.values[:, 0]).sum()
    heard = float((share * (values.values[:, 0] - middle).square()).sum()) / prior.kernel.amplitude
    note = (
        f"each place is predicted from the {NEIGHBOURS} nearest of {len(values.places)} (Vecchia)"
    )
    if not rows.silent.any():
        return PowerProcess(condition_on_nearest(prior, values, seed), heard), (note,)
    part = rows.draw_subset(MOST_ROWS, seed)
    few, notes = _condition_exactly(part, prior, least)
    posterior = few.posterior
    assert isinstance(posterior, Exact)
    quiet = posterior.extra > 0
    stand_ins = PlaceValues(
        posterior.rows[quiet].numpy(),
        posterior.given_values()[quiet],
        torch.ones(int(quiet.sum()), dtype=torch.float64),
    )
    of = (
        f"of {int(rows.silent.sum())} censored rows {int(part.silent.sum())}, drawn evenly, are "
        "looked at"
    )
    nearest = condition_on_nearest(prior, values, seed, stand_ins, posterior.extra[quiet])
    return PowerProcess(nearest, heard), (note, of, *notes)


def _condition_exactly(
    rows: PowerRows, prior: Prior, least: int
) -> tuple[PowerProcess, tuple[str, ...]]:
    counts = {phrase: int((rows.side == side).sum()) for side, phrase in BOUNDS.items()}
    notes = [f"{count} rows {phrase} their level" for phrase, count in counts.items() if count]
    places, decibels, extra, factor = _add_pseudo_values(rows, prior, least, notes)
    posterior = Exact.from_values(prior, places, decibels[:, None], extra, factor)
    loud = decibels[extra <= 0]  # below: the mean of several at one place
    heard = float(loud.var(correction=0)) / prior.kernel.amplitude if len(loud) else 0.0
    return PowerProcess(posterior, heard), tuple(notes)


def _add_pseudo_values(
    rows: PowerRows, prior: Prior, least: int, notes: list[str]
) -> tuple[Tensor, Tensor, Tensor, Factor | None]:
    """Places, decibels, extra variances and a factor;
    pseudo-values of the silent rows that say anything.
    """
    places, decibels = torch.from_numpy(rows.places), torch.from_numpy(rows.decibels)
    extra, silent = torch.zeros_like(decibels), torch.from_numpy(rows.silent)
    if not rows.silent.any():
        return places, decibels, extra, None
    deviation, mean = math.sqrt(prior.kernel.amplitude), prior.mean(places)[:, 0]
    gram = prior.cross_covariance(places, places)
    gram.diagonal().add_(prior.kernel.noise)
    # In deviations of the process, as its covariance has amplitude 1.
    unit = (decibels - mean) / deviation
    conditional, level = ConditionalGaussian.from_gram(gram, unit, silent), unit[silent]
    side = torch.from_numpy(rows.side)[silent]
    doubt = side * conditional.z_score(level)
    near = (doubt < CERTAIN).nonzero()[:, 0]
    most = min(max(int((~silent).sum()), least), MOST_SILENT)
    if len(near) > most:
        notes.append(f"{most} of {len(near)} rows near the level are used, the least certain ones")
        # Rows nearest to their level tell most; then back in the order of rows.
        near = near[doubt[near].argsort()[:most].sort().values]
    at = silent.nonzero()[near, 0]
    if len(near):
        sites = fit_by_ep(conditional.marginal(near), level[near], side[near])
        decibels = decibels.index_put((at,), deviation * sites.value + mean[at])
        extra = extra.index_put((at,), sites.variance)
        if not sites.settled:
            notes.append("expectation propagation of these rows did not converge in all sweeps")
    used = torch.cat([(~silent).nonzero()[:, 0], at]).sort().values
    gram = gram[used[:, None], used]
    gram.diagonal().add_(extra[used])
    return places[used], decibels[used], extra[used], Factor.from_gram(gram, "raise")
