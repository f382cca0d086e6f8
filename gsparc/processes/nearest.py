"""A process given very many rows: each place is predicted from the rows nearest to it.

A. V. Vecchia, "Estimation and model identification for continuous spatial processes", J. R. Stat.
Soc. B 50 (1988); A. Datta et al., "Hierarchical nearest-neighbor Gaussian process models for large
geostatistical datasets", JASA 111 (2016): near rows screen far ones, so that a density given all
rows is nearly that given the nearest. The mean law's terms, which reach everywhere, are weighed
once on rows that cover the site. Rows of one place are their mean, with the noise of that mean,
which loses nothing. Settings maximise the density of rows given their nearest ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.spatial.distance import pdist
from torch import Tensor

from gsparc.ops.queries import has_query_kernel, nearest_weights
from gsparc.ops.transforms import to_numpy
from gsparc.processes.averages import MeanVariance, mean_at_places
from gsparc.processes.density import TINY
from gsparc.processes.factor import Factor, NotDefiniteError
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.fit_kernel import LOOKS, SETTLED, fit_kernel
from gsparc.processes.kernel import Kernel, distances
from gsparc.processes.neighbourhood import (
    FEWEST,
    NEIGHBOURS,
    Neighbourhood,
    nearest_distance,
    rows_with_nearest,
)
from gsparc.processes.prior import Posterior, Prior

COVER, FEW = 2_000, 500  # rows that weigh the mean law, where it is to stay, and for choices
ENTRIES = 1_000_000  # of systems and values that are solved with at a time: memory
LOOKED_AT = 1_200  # places whose density given their neighbours chooses the settings
LOOKED_BY = 16  # their neighbours (M. L. Stein et al., J. R. Stat. Soc. B 66 (2004): few will do)
SHORTER = (0.3, 0.03)  # lengths that a search starts from beside the longest, of that
JITTER = 1e-8  # of the amplitude, only so that a system of places millimetres apart can be solved
EXCESS = 20.0  # nats, of an amplitude e times the variance of the values


class KrigingWeights(NamedTuple):
    """Weights (B, k) of near values in the mean at places,
    and what they take off its variance (B,).
    """

    weights: Tensor
    explained_variance: Tensor


def kriging_weights(gram: Tensor, cross: Tensor) -> KrigingWeights:
    """Return weights (B, k) of near values in the mean at places,
    and what they take off its variance (B,).

    Args:
        gram: (B, k, k) covariances of the near values, with their noise.
        cross: (B, k) of the places with them.
    """
    weights = Factor.from_gram(gram, "raise").solve(cross[..., None])[..., 0]
    return KrigingWeights(weights, (weights * cross).sum(-1))


def neighbour_weights(
    kernel: Kernel, places: Tensor, neighbours: Tensor, noise: Tensor
) -> KrigingWeights:
    """Return the same at places (B, D) float64 [m], with autograd, by rows (B, k, D)
    of `noise` (B, k).
    """
    gram = kernel.correlations(neighbours, neighbours)
    gram.diagonal(dim1=-2, dim2=-1).add_(noise + JITTER)
    return kriging_weights(gram, kernel.correlations(places[:, None], neighbours)[:, 0])


@dataclass(frozen=True)
class PlaceValues:
    """Places, each once, and what was measured there.

    >>> rows = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    >>> values = PlaceValues.from_rows(np.zeros((2, 3)), rows)
    >>> values.values, values.count  # two rows of one place
    (tensor([[2.]], dtype=torch.float64), tensor([2.], dtype=torch.float64))

    Attributes:
        places: (n, D) float64 [m].
        values: (n, P) mean over the rows of a place.
        count: (n,) float64, rows of each place.
    """

    places: np.ndarray
    values: Tensor
    count: Tensor

    @classmethod
    def from_rows(cls, places: np.ndarray, values: Tensor) -> PlaceValues:
        """Average rows at (n, D) with values (n, P) over each place."""
        first, mean, count = mean_at_places(places, values.numpy())
        return cls(places[first], torch.from_numpy(mean), torch.from_numpy(count).double())


@dataclass(frozen=True)
class Nearest(Posterior):
    """Given the nearest of n places.

    Attributes:
        prior: see there.
        near: the places.
        rest: (n, P) values less the mean law, float32 or float64.
        noise: (n,) variance of each value.
        terms: (Q, P) and `spread` (Q, Q): weights of the mean law's terms, and their covariance.
        most: neighbours of a place.
    """

    prior: Prior
    near: Neighbourhood
    rest: Tensor
    noise: Tensor
    terms: Tensor
    spread: Tensor
    most: int = NEIGHBOURS

    @property
    def approximation(self) -> str:  # type: ignore[override]
        """See `Posterior`."""
        return f"Vecchia {self.most}"

    @property
    def _block(self) -> int:
        return max(1, ENTRIES // (self.most * (self.most + self.rest.shape[1])))

    @property
    def places(self) -> Tensor:
        """See `Posterior`."""
        return torch.from_numpy(self.near.places)

    def answer(self, queries: Tensor, float64: bool = False) -> MeanVariance:
        """See `Posterior`."""
        return self._answer_blocks(queries, None, float64)

    def mean_at(self, queries: Tensor, float64: bool = False) -> Tensor:
        """See `Posterior`."""
        return torch.cat(
            [self._answer(part, None, float64).mean for part in queries.split(self._block)]
        )

    def left_out(self, rows: Tensor | None = None) -> MeanVariance:
        """See `Posterior`."""
        number = np.arange(len(self.places)) if rows is None else rows.numpy()
        return self._answer_blocks(self.places[number], number)

    def _answer_blocks(
        self, queries: Tensor, excluded: np.ndarray | None, float64: bool = False
    ) -> MeanVariance:
        step = self._block
        blocks = [slice(start, start + step) for start in range(0, len(queries), step)]
        parts = (
            self._answer(queries[b], None if excluded is None else excluded[b], float64)
            for b in blocks
        )
        if len(blocks) < 2 or not has_query_kernel(queries):
            return MeanVariance(*(torch.cat(part) for part in zip(*parts, strict=True)))
        first = next(parts)
        blank = first.mean.new_empty(len(queries), first.mean.shape[1])
        result = MeanVariance(blank, queries.new_empty(len(queries)))
        # Parts kept in a list would lie between freed systems in memory,
        # which then is not used again.
        for block, part in zip(blocks, chain([first], parts), strict=True):
            result.mean[block], result.variance[block] = part.mean, part.variance
        return result

    def _answer(self, queries: Tensor, excluded: np.ndarray | None, float64: bool) -> MeanVariance:
        index = torch.from_numpy(self.near.nearest_rows(to_numpy(queries), excluded, self.most))
        weights, reduction = self._weigh_neighbours(queries, index)
        rest = self.rest[index]
        if float64:
            rest = rest.to(torch.complex128 if rest.is_complex() else torch.float64)
        mean = torch.bmm(weights[:, None].to(rest.dtype), rest)[:, 0]
        variance = 1 + self.prior.kernel.noise - reduction
        if self.prior.trend is not None:
            # What the near rows leave open of the mean law's terms.
            explained = torch.bmm(weights[:, None], self._trend_columns[index])[:, 0]
            unsure = self.prior.columns(queries) - explained
            mean = self.prior.mean(queries) + mean + unsure @ self.terms
            variance = variance + ((unsure @ self.spread) * unsure).sum(1)
        return MeanVariance(mean, variance.clamp_min(0.0))

    def _weigh_neighbours(self, queries: Tensor, index: Tensor) -> KrigingWeights:
        """Of rows (B, k), see `neighbour_weights`."""
        kernel = self.prior.kernel
        if (lengths := kernel.compiled_lengths) and has_query_kernel(queries):
            result = nearest_weights(
                queries, self.places, self._regularised_noise, index, lengths, kernel.shares
            )
            if result is None:
                raise NotDefiniteError("a covariance of near rows is not positive definite")
            return KrigingWeights(*result)
        return neighbour_weights(kernel, queries, self.places[index], self.noise[index])

    @cached_property
    def _trend_columns(self) -> Tensor:
        return self.prior.columns(self.places)

    @cached_property
    def _regularised_noise(self) -> Tensor:
        """Noise (n,) that lets any system be solved; of a million rows, made once."""
        return self.noise + JITTER

    def nearest_distance(self, queries: Tensor) -> Tensor:
        """See `Posterior`."""
        return nearest_distance(self.near.tree, queries)

    def subset(self, chosen: np.ndarray, seed: int) -> Self:
        """Return the same given the places `chosen` alone;
        the mean law's weights stay as all places say.
        """
        near = Neighbourhood.from_places(self.near.places[chosen], seed)
        return replace(self, near=near, rest=self.rest[chosen], noise=self.noise[chosen])


def condition_on_nearest(
    prior: Prior,
    values: PlaceValues,
    seed: int,
    pseudo_values: PlaceValues | None = None,
    pseudo_variance: Tensor | None = None,
    neighbours: int = NEIGHBOURS,
    cover: int = COVER,
) -> Nearest:
    """Return the process given places, with settings as they are.

    >>> line = np.linspace(0.0, 9.0, 10)[:, None]
    >>> values = PlaceValues.from_rows(line, torch.from_numpy(np.sin(line)))
    >>> prior, place = Prior(Kernel.from_length(3.0, 1e-4)), torch.tensor([[4.5]]).double()
    >>> posterior = condition_on_nearest(prior, values, seed=0, neighbours=4)
    >>> posterior.approximation, posterior.answer(place).mean.shape
    ('Vecchia 4', torch.Size([1, 1]))

    Args:
        prior: see there.
        values: at least one place.
        seed: of rows that weigh the mean law.
        pseudo_values: of other places.
        pseudo_variance: (m,) their variances beyond the noise, of the amplitude.
        neighbours: of a place.
        cover: see `trend_mean_and_covariance`.
    """
    # The mean of n measurements has an n-th of their noise.
    noise, all_values = prior.kernel.noise / values.count, values
    if pseudo_values is not None and pseudo_variance is not None:
        noise = torch.cat([noise, prior.kernel.noise + pseudo_variance])
        all_values = PlaceValues(
            np.concatenate([values.places, pseudo_values.places]),
            torch.cat([values.values, pseudo_values.values]),
            torch.cat([values.count, pseudo_values.count]),
        )
    near = Neighbourhood.from_places(all_values.places, seed)
    if prior.trend is None:
        none = torch.zeros(0, all_values.values.shape[1], dtype=torch.float64)
        return Nearest(prior, near, all_values.values, noise, none, none[:, :0], neighbours)
    places = torch.from_numpy(all_values.places)
    rest = all_values.values - prior.mean(places)
    terms, spread = trend_mean_and_covariance(prior, all_values.places, rest, noise, seed, cover)
    return Nearest(prior, near, rest, noise, terms, spread, neighbours)


@torch.no_grad()
def trend_mean_and_covariance(
    prior: Prior, places: np.ndarray, rest: Tensor, noise: Tensor, seed: int, cover: int
) -> tuple[Tensor, Tensor]:
    """Return mean (Q, P) and covariance (Q, Q) of the mean law's terms, unit normal before,
    given some rows.

    Args:
        prior: see there.
        places, rest, noise: (m, D), (m, P), (m,) as in `Nearest`.
        seed: of the rows, which cover the site.
        cover: most of them.
    """
    few = covering_rows(places, cover, seed)
    at, chosen = torch.from_numpy(places[few]), torch.from_numpy(few)
    gram = prior.kernel.correlations(at, at)
    gram.diagonal().add_(noise[chosen])
    columns, outputs = prior.columns(at), rest.shape[1]
    white = Factor.from_gram(gram, "raise").whiten(torch.cat([rest[chosen], columns], 1))
    values, terms = white[:, :outputs], white[:, outputs:]
    # Linear regression on white rows, whose weights have unit variance before.
    precision = Factor.from_gram(terms.T @ terms + torch.eye(terms.shape[1], dtype=terms.dtype))
    return precision.solve(terms.T @ values), precision.inverse


class NeighbourSample(NamedTuple):
    """Rows with their nearest others: each row first, then its neighbours.

    Attributes:
        apart: (T, 1 + k, 1 + k) distances between them [m]; their places (T, 1 + k, D) where more
            counts.
        values: (T, 1 + k, P), less the mean law and its weighed terms; outputs share kernel and
            amplitude.
        counts: (T, 1 + k) rows that each value is the mean of.
        scatter: (T,) sum of squares of the first one's rows about their mean; None: not looked at.
    """

    apart: Tensor
    values: Tensor
    counts: Tensor
    scatter: Tensor | None = None


def nearest_density(
    kernel: Kernel, sample: NeighbourSample, penalty: float = EXCESS
) -> tuple[Tensor, Tensor]:
    """Return the negative log density, mean over rows [nats], and the best amplitude;
    see `EXCESS`.
    """
    covariance, noise = kernel.correlations_of(sample.apart), kernel.noise / sample.counts
    value, near = sample.values[:, 0], sample.values[:, 1:]
    gram = covariance[:, 1:, 1:] + torch.diag_embed(noise[:, 1:] + JITTER)
    weights, reduction = kriging_weights(gram, covariance[:, 0, 1:])
    variance = 1 + noise[:, 0] - reduction
    missed = value - torch.einsum("tk,tkp->tp", weights.to(near.dtype), near)
    squared, spread = missed.abs().square().mean(1) / variance, variance.log().sum()
    count = variance.new_tensor(len(variance))
    if sample.scatter is not None:  # visits again tell of the noise alone
        again = (sample.counts[:, 0] - 1).sum()
        squared, spread = (
            squared + sample.scatter / kernel.noise,
            spread + again * math.log(kernel.noise),
        )
        count = count + again
    amplitude = (squared.sum() / count).clamp_min(TINY)
    # Near rows alone tell no long process of a huge amplitude from one of the values' own.
    excess = (amplitude / value.abs().square().mean().clamp_min(TINY)).log().clamp_min(0.0)
    density = 0.5 * (amplitude.log() + spread / count)
    return density + penalty * excess.square() / len(variance), amplitude


def choose_kernel_by_nearest(
    prior: Prior,
    values: PlaceValues,
    seed: int,
    sparsest: int = FEWEST,
) -> tuple[Kernel, str]:
    """Choose the kernel most likely by rows that cover the site, and say on what it was chosen.

    Neighbours are looked for among all places, among an eighth of them, and so on: what is near
    shows the short length, what is sparse the long one.

    Args:
        prior: mean law, and a kernel chosen on few rows.
        values: where something was heard.
        seed: of what is drawn.
        sparsest: places of a set at least: neighbours in it show long lengths.
    """
    count, start = len(values.places), prior.kernel
    if count <= NEIGHBOURS:
        return start, f"settings of {count} places, as they were"
    places = torch.from_numpy(values.places)
    rest = values.values - prior.mean(places)
    about, _ = trend_mean_and_covariance(
        prior, values.places, rest, start.noise / values.count, seed, FEW
    )
    rest = rest - prior.columns(places) @ about
    level = Neighbourhood.from_places(values.places, seed, sparsest).level
    sets = [np.flatnonzero(level <= number) for number in range(int(level.max()) + 1)]
    parts = []
    for members in sets:
        row = covering_rows(values.places[members], LOOKED_AT // len(sets), seed)
        parts.append(members[rows_with_nearest(values.places[members], row, LOOKED_BY)])
    rows = np.concatenate(parts)
    near = distances(places[rows], places[rows])
    sample = NeighbourSample(near, rest[rows], values.count[rows])
    scale = pdist(values.places[sets[0][:: -(-len(sets[0]) // LOOKED_AT)]])
    long, shares = start.lengths[-1], (0.5, 0.5)
    starts = [Kernel.from_lengths((long * share, long), shares, start.noise) for share in SHORTER]
    if len(start.lengths) == 2:
        starts.append(start)
    given = rows.shape[1] - 1
    among = " and ".join(str(len(members)) for members in sets)
    note = (
        f"settings chosen on {len(rows)} of {count} places, each given its nearest {given} among "
        f"{among}"
    )
    bounds = starts[0].bounds(torch.from_numpy(scale))
    search = starts, bounds, LOOKS, SETTLED / len(rows)
    return fit_kernel(lambda kernel: nearest_density(kernel, sample), *search)[1], note
