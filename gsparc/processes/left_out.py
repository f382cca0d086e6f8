"""Rows predicted from all others, or from all outside a group (Rasmussen
and Williams 2006, eq. 5.12).

Without a group S its residuals are `(K^-1_SS)^-1 (K^-1 Y)_S`, their covariance `(K^-1_SS)^-1`: a
small system for each group instead of one of all other rows. Systems of many sizes are solved in
batches of the largest, with units where a group has ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gsparc.processes.factor import Factor

ENTRIES = 2_000_000  # of systems solved at a time: memory


class LeftOutErrors(NamedTuple):
    """Residuals (n, R) of rows that were left out, and their variances (n,);
    of a group their covariance.
    """

    residual: Tensor
    variance: Tensor


def left_out_residuals(
    inverse: Tensor, weights: Tensor, groups: Iterable[Tensor] | None = None
) -> LeftOutErrors:
    """Return residuals, shaped as the weights, and their variances (n,).

    >>> inverse = torch.tensor([[2.0, 1.0], [1.0, 2.0]]).inverse()
    >>> residual, variance = left_out_residuals(inverse, inverse @ torch.tensor([[3.0], [3.0]]))
    >>> residual.T, variance
    (tensor([[1.5000, 1.5000]]), tensor([1.5000, 1.5000]))

    Args:
        inverse: `K^-1` (n, n), or its diagonal (n,) where rows are left out one by one.
        weights: `K^-1 Y` (n, ...), real or complex.
        groups: numbers of rows that are left out together, every row in one of them; None: one by
            one.
    """
    if groups is None:
        precision = inverse if inverse.dim() == 1 else inverse.diagonal().real
        return LeftOutErrors(
            weights / precision.view(-1, *[1] * (weights.dim() - 1)), 1 / precision
        )
    residual, variance = torch.empty_like(weights), torch.empty_like(inverse.diagonal().real)
    for _, index, valid, block in _padded_blocks(inverse, list(groups)):
        residual[index[valid]] = block.solve(weights[index])[valid]
        variance[index[valid]] = block.inverse.diagonal(dim1=1, dim2=2).real[valid]
    return LeftOutErrors(residual, variance)


def _padded_blocks(
    inverse: Tensor, sets: Sequence[Tensor]
) -> Iterator[tuple[Tensor, Tensor, Tensor, Factor]]:
    """Yield numbers (c,) of sets of rows, their rows (c, m), which of these are valid,
    and `K^-1` of them.
    """
    size = torch.tensor([len(members) for members in sets])
    order = size.argsort()
    while len(order):
        # The largest that is left, and as many as memory takes with it.
        count = max(ENTRIES // max(int(size[order[-1]]), 1) ** 2, 1)
        part, order = order[-count:], order[:-count]
        index = pad_sequence([sets[number] for number in part.tolist()], batch_first=True)
        valid = torch.arange(index.shape[1]) < size[part, None]
        block = inverse[index[:, :, None], index[:, None]] * (valid[:, :, None] & valid[:, None])
        block.diagonal(dim1=1, dim2=2).add_((~valid).to(block.dtype))
        yield part, index, valid, Factor.from_gram(block)


def left_out_around(inverse: Tensor, weights: Tensor, rows: Tensor, near: Tensor) -> LeftOutErrors:
    """Return residuals (c, R) of rows (c,), each without what is `near` it (c, n) bool,
    and variances.
    """
    residual, variance = weights[rows].clone(), inverse.diagonal()[rows].real.clone()
    for part, index, valid, block in _padded_blocks(
        inverse, [mask.nonzero()[:, 0] for mask in near]
    ):
        unit = ((index == rows[part, None]) & valid).to(inverse.dtype)
        share = block.solve(unit[..., None])[..., 0] * valid
        residual[part] = torch.einsum("cm,cmr->cr", share.to(weights.dtype), weights[index])
        variance[part] = (share * unit).sum(1).real
    return LeftOutErrors(residual, variance)


def left_out_signal(
    inverse: Tensor, weights: Tensor, disturbance: Tensor, groups: Iterable[Tensor] | None = None
) -> tuple[Tensor, Tensor | None]:
    """Return each row less the signal predicted from all others (n, R), and its variance (n,)
    without groups.

    With K = S + N the signal of all rows outside a group is, in it, `y - N K^-1 y - (1 - N K^-1) r`
    with the residual r of `left_out_residuals`:
    what disturbs others by their order alone is not predicted.

    Args:
        inverse, weights, groups: as in `left_out_residuals`.
        disturbance: N (n, n), covariance of what is no signal.
    """
    if groups is None:
        correction = (1 - (disturbance * inverse.mT).sum(1)) / inverse.diagonal()
        rest = disturbance + torch.diag(correction)
        return rest @ weights, (rest * (rest @ inverse).conj()).sum(1).real
    residual, mixed, sets = disturbance @ weights, disturbance @ inverse, list(groups)
    correction, _ = left_out_residuals(inverse, weights, sets)
    for rows in sets:
        residual[rows] += correction[rows] - mixed[rows[:, None], rows] @ correction[rows]
    return residual, None


def rows_of_groups(number: np.ndarray) -> list[Tensor]:
    """Return the rows of each group by their numbers (n,).

    >>> rows_of_groups(np.array([7, 3, 7]))
    [tensor([1]), tensor([0, 2])]
    """
    return [torch.from_numpy(np.flatnonzero(number == value)) for value in np.unique(number)]
