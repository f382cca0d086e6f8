"""Powers of many ends given rows: one factorisation for each end, and one of what they share.

The covariance is a block for each end plus columns that all share: with A = L L^T of an end and V = L^-1 C of
its columns, the weights' precision is I + sum V^T V (M. A. Woodbury, "Inverting modified matrices", 1950).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.models.powers.together.prior import Prior, restored_prior
from gsparc.models.powers.together.rows import Heard
from gsparc.processes.censored import ConditionalGaussian, propagate
from gsparc.processes.factor import Factor
from gsparc.processes.left_out import left_out

NEVER = -1  # in place of a station's number: one that was never heard


@dataclass(frozen=True)
class End:
    """Rows of one station before anything is concluded.

    Attributes:
        station: its number.
        moving, still: (n, 3) float64 [m].
        decades: (n,) see `SiteLaw`.
        shadows: (n, N) see `Prior.shadows`.
        values: (n,) less the law's mean [dB]; pseudo-values where nothing was heard.
        extra: (n,) variance of pseudo-values beyond the noise [dB^2]; 0 where something was heard.
    """

    station: int
    moving: Tensor
    still: Tensor
    decades: Tensor
    shadows: Tensor
    values: Tensor
    extra: Tensor

    @classmethod
    def of(cls, rows: Heard, station: int, prior: Prior) -> End:
        """Rows of one station, all as if they were heard."""
        part = rows.at(np.flatnonzero(rows.station == station))
        moving, still = torch.from_numpy(part.moving), torch.from_numpy(part.still)
        decades = prior.law.decades(moving, still)
        values = torch.from_numpy(part.decibels) - prior.law.mean(decades)
        shadows = prior.shadows(moving, still)
        return cls(station, moving, still, decades, shadows, values, torch.zeros_like(values))

    def gram(self, prior: Prior, lacks: Tensor) -> Tensor:
        """Covariance (n, n) without the shared columns [dB^2]."""
        terms = prior.law.terms(self.decades)
        total = prior.process(self.station, self.moving, self.moving) + terms @ terms.T
        return total + torch.diag_embed(prior.noise(self.station) + lacks + self.extra)


@dataclass(frozen=True)
class Factored:
    """An end's covariance, factored.

    Attributes:
        factor: of the covariance (n, n) without the shared columns.
        whitened: (n, P) columns, `lower`^-1 of them.
        values: (n,) likewise.
    """

    factor: Factor
    whitened: Tensor
    values: Tensor

    @classmethod
    def of(cls, end: End, prior: Prior) -> Factored:
        """Under a prior, with autograd.

        Raises:
            NotPositiveDefiniteError: the covariance is not positive definite.
        """
        columns, lacks = prior.shared(end.moving, end.decades, end.shadows)
        factor = Factor.of(end.gram(prior, lacks), "raise")
        both = factor.whitened(torch.cat([columns, end.values[:, None]], 1))
        return cls(factor, both[:, :-1], both[:, -1])


def weights_of(factored: list[Factored]) -> tuple[Factor, Tensor]:
    """Factor of the precision (P, P) of the shared weights, and their mean (P,)."""
    first = factored[0].whitened
    precision = torch.eye(first.shape[1], dtype=first.dtype)
    right = first.new_zeros(first.shape[1])
    for one in factored:
        precision = precision + one.whitened.T @ one.whitened
        right = right + one.whitened.T @ one.values
    factor = Factor.of(precision, "raise")
    return factor, factor.solved(right[:, None])[:, 0]


def left_out_of(one: Factored, shared: Factor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Errors (n,) [dB] of an end's rows, each predicted from all others, and their variances (n,) [dB^2]."""
    root = one.factor.root
    known = shared.whitened((root.T @ one.whitened).T)
    precision = root.square().sum(0) - known.square().sum(0)
    return left_out(precision, root.T @ (one.values - one.whitened @ mean))


@dataclass
class Posterior:
    """What rows say.

    Attributes:
        prior: the settings, without gradients.
        ends: by station.
        weights: by station, (n,) of the covariances with its rows.
        shared: factor of the precision (P, P) of the shared weights.
        mean: (P,) of these.
        whole: variance of what was measured, of all ends [dB^2].
    """

    prior: Prior
    ends: dict[int, End]
    weights: dict[int, Tensor]
    shared: Factor
    mean: Tensor
    whole: float
    _factored: dict[int, Factored] = field(default_factory=dict, repr=False)

    @torch.no_grad()
    def answer(self, moving: Tensor, still: Tensor, station: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mean [dB], variance of a measurement [dB^2], its share of the prior's, and what is explained [dB].

        Explained is the law with what the site shares.

        Args:
            moving, still: (B, 3) float64 [m].
            station: its number; negative where it was never heard.
        """
        prior = self.prior
        decades = prior.law.decades(moving, still)
        columns, lacks = prior.shared(moving, decades, prior.shadows(moving, still))
        explained, end = prior.law.mean(decades) + columns @ self.mean, self.ends.get(station)
        terms = prior.law.terms(decades)
        own = terms.square().sum(1) + lacks + prior.variance(station if end is not None else NEVER)
        if end is None:
            left = own + self._weights_variance(columns)
            return explained, left, (left / self.whole).clamp_max(1.0), explained
        one = self._factor(station)
        cross = prior.process(station, moving, end.moving) + terms @ prior.law.terms(end.decades).T
        mean = explained + cross @ self.weights[station]
        white = one.factor.whitened(cross.T)
        left = (own - white.square().sum(0)).clamp_min(0.0)
        left = left + self._weights_variance(columns - white.T @ one.whitened)
        return mean, left, (left / self.whole).clamp_max(1.0), explained

    @torch.no_grad()
    def mean_of(self, moving: Tensor, still: Tensor, station: int) -> Tensor:
        """The mean alone (B,) [dB], without factorising anything."""
        prior = self.prior
        decades = prior.law.decades(moving, still)
        columns, _ = prior.shared(moving, decades, prior.shadows(moving, still))
        mean, end = prior.law.mean(decades) + columns @ self.mean, self.ends.get(station)
        if end is None:
            return mean
        cross = prior.process(station, moving, end.moving)
        return (
            mean + (cross + prior.law.terms(decades) @ prior.law.terms(end.decades).T) @ self.weights[station]
        )

    @torch.no_grad()
    def left_out(self) -> dict[int, tuple[Tensor, Tensor]]:
        """By station errors (n,) [dB] of rows that were heard, each from all others, and variances [dB^2]."""
        found = {}
        for number, end in self.ends.items():
            error, variance = left_out_of(self._factor(number), self.shared, self.mean)
            loud = end.extra == 0
            found[number] = error[loud], variance[loud]
        return found

    def shared_alone(self) -> Posterior:
        """What it says of ends that were never heard, without the rows."""
        return replace(self, ends={}, weights={}, _factored={})

    def state(self) -> dict[str, Any]:
        """Tensors that `restored_posterior` needs."""
        ends = {
            str(number): {
                "moving": end.moving,
                "still": end.still[:1],
                "values": end.values,
                "extra": end.extra,
            }
            for number, end in self.ends.items()
        }
        weights = {str(number): value for number, value in self.weights.items()}
        return {
            "prior": self.prior.state(), "ends": ends, "weights": weights, "lower": self.shared.lower,
            "mean": self.mean, "whole": self.whole,
        }  # fmt: skip

    def _weights_variance(self, columns: Tensor) -> Tensor:
        return self.shared.whitened(columns.T).square().sum(0)

    def _factor(self, station: int) -> Factored:
        if station not in self._factored:
            self._factored[station] = Factored.of(self.ends[station], self.prior)
        return self._factored[station]


def restored_posterior(state: dict[str, Any]) -> Posterior:
    """The posterior whose `state()` this was."""
    prior = restored_prior(state["prior"])
    ends = {}
    for name, part in state["ends"].items():
        moving = part["moving"]
        still = part["still"].expand(len(moving), 3)
        shadows = prior.shadows(moving, still)
        decades = prior.law.decades(moving, still)
        ends[int(name)] = End(int(name), moving, still, decades, shadows, part["values"], part["extra"])
    weights = {int(name): value for name, value in state["weights"].items()}
    return Posterior(prior, ends, weights, Factor(state["lower"]), state["mean"], float(state["whole"]))


@torch.no_grad()
def given(rows: Heard, prior: Prior) -> tuple[Posterior, tuple[str, ...], list[np.ndarray]]:
    """The posterior given rows, what must be said of silent ones, and which of the rows each end kept."""
    factored, ends, kept, notes = {}, {}, [], []
    for number in rows.stations:
        own = np.flatnonzero(rows.station == number)
        end = End.of(rows, number, prior)
        if rows.silent[own].any():
            end, used = _with_pseudo_values(end, rows.silent[own], prior)
            own = own[used]
        ends[number], factored[number] = end, Factored.of(end, prior)
        kept.append(own)
    if rows.silent.any():
        notes.append(f"{int(rows.silent.sum())} rows where nothing was heard are below their level")
    shared, mean = weights_of(list(factored.values()))
    weights = {
        number: one.factor.root.T @ (one.values - one.whitened @ mean) for number, one in factored.items()
    }
    loud = rows.decibels[~rows.silent] if not rows.silent.all() else rows.decibels
    whole = max(float(loud.var()), float(prior.variance(NEVER)))
    return Posterior(prior, ends, weights, shared, mean, whole, factored), tuple(notes), kept


def _with_pseudo_values(end: End, silent: np.ndarray, prior: Prior) -> tuple[End, np.ndarray]:
    """An end with pseudo-values where nothing was heard, and its rows that say anything.

    They follow from its own rows, with the shared terms as the prior has them.
    """
    columns, lacks = prior.shared(end.moving, end.decades, end.shadows)
    gram = end.gram(prior, lacks) + columns @ columns.T
    values, extra, quiet = end.values.clone(), torch.zeros_like(end.values), torch.from_numpy(silent)
    unit = float(gram.diagonal().mean().sqrt())
    known, level = ConditionalGaussian.of(gram / unit**2, values / unit, quiet), values[quiet] / unit
    near = known.uncertain(level)
    at = quiet.nonzero()[near, 0]
    if len(at):
        sites = propagate(known.at(near), level[near])
        values[at], extra[at] = unit * sites.value, unit**2 * sites.variance
    used = torch.cat([(~quiet).nonzero()[:, 0], at]).sort().values
    parts = (end.moving, end.still, end.decades, end.shadows, values, extra)
    return End(end.station, *(part[used] for part in parts)), used.numpy()
