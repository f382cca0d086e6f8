"""A process of powers given very many rows: each place is predicted from the rows nearest to it.

A. V. Vecchia, "Estimation and model identification for continuous spatial processes", J. R. Stat. Soc. B 50
(1988); A. Datta et al., "Hierarchical nearest-neighbor Gaussian process models for large geostatistical
datasets", JASA 111 (2016): near rows screen far ones, so that a density given all rows is nearly that given
the nearest. The mean law's terms, which reach everywhere, are weighed once on rows that cover the site.
Rows of one place are their mean, with the noise of that mean, which loses nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, pdist
from torch import Tensor

from gsparc.methods.covering import covering
from gsparc.methods.neighbourhood import NEIGHBOURS, Neighbourhood
from gsparc.methods.power_kernel import PowerKernel
from gsparc.methods.trend import REACH, Trend, trend_of
from gsparc.methods.vecchia import Sample, most_likely, weights_of

COVER = 20_000  # rows that weigh the mean law
FIRST = 256  # rows of an ordering that condition on each other alone
ARRAYS = ("values", "noise", "weights", "covariance")  # of a process
BLOCK = 1_024  # systems solved at a time: memory
LOOKED_AT = 1_200  # places whose density given their neighbours chooses the settings
SHORTER = (0.3, 0.03)  # lengths that a search starts from beside the longest, of that


@dataclass(frozen=True)
class Values:
    """Places, each once, and what was measured there.

    Attributes:
        places: (n, 3) or (n, 6) float64 [m].
        decibels: (n,) mean over the rows of a place [dB].
        count: (n,) rows of each place.
    """

    places: np.ndarray
    decibels: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, places: np.ndarray, decibels: np.ndarray) -> Values:
        """Of rows (n, D), (n,)."""
        alone, group, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        return cls(alone, np.bincount(group.reshape(-1), decibels) / count, count)


@dataclass(frozen=True)
class NearestProcess:
    """A fitted process; answers as `PowerProcess` does.

    Attributes:
        trend, kernel: the prior.
        places: (n, 3) or (n, 6) float64 [m].
        values: (n,) less the mean law [dB].
        noise: (n,) variance of each value, of the amplitude.
        weights, covariance: (P,) [dB] and (P, P), of the amplitude, of the mean law's terms.
        spread: variance of the rows that were heard, of the amplitude.
    """

    trend: Trend
    kernel: PowerKernel
    near: Neighbourhood
    values: np.ndarray
    noise: np.ndarray
    weights: np.ndarray
    covariance: np.ndarray
    spread: float

    approximation = f"Vecchia {NEIGHBOURS}"

    @property
    def places(self) -> np.ndarray:
        """(n, 3) or (n, 6) float64 [m]."""
        return self.near.places

    def mean_and_variance(self, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `PowerProcess.mean_and_variance`."""
        mean, left, near = self._answers(queries, None)
        whole = max(self.spread, 1 + self.kernel.noise)
        by_law = 1 - (1 + self.kernel.noise) / whole
        unknown = left / whole + by_law * (1 - np.exp(-((near / self._reach) ** 2)))
        return mean, self.kernel.amplitude * left, np.minimum(unknown, 1.0)

    def mean_at(self, queries: Tensor) -> Tensor:
        """See `PowerProcess.mean_at`; which rows are nearest has no gradient."""
        return torch.cat([self._answer(part, None)[0] for part in queries.split(BLOCK)])

    def left_out(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean [dB] and variance of a measurement [dB^2] at each place (n,) without its own."""
        mean, left, _ = self._answers(self.places, np.arange(len(self.places)))
        return mean, self.kernel.amplitude * left

    def _answers(self, queries: np.ndarray, without: np.ndarray | None) -> tuple[np.ndarray, ...]:
        parts = []
        with torch.no_grad():
            for start in range(0, len(queries), BLOCK):
                block = slice(start, start + BLOCK)
                own = None if without is None else without[block]
                parts.append(self._answer(torch.from_numpy(queries[block]), own))
        return tuple(torch.cat(part).numpy() for part in zip(*parts, strict=True))

    def _answer(self, queries: Tensor, without: np.ndarray | None) -> tuple[Tensor, Tensor, Tensor]:
        """Mean [dB], variance of a measurement, of the amplitude, distance to the nearest row, each (b,)."""
        row, far = self.near.nearest(queries.detach().numpy(), without)
        near = torch.from_numpy(self.places[row])
        weights, known = weights_of(self.kernel, queries, near, torch.from_numpy(self.noise[row]))
        about = torch.from_numpy(self.weights)
        terms, own = self._terms(near), self.trend.terms(queries)
        rest = torch.from_numpy(self.values[row]) - terms @ about
        mean = self.trend.mean(queries) + own @ about + (weights * rest).sum(1)
        unsure = own - torch.einsum("bk,bkp->bp", weights, terms)
        left = 1 + self.kernel.noise - known + ((unsure @ torch.from_numpy(self.covariance)) * unsure).sum(1)
        return mean, left.clamp_min(0.0), torch.from_numpy(far)

    def _terms(self, near: Tensor) -> Tensor:
        return self.trend.terms(near.flatten(0, 1)).view(*near.shape[:2], -1)

    @cached_property
    def _reach(self) -> float:
        return max(float(np.linalg.norm(np.ptp(self.places, axis=0))) * REACH, 1e-9)

    def state(self) -> dict[str, Any]:
        """Tensors and numbers that `restored` needs."""
        arrays = {"places": self.places, "level": self.near.level, **{a: getattr(self, a) for a in ARRAYS}}
        stored = {name: torch.from_numpy(value) for name, value in arrays.items()}
        return {**self.trend.state(), **self.kernel.state(), "spread": self.spread, **stored}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> NearestProcess:
        """The process whose `state()` this was."""
        near = Neighbourhood(state["places"].numpy(), state["level"].numpy())
        arrays = {name: state[name].numpy() for name in ARRAYS}
        trend, kernel = trend_of(state), PowerKernel.of(state)
        return cls(trend, kernel, near, spread=float(state["spread"]), **arrays)


def given(
    values: Values, trend: Trend, kernel: PowerKernel, silent: Values | None, extra: np.ndarray, seed: int
) -> NearestProcess:
    """The process given places, with settings as they are.

    Args:
        values: where something was heard, at least one place.
        trend, kernel: the prior.
        silent: pseudo-values of places where nothing was.
        extra: (m,) their variances beyond the noise, of the amplitude.
        seed: of rows that weigh the mean law.
    """
    noise, every = kernel.noise / values.count, values
    if silent is not None:
        noise = np.concatenate([noise, kernel.noise + extra])
        both = zip(vars(values).values(), vars(silent).values(), strict=True)
        every = Values(*(np.concatenate(pair) for pair in both))
    less = every.decibels - trend.mean(torch.from_numpy(every.places)).numpy()
    near = Neighbourhood.of(every.places, seed)
    chosen = covering(every.places, COVER, seed)
    weights, covariance = weighed(every.places[chosen], less[chosen], noise[chosen], trend, kernel, seed)
    middle = np.average(values.decibels, weights=values.count)
    spread = np.average((values.decibels - middle) ** 2, weights=values.count) / kernel.amplitude
    return NearestProcess(trend, kernel, near, less, noise, weights, covariance, float(spread))


@torch.no_grad()
def weighed(
    places: np.ndarray, values: np.ndarray, noise: np.ndarray, trend: Trend, kernel: PowerKernel, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean (P,) and covariance (P, P) of the mean law's terms, the prior's being the unit matrix.

    Rows in random order condition on their nearest ones in the half before them: what is left of them is
    white, and of the terms too.

    Args:
        places, values, noise: (m, D), (m,), (m,) as in `NearestProcess`.
        trend, kernel: the prior.
        seed: of the order.
    """
    order = np.random.default_rng(seed).permutation(len(places))
    places, noise = places[order], noise[order]
    at = torch.from_numpy(places)
    both = torch.cat([torch.from_numpy(values[order])[:, None], trend.terms(at)], 1)
    first = min(FIRST, len(places))
    gram = torch.from_numpy(kernel.correlation(cdist(places[:first], places[:first])))
    gram.diagonal().add_(torch.from_numpy(noise[:first]))
    white = [torch.linalg.solve_triangular(torch.linalg.cholesky(gram), both[:first], upper=False)]
    start = first
    while start < len(places):
        tree, end = cKDTree(places[:start]), min(2 * start, len(places))
        for a in range(start, end, BLOCK):
            block = slice(a, min(a + BLOCK, end))
            _, row = tree.query(places[block], k=np.arange(1, min(NEIGHBOURS, tree.n) + 1))
            shares, known = weights_of(kernel, at[block], at[row], torch.from_numpy(noise[row]))
            left = (1 + torch.from_numpy(noise[block]) - known).sqrt()
            white.append((both[block] - torch.einsum("bk,bkp->bp", shares, both[row])) / left[:, None])
        start = end
    flat = torch.cat(white)
    terms, rest = flat[:, 1:], flat[:, 0]
    covariance = torch.linalg.inv(terms.T @ terms + torch.eye(terms.shape[1], dtype=terms.dtype))
    return (covariance @ (terms.T @ rest)).numpy(), covariance.numpy()


def settings_of(values: Values, trend: Trend, start: PowerKernel, seed: int) -> tuple[PowerKernel, str]:
    """The kernel most likely by rows that cover the site, given their neighbours, and what is to be said.

    Neighbours are looked for among all places, among an eighth of them, and so on: what is near shows the
    short length, what is sparse the long one.

    Args:
        values: where something was heard.
        trend: the mean law.
        start: chosen on few rows.
        seed: of what is drawn.
    """
    count = len(values.places)
    if count <= NEIGHBOURS:
        return start, f"settings of {count} places, as they were"
    chosen = covering(values.places, COVER, seed)
    less = values.decibels - trend.mean(torch.from_numpy(values.places)).numpy()
    noise = start.noise / values.count[chosen]
    about, _ = weighed(values.places[chosen], less[chosen], noise, trend, start, seed)
    level = Neighbourhood.of(values.places, seed).level
    sets = [np.flatnonzero(level <= number) for number in range(int(level.max()) + 1)]
    parts = []
    for own in sets:
        row = own[covering(values.places[own], LOOKED_AT // len(sets), seed)]
        tree = cKDTree(values.places[own])  # the nearest of all is the row itself
        parts.append(own[tree.query(values.places[row], k=NEIGHBOURS + 1)[1]])
    rows = np.concatenate(parts)
    places = torch.from_numpy(values.places[rows])
    rest = torch.from_numpy(less[rows]) - trend.terms(places.flatten(0, 1)).view(*rows.shape, -1) @ (
        torch.from_numpy(about)
    )
    counts = torch.from_numpy(values.count[rows]).double()
    between = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    sample = Sample(
        between[:, 0, 1:], between[:, 1:, 1:], rest[:, 0], rest[:, 1:], counts[:, 0], counts[:, 1:]
    )
    scale = pdist(values.places[sets[0][:: -(-len(sets[0]) // LOOKED_AT)]])
    long, shares = start.lengths[-1], (0.5, 0.5)
    starts = [PowerKernel((long * share, long), shares, start.noise, 1.0) for share in SHORTER]
    if len(start.lengths) == 2:
        starts.append(start)
    kernel = most_likely(starts, sample, scale)
    said = f"settings chosen on {len(rows)} of {count} places, each given its nearest {NEIGHBOURS}"
    return kernel, f"{said} among {' and '.join(str(len(own)) for own in sets)}"
