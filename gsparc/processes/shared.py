"""Several processes that share terms: a factor of each, and one of the weights of what they share.

The covariance is a block for each process plus columns of all: with K = L L^T of a block and V =
L^-1 C of its columns, the weights' precision is I + sum V^T V (M. A. Woodbury, "Inverting modified
matrices", 1950).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gsparc.processes.averages import MeanVariance
from gsparc.processes.factor import Factor, whiten_in_float32
from gsparc.processes.left_out import LeftOutErrors, left_out_residuals
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior

QUERIES = 512  # at a time: memory
# Noise, of the amplitude, and queries of a process, for float32 factors
ROUNDED_FROM, ROUNDED = 1e-2, 8


@dataclass(frozen=True)
class Block:
    """One process of n rows of values (n, 1), whitened by its own covariance.

    Attributes:
        process: without the shared terms.
        columns: (n, P) V.
        values: (n,) less their mean.
    """

    process: Exact
    columns: Tensor
    values: Tensor

    @classmethod
    def from_process(cls, process: Exact, columns: Tensor) -> Block:
        """Whiten a process with shared columns (n, P), in units of the values, at its rows."""
        deviation = process_deviation(process.prior)
        # L^T K^-1 y = L^-1 y, for covariances in units of the amplitude.
        values = (process.factor.lower.T @ process.weights)[:, 0] / deviation
        return cls(process, process.factor.whiten(columns) / deviation, values)


class Conditioning(NamedTuple):
    """What S processes of one prior say.

    Attributes:
        prior: of them.
        more: (S, k) mean beyond the prior's.
        white: (k, n) roots of each of the variance that rows take away, none without rows.
        shared: (S, k, P) root of the variance that the shared weights leave.
    """

    prior: Prior
    more: Tensor
    white: list[Tensor]
    shared: Tensor


class SharedTermsPosterior:
    """What the rows of several processes say of shared terms, and so of each other.

    Args:
        processes: by number, of one value each; possibly none, of which rows were heard before.
        never: prior of a process without rows, whose trend all have.
        columns: of places (n, D), (n, P) of the shared terms for unit normal weights, possibly
            none.
        weights: factor of the precision (P, P) of the weights, and their mean (P,); None: of all
            processes.
    """

    def __init__(
        self,
        processes: Mapping[int, Exact],
        never: Prior,
        columns: Callable[[Tensor], Tensor],
        weights: tuple[Factor, Tensor] | None = None,
    ) -> None:
        self.processes, self.never, self.columns = processes, never, columns
        self._alike = len({process.prior.kernel for process in processes.values()}) == 1
        self._blocks: dict[int, Block] = {}
        self._stacks: dict[tuple[tuple[int, ...], torch.dtype], tuple[Tensor, ...]] = {}
        self.factor, self.mean = weights or shared_weights(
            [self.block(number) for number in processes]
        )

    def block(self, number: int) -> Block:
        """Return the block of one process, factored when it is asked for."""
        if number not in self._blocks:
            process = self.processes[number]
            self._blocks[number] = Block.from_process(process, self.columns(process.rows))
        return self._blocks[number]

    def answer(self, queries: Tensor, number: Tensor, float64: bool = False) -> MeanVariance:
        """Return the mean and variance of a measurement, each (B,).

        Args:
            queries: (B, D) float64.
            number: (B,) int64, of the process; one that is not there has no rows.
            float64: whether few queries are answered in double precision too, as slopes need it.
        """
        (mean, term), columns = self.never.mean_and_columns(queries), self.columns(queries)
        mean, variance = mean[:, 0], torch.zeros(len(queries), dtype=torch.float64)
        for who, at in self._group_queries(number):
            prior, more, white, shared = self._condition(
                queries[at], who, term[at], columns[at], not float64
            )
            # -1 stands where a process is asked less often than another of the batch.
            there = at >= 0
            at = at[there]
            spread = prior.kernel.amplitude * prior.variance(term[at])
            if white:
                reduction = torch.stack([root.square().sum(1) for root in white])
                spread = (spread - reduction[there]).clamp_min(0.0)
            mean = mean.index_add(0, at, more[there])
            variance = variance.index_add(0, at, spread + shared.square().sum(2)[there])
        return MeanVariance(mean, variance)

    def predict_joint(self, queries: Tensor, number: int) -> tuple[Tensor, Tensor]:
        """Return means (B, k) and covariances (B, k, k)
        of one process's measurements at (B, k, D).
        """
        flat, groups = queries.flatten(0, 1), queries.shape[:2]
        flat_terms = self.never.columns(flat)
        inputs = flat[None], (number,), flat_terms[None], self.columns(flat)[None]
        prior, more, white, shared = self._condition(*inputs, may_round=False)
        terms, kernel = flat_terms.unflatten(0, groups), prior.kernel
        matrix = kernel.correlations(queries, queries) + terms @ terms.mT
        matrix = kernel.amplitude * (
            matrix + kernel.noise * torch.eye(groups[1], dtype=matrix.dtype)
        )
        # Rows take variance away; weights that are not fully known give some back.
        for root, sign in (*((root, -1) for root in white), (shared[0], 1)):
            each = root.unflatten(0, groups)
            matrix = matrix + sign * each @ each.mT
        mean = self.never.mean(flat)[:, 0] + more[0]
        return mean.unflatten(0, groups), matrix

    def _group_queries(self, number: Tensor) -> Iterator[tuple[tuple[int, ...], Tensor]]:
        """Processes and their queries (S, k), -1 in place of none:
        all at once where each is asked little.
        """
        order = number.argsort(stable=True)
        which, count = number[order].unique_consecutive(return_counts=True)
        numbers, at = which.tolist(), order.split(count.tolist())
        if self._alike and numbers == sorted(self.processes) and max(map(len, at)) <= ROUNDED:
            yield tuple(numbers), pad_sequence(at, batch_first=True, padding_value=-1)
            return
        for station, queries in zip(numbers, at, strict=True):
            yield from (((station,), part[None]) for part in queries.split(QUERIES))

    def _condition(
        self,
        queries: Tensor,
        numbers: tuple[int, ...],
        own_terms: Tensor,
        columns: Tensor,
        may_round: bool,
    ) -> Conditioning:
        """Of processes `numbers` at (S, k, D), own terms (S, k, Q), columns (S, k, P);
        may be in float32.
        """
        more, shared = columns @ self.mean, columns.flatten(0, 1)
        prior, white = self.never, list[Tensor]()
        if numbers[0] in self.processes:
            prior = self.processes[numbers[0]].prior
            # With less noise float32's rounding would show in the variance.
            rounded = (
                may_round and prior.kernel.noise >= ROUNDED_FROM and queries.shape[1] <= ROUNDED
            )
            places, terms, weights = self._stack(
                numbers, torch.float32 if rounded else torch.float64
            )
            near = prior.kernel.correlations(queries.to(places), places)
            cross = process_deviation(prior) * near.baddbmm(own_terms.to(places), terms.mT)
            more = more + (cross @ weights)[..., 0]
            blocks = [self.block(number) for number in numbers]
            factors = [block.process.factor for block in blocks]
            parts = [
                part[:, : len(factor.lower)].T for factor, part in zip(factors, cross, strict=True)
            ]
            if rounded:
                white = [root.T for root in whiten_in_float32(factors, parts)]
            else:
                white = [factor.whiten(part).T for factor, part in zip(factors, parts, strict=True)]
            if len(self.mean):
                projections = [
                    root.double() @ block.columns for root, block in zip(white, blocks, strict=True)
                ]
                shared = shared - torch.cat(projections)
        if len(self.mean):
            shared = self.factor.whiten(shared.T).T
        return Conditioning(prior, more, white, shared.unflatten(0, queries.shape[:2]))

    def _stack(self, numbers: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, ...]:
        """Rows (S, N, D), terms (S, N, Q) and weights (S, N, 1) of processes;
        0 beyond the rows of one.
        """
        if (numbers, dtype) not in self._stacks:
            parts = []
            for number in numbers:
                block, process = self.block(number), self.processes[number]
                rest = (block.values - block.columns @ self.mean)[:, None]
                # The rest is whitened: K^-1 L rest = L^-T rest.
                weights = process.factor.solve(process.factor.lower @ rest)
                parts.append((process.rows, process.prior.columns(process.rows), weights))
            padded = (
                pad_sequence(list(part), batch_first=True) for part in zip(*parts, strict=True)
            )
            self._stacks[numbers, dtype] = tuple(part.to(dtype) for part in padded)
        return self._stacks[numbers, dtype]

    @torch.no_grad()
    def left_out(self, number: int, rows: Tensor | None = None) -> LeftOutErrors:
        """Return errors (n,) of a process's rows, each predicted from all others,
        and variances (n,).

        Of some `rows` (m,) by their numbers, or of all.
        """
        block = self.block(number)
        factor = block.process.factor
        root = (factor.root if rows is None else factor.root_of(rows)) / process_deviation(
            block.process.prior
        )
        # Diagonal of `L^-T (1 - V C V^T) L^-1`, C the covariance of the weights (Woodbury).
        reduction = self.factor.whiten((root.T @ block.columns).T).square().sum(0)
        rest = block.values - block.columns @ self.mean
        return left_out_residuals(root.square().sum(0) - reduction, root.T @ rest)


def process_deviation(prior: Prior) -> float:
    """Return the deviation of a process [units of its values]."""
    return math.sqrt(prior.kernel.amplitude)


def shared_weights(blocks: list[Block]) -> tuple[Factor, Tensor]:
    """Return the factor of the precision (P, P) of the shared weights, and their mean (P,)."""
    size = blocks[0].columns.shape[1]
    # From the identity, the precision of unit normal weights before any row.
    grams = (block.columns.T @ block.columns for block in blocks)
    precision = sum(grams, torch.eye(size, dtype=torch.float64))
    factor = Factor.from_gram(precision, "raise")
    right = torch.stack([block.columns.T @ block.values for block in blocks]).sum(0)
    return factor, factor.solve(right[:, None])[:, 0]


def left_out_processes(blocks: list[Block]) -> list[LeftOutErrors]:
    """Return errors (n,) of each process's rows predicted from the other processes, and variances.

    With C the covariance of the weights the inverse of a block is `L^-T (1 - V C V^T) L^-1`.
    """
    factor, mean = shared_weights(blocks)
    result = []
    for block in blocks:
        white = factor.whiten(block.columns.T)
        lower = block.process.factor.lower * process_deviation(block.process.prior)
        inner = Factor.from_gram(torch.eye(len(lower), dtype=torch.float64) - white.T @ white)
        error = inner.solve((block.values - block.columns @ mean)[:, None])[:, 0]
        result.append(LeftOutErrors(lower @ error, inner.whiten(lower.T).square().sum(0)))
    return result
