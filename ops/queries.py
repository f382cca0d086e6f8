"""Places answered in one call: an array's spectrum, weights of the nearest rows of a process,
and correlations of waves from many directions.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.operators import contiguous
from gsparc.ops.transforms import is_differentiated


def has_query_kernel(*tensors: Tensor) -> bool:
    """Tell whether the kernels answer: CPU tensors
    that neither autograd nor `torch.func` follows.
    """
    plain = all(part.device.type == "cpu" for part in tensors) and not is_differentiated(*tensors)
    return plain and calls.kernels() is not None


def array_spectrum(
    places: Tensor,
    features: tuple[Tensor, Tensor],
    read_out: tuple[Tensor, Tensor],
    tables: Sequence[Tensor],
    square: Tensor,
    numbers: tuple[float, float, float, float],
) -> tuple[Tensor, Tensor]:
    """Return spectra (B, H, W) in [0, 1] of an array, and unknown shares (B,), at (B, D) [m];
    all float32.

    Args:
        places: where the moving end is.
        features: anchors (E, D) [m], and whitening (E, F) of their correlations.
        read_out: features to real and imaginary parts of array vectors, and an unused pair: (F, 2 M
            + 2), and what is added to them (2 M + 2,).
        tables: pairs of elements to lag numbers (2 M M, L); for pixels that stay half a turn on,
            lag numbers to harmonics of each row (l, H K) and these to pixels (K, columns); the same
            for those that flip, or nothing.
        square: (H, W) of the background that an unknown share shows.
        numbers: share and length [m] of a Matern-5/2, share and length of a Matern-3/2.
    """
    pairs, *rest = tables
    sizes = [(len(table), len(waves)) for table, waves in zip(rest[::2], rest[1::2], strict=True)]
    sizes += [(0, 0)] * (2 - len(sizes))
    height, columns = square.shape[0], rest[1].shape[1]
    image, unknown = places.new_empty(len(places), *square.shape), places.new_empty(len(places))
    # Only planar arrays have the second pair of tables.
    absent = (None,) * (4 - len(rest))
    inputs = contiguous((places, *features, *read_out, pairs, *rest))
    calls.launch(
        "array_spectrum",
        places,
        *inputs,
        *absent,
        square,
        image,
        unknown,
        numbers=numbers,
        sizes=(
            *places.shape,
            *features[1].shape,
            read_out[1].numel() // 2 - 1,
            height,
            columns,
            *sizes[0],
            *sizes[1],
        ),
    )
    return image, unknown


def nearest_weights(
    queries: Tensor,
    places: Tensor,
    noise: Tensor,
    rows: Tensor,
    lengths: Sequence[float],
    shares: Sequence[float],
) -> tuple[Tensor, Tensor] | None:
    """Return weights (B, k) of near rows in a process's mean,
    and what they take off its variance 1 (B,).

    None where a covariance has no Cholesky factor.

    Args:
        queries, places: (B, D) and (n, D) float64 [m].
        noise: (n,) float64, variance of each row's value.
        rows: (B, k) int64, the near ones.
        lengths, shares: of one or two Matern-3/2, of Matern-1/2 where the length is negative [m].
    """
    weights, gains = queries.new_empty(rows.shape), queries.new_empty(len(queries))
    # The kernel sums two: of a single one the second has no share.
    two = [*shares, 0.0][:2] + [*lengths, 1.0][:2]
    inputs = contiguous((queries, places, noise, rows))
    sizes = (*queries.shape, rows.shape[1])
    numbers = (*two, float(len(lengths)))
    failed = calls.launch(
        "nearest_weights", queries, *inputs, weights, gains, sizes=sizes, numbers=numbers
    )
    # -1 where every covariance has a factor.
    return None if failed >= 0 else (weights, gains)


def sum_directional(
    squared: Tensor, before: Tensor, after: Tensor, powers: Tensor, concentration: float
) -> Tensor:
    """Return sums (T, n, m) complex128 of correlations of waves that come from about M directions.

    Args:
        squared: (n, m) float64, (k d)^2 of displacements d.
        before, after: (M, n) and (M, m) float64; their differences are k d's parts towards each.
        powers: (T, M) float64.
        concentration: about each, of a von Mises-Fisher density.
    """
    sums = torch.empty(len(powers), *squared.shape, dtype=torch.complex128)
    inputs = contiguous((squared, before, after, powers))
    sizes = (*squared.shape, *reversed(powers.shape))
    calls.launch("directional", squared, *inputs, sums, sizes=sizes, numbers=(concentration,))
    return sums
