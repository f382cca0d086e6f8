"""What later rows miss of a map and of rows before them, of which a test of changes is made."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsparc.processes.changes import (
    CHANGED,
    ERRORS,
    LOCAL,
    OFFSET,
    TINY,
    UNTOLD,
    LaterRows,
    covariance_by_kind,
)
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import distances
from gsparc.processes.matern import matern32

UNSEEN, RARE = 0.1, 1e-12  # rows that a share of none counts as; least probability of a row
TOLD = 16  # earlier rows that tell of the next one


@torch.no_grad()
def innovations(
    rows: LaterRows, first: int, extent: float, changed: bool = False
) -> tuple[Tensor, Tensor]:
    """Return surprises (n,) of rows from `first` on [deviations], and log ratios (n,)
    of a return to the map.

    Each is told of by its nearest earlier rows; surprises are independent and normal. Where a part
    of the place has changed, a row is in it or is not, as likely as rows near it are, so that edges
    surprise little. Ratios are of a world where what lies in it is as the map says,
    to one where it stays as it is.
    """
    kind, count = CHANGED if changed else 0, len(rows)
    new, order = torch.arange(first, count), torch.arange(count)
    distance = distances(rows.places[first:], rows.places)
    distance[order >= new[:, None]] = math.inf
    near = distance.topk(min(TOLD, count), largest=False)
    at, past = rows[new], rows[near.indices]
    unknown = torch.where(near.values.isinf(), UNTOLD, 0.0)  # of the first rows there are fewer
    size, told = OFFSET[kind].square() + LOCAL[kind].square(), past.doubt + past.noise + unknown
    outside = (_log_normal(past.missed, told) - _log_normal(past.missed, told + size)).sigmoid()
    # What is outside tells nothing of the change.
    noise = past.noise + past.faded + unknown + TINY + size * outside / (1 - outside + TINY)
    alike = (extent, 1.0, slice(kind, kind + 1))
    gram = covariance_by_kind(past.places, past.places, past.doubt, past.doubt, *alike)[:, 0]
    gram.diagonal(dim1=-2, dim2=-1).add_(noise)
    cross = covariance_by_kind(
        at.places[:, None], past.places, at.doubt[:, None], past.doubt, *alike
    )[:, 0]
    weights = Factor.from_gram(gram, "raise").solve(cross.mT)[..., 0]
    off = at.missed - (weights * past.missed).sum(1)
    free = at.doubt + at.noise
    variance = (free + size - (weights * cross[:, 0]).sum(1)).clamp_min(TINY)
    surprise = off / variance.sqrt()
    if not changed:
        return surprise, torch.zeros_like(surprise)
    # Of the first rows some neighbours are infinitely far: 0 times infinity is no share.
    close = matern32(near.values, extent * ERRORS).nan_to_num()
    close = close * (told + size) / (told + size + past.faded)
    share = ((close * outside).sum(1) + UNSEEN / 2) / (close.sum(1) + UNSEEN)
    as_mapped, inside = _log_normal(at.missed, free), _log_normal(off, variance)
    density = torch.logaddexp(share.log() + as_mapped, (1 - share).log() + inside)
    below = share * torch.special.ndtr(at.missed / free.sqrt()) + (1 - share) * torch.special.ndtr(
        surprise
    )
    ratio = (share + (1 - share) * (as_mapped - density).exp()).log()
    return torch.special.ndtri(below.clamp(RARE, 1 - RARE)), ratio


def _log_normal(values: Tensor, variance: Tensor) -> Tensor:
    """Log densities of values whose mean is 0, but for a constant."""
    return -0.5 * (values.square() / variance + variance.log())
