"""Principal components of smooth images: inner products from thinned pixels, axes over all of them."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import eigh

from gsparc.methods.gp import Components

ROWS, COLUMNS = 2, 4  # a beam is many pixels wide: thinned images have the same inner products


def components(images: np.ndarray, limit: int) -> Components:
    """The `limit` largest components of images (n, H, W) float32; orthonormal axes over all pixels.

    Inner products of whole images would be most of the training time with thousands of them.
    """
    n = len(images)
    flat = torch.from_numpy(images.reshape(n, -1))
    mean = flat.mean(0)
    thin = torch.from_numpy(np.ascontiguousarray(images[:, ::ROWS, ::COLUMNS]).reshape(n, -1))
    thin = thin - thin.mean(0)
    gram = (thin @ thin.T).double().numpy()
    keep = max(1, min(limit, n - 1, thin.shape[1]))
    vectors = eigh(gram, subset_by_index=[n - keep, n - 1])[1]
    spanned = torch.from_numpy(vectors.T.astype(np.float32)) @ flat
    spanned -= torch.from_numpy(vectors.sum(0).astype(np.float32))[:, None] * mean
    axes = torch.linalg.qr(spanned.T).Q.T.contiguous()
    scores = (flat @ axes.T - mean @ axes.T).double().numpy()
    energy = float(sum((part - mean).double().square().sum() for part in flat.split(256)))
    lost = max(0.0, energy - float((scores**2).sum())) / images.size
    return Components(mean.numpy(), axes.numpy(), scores, lost)
