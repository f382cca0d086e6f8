"""Several processes that share terms: a factor of each, and one of the weights of what they share.

The covariance is a block for each process plus columns of all: with K = L L^T of a block and V = L^-1 C of
its columns, the weights' precision is I + sum V^T V (M. A. Woodbury, "Inverting modified matrices", 1950).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gsparc.processes.factor import Factor
from gsparc.processes.left_out import left_out
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior

QUERIES = 512  # at a time: memory
ROUNDED_FROM, ROUNDED = 1e-2, 8  # noise, of the amplitude, and queries of a process, for float32 factors


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
    def of(cls, process: Exact, columns: Tensor) -> Block:
        """Whiten a process with shared columns (n, P), in units of the values, at its rows."""
        deviation = deviation_of(process.prior)
        values = (process.factor.lower.T @ process.weights)[:, 0] / deviation
        return cls(process, process.factor.whitened(columns) / deviation, values)

    @cached_property
    def gram(self) -> Tensor:
        """(P, P) that it adds to the precision of the weights."""
        return self.columns.T @ self.columns


@dataclass(frozen=True)
class _Said:
    """What is said of B queries of one process.

    Attributes:
        prior: of the process.
        more: (B,) mean beyond the prior's.
        white: (B, n) root of the variance that its rows take away; None without rows.
        shared: (B, P) root of the variance that the shared weights leave.
    """

    prior: Prior
    more: Tensor
    white: Tensor | None
    shared: Tensor


class Shared:
    """What the rows of several processes say of shared terms, and so of each other.

    Args:
        processes: by number, of one value each; possibly none, of which rows were heard before.
        never: prior of a process without rows, whose trend all have.
        columns: of places (n, D), (n, P) of the shared terms for unit normal weights, possibly none.
        weights: factor of the precision (P, P) of the weights, and their mean (P,); None: of all processes.
    """

    def __init__(
        self,
        processes: Mapping[int, Exact],
        never: Prior,
        columns: Callable[[Tensor], Tensor],
        weights: tuple[Factor, Tensor] | None = None,
    ) -> None:
        self.processes, self.never, self.columns = processes, never, columns
        self._blocks: dict[int, Block] = {}
        self._weights: dict[int, Tensor] = {}
        self.factor, self.mean = weights or weights_of([self.block(number) for number in processes])

    def block(self, number: int) -> Block:
        """Return the block of one process, factored when it is asked for."""
        if number not in self._blocks:
            process = self.processes[number]
            self._blocks[number] = Block.of(process, self.columns(process.rows))
        return self._blocks[number]

    def answer(self, queries: Tensor, number: Tensor, exact: bool = False) -> tuple[Tensor, Tensor]:
        """Return the mean and variance of a measurement, each (B,).

        Args:
            queries: (B, D) float64.
            number: (B,) int64, of the process; one that is not there has no rows.
            exact: whether variances of few queries are of double precision too, as their slopes need it.
        """
        own, columns = self.never.columns(queries), self.columns(queries)
        mean, left = self.never.mean(queries)[:, 0], torch.zeros(len(queries), dtype=torch.float64)
        for one in number.unique().tolist():
            for at in (number == one).nonzero()[:, 0].split(QUERIES):
                said = self._said(queries[at], one, own[at], columns[at], not exact and len(at) <= ROUNDED)
                mean = mean.index_add(0, at, said.more)
                prior = said.prior.kernel.amplitude * said.prior.variance(own[at])
                known = prior if said.white is None else (prior - said.white.square().sum(1)).clamp_min(0.0)
                left = left.index_add(0, at, known + said.shared.square().sum(1))
        return mean, left

    def together(self, queries: Tensor, number: int) -> tuple[Tensor, Tensor]:
        """Return means (B, k) and covariances (B, k, k) of one process's measurements at (B, k, D)."""
        flat, groups = queries.flatten(0, 1), queries.shape[:2]
        own = self.never.columns(flat)
        said = self._said(flat, number, own, self.columns(flat))
        terms, kernel = own.unflatten(0, groups), said.prior.kernel
        left = kernel.between(queries, queries) + terms @ terms.mT
        left = kernel.amplitude * (left + kernel.noise * torch.eye(groups[1], dtype=left.dtype))
        for root, sign in ((said.white, -1), (said.shared, 1)):
            if root is not None:
                each = root.unflatten(0, groups)
                left = left + sign * each @ each.mT
        mean = self.never.mean(flat)[:, 0] + said.more
        return mean.unflatten(0, groups), left

    def _said(
        self, queries: Tensor, number: int, own: Tensor, columns: Tensor, rounded: bool = False
    ) -> _Said:
        """By one process; `own` (B, Q) and `columns` (B, P) are terms at the queries."""
        if number not in self.processes:
            return _Said(self.never, columns @ self.mean, None, self.factor.whitened(columns.T).T)
        block = self.block(number)
        prior = block.process.prior
        cross = deviation_of(prior) * block.process.cross(queries, own)
        factor = block.process.factor
        # With less noise float32's rounding would show in the variance.
        rounded &= prior.kernel.noise >= ROUNDED_FROM
        white = (factor.whitened_rounded if rounded else factor.whitened)(cross.T).T
        if number not in self._weights:
            rest = (block.values - block.columns @ self.mean)[:, None]
            # The rest is whitened: K^-1 L rest = L^-T rest.
            self._weights[number] = factor.solved(factor.lower @ rest)[:, 0]
        more = columns @ self.mean + cross @ self._weights[number]
        if not len(self.mean):
            return _Said(prior, more, white, columns)
        return _Said(prior, more, white, self.factor.whitened((columns - white @ block.columns).T).T)

    @torch.no_grad()
    def left_out(self, number: int) -> tuple[Tensor, Tensor]:
        """Return errors (n,) of a process's rows, each predicted from all others, and variances (n,)."""
        block = self.block(number)
        root = block.process.factor.root / deviation_of(block.process.prior)
        known = self.factor.whitened((root.T @ block.columns).T).square().sum(0)
        rest = block.values - block.columns @ self.mean
        return left_out(root.square().sum(0) - known, root.T @ rest)


def deviation_of(prior: Prior) -> float:
    """Return the deviation of a process [units of its values]."""
    return math.sqrt(prior.kernel.amplitude)


def weights_of(blocks: list[Block]) -> tuple[Factor, Tensor]:
    """Return the factor of the precision (P, P) of the shared weights, and their mean (P,)."""
    size = blocks[0].columns.shape[1]
    # From the identity, the precision of unit normal weights before any row.
    precision = sum((block.gram for block in blocks), torch.eye(size, dtype=torch.float64))
    factor = Factor.of(precision, "raise")
    right = torch.stack([block.columns.T @ block.values for block in blocks]).sum(0)
    return factor, factor.solved(right[:, None])[:, 0]


def left_out_whole(blocks: list[Block]) -> list[tuple[Tensor, Tensor]]:
    """Return errors (n,) of each process's rows predicted from the other processes, and variances.

    With C the covariance of the weights the inverse of a block is `L^-T (1 - V C V^T) L^-1`.
    """
    factor, mean = weights_of(blocks)
    result = []
    for block in blocks:
        known = factor.whitened(block.columns.T)
        lower = block.process.factor.lower * deviation_of(block.process.prior)
        inner = Factor.of(torch.eye(len(lower), dtype=torch.float64) - known.T @ known)
        error = inner.solved((block.values - block.columns @ mean)[:, None])[:, 0]
        result.append((lower @ error, inner.whitened(lower.T).square().sum(0)))
    return result
