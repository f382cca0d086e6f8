"""Smooth images by few numbers: what an array resolves is of low rank in rows and in columns.

An image is `rows @ coefficients @ columns` with orthonormal factors, the two-mode case of Tucker's
decomposition by principal vectors of each mode (De Lathauwer, De Moor and Vandewalle 2000). An 8 x
8 array sees 90 x 360 pixels through 19 x 80 numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Separable:
    """A basis of images.

    Attributes:
        rows: (H, R) float32; orthonormal columns unless of fewer pixels.
        columns: (C, W) float32; orthonormal rows unless of fewer pixels.
    """

    rows: Tensor
    columns: Tensor

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width [pixels]."""
        return len(self.rows), self.columns.shape[1]

    def project(self, images: Tensor) -> Tensor:
        """Return coefficients (n, R * C) of images (n, H, W), by least squares."""
        return ((self.rows.T @ images) @ self.columns.T).flatten(1)

    def images(self, coefficients: Tensor) -> Tensor:
        """Return images (n, H, W) of coefficients (n, R * C)."""
        return self.rows @ (coefficients.unflatten(1, (-1, len(self.columns))) @ self.columns)

    def subsample_pixels(self, stride: int) -> Separable:
        """Return the basis of every `stride`-th pixel; coefficients stay,
        `project` means nothing then.
        """
        return Separable(self.rows[::stride].contiguous(), self.columns[:, ::stride].contiguous())


def fit_separable(blocks: Iterable[Tensor], lost: float) -> Separable:
    """Find the basis in which each mode of images loses at most the share `lost` of their energy.

    >>> basis = fit_separable([torch.ones(5, 3, 4)], lost=1e-6)  # five equal images of 3 x 4 pixels
    >>> basis.rows.shape, basis.columns.shape
    (torch.Size([3, 1]), torch.Size([1, 4]))

    Args:
        blocks: images (n, H, W) in parts; float64 where `lost` is below a float32's rounding.
        lost: in (0, 1).

    Raises:
        ValueError: no images.
    """
    row_gram, column_gram = torch.zeros(()), torch.zeros(())
    for block in blocks:
        flat = block.flatten(0, 1)
        sides = block.transpose(1, 2).flatten(0, 1)
        row_gram, column_gram = (
            row_gram + (sides.T @ sides).double(),
            column_gram + (flat.T @ flat).double(),
        )
    if row_gram.ndim == 0:
        raise ValueError("a basis of images needs images")
    return Separable(
        _main_axes(row_gram, lost).contiguous(), _main_axes(column_gram, lost).T.contiguous()
    )


def separate_axes(
    mean: Tensor, axes: Tensor, shape: tuple[int, int], lost: float
) -> tuple[Separable, Tensor, Tensor]:
    """Return a basis of images, and the mean (K,) and axes (P, K) in it.

    Args:
        mean: (H * W,) float32.
        axes: (P, H * W) float32, each as large as what it explains.
        shape: height and width.
        lost: share of the energy of axes, and of the mean, in (0, 1).
    """
    images, middle = axes.unflatten(1, shape), mean.view(1, *shape)
    alike = middle * (axes.norm() / mean.norm().clamp_min(torch.finfo(mean.dtype).tiny))
    basis = fit_separable([images, alike], lost)
    return basis, basis.project(middle)[0], basis.project(images)


def _main_axes(gram: Tensor, lost: float) -> Tensor:
    """Eigenvectors (P, K) float32 of the largest eigenvalues;
    the others hold at most the share `lost`.
    """
    values, vectors = torch.linalg.eigh(gram)
    # `eigh` sorts upwards: the first whose sum stays below the share are the ones that go.
    tail = values.clamp_min(0).cumsum(0)
    count = int((tail > lost * tail[-1]).sum())
    return vectors[:, len(gram) - max(count, 1) :].flip(1).float()
