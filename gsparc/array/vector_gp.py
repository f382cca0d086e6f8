"""A complex Gaussian process on array vectors whose phases and twins are unknown; used in training only.

Each spectrum gives its vector up to a global phase and a twin. Both are free parameters of every sample, set
in turn to the value under which its vector is most likely given all others (coordinate ascent of the
likelihood). The expected spectrum at a query is the mean amplitude of a Rice distribution, nearly the root of
a coherent part `|A^H mu|^2` plus an incoherent one that grows with the variance up to the mean image, far
from all data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.field.kernels import ROUGH_RATIO, ROUGH_SHARE
from gsparc.methods import gp

SWEEPS = 30
QUERIES = 2048  # at a time: bounds the memory for thousands of samples
TOLERANCE = 1e-3  # mean change per vector and sweep, relative to its norm, that ends the sweeps
TWIN_MARGIN = 1.02  # factor by which a twin's overlap must be larger for a swap


class Kernel(gp.Kernel):
    """`amplitude * (a smooth long part + a rough short one + noise * identity)`, of array vectors.

    `smooth_rough` of `gsparc.field.kernels`, the kernel of the emissions too.
    """

    def cross(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """See the base class."""
        distance = cdist(a, b) / self.length
        smooth, rough = 5**0.5 * distance, 3**0.5 / ROUGH_RATIO * distance
        long = (1 + smooth + smooth**2 / 3) * np.exp(-smooth)
        return (1 - ROUGH_SHARE) * long + ROUGH_SHARE * (1 + rough) * np.exp(-rough)


def twin(vectors: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """The vectors (n, M) with the same spectra: conjugate, elements reflected through the array's centre.

    Args:
        partner: (M,) index of each element's mirror element.
    """
    return vectors.conj()[..., partner]


def mirror_elements(array: np.ndarray) -> np.ndarray | None:
    """(M,) index of each element's reflection through the array's centre; None for an asymmetric array."""
    centred = array - array.mean(0)
    distance = cdist(centred, -centred)
    partner = distance.argmin(1)
    spacing = cdist(array, array)[~np.eye(len(array), dtype=bool)].min()
    symmetric = distance[np.arange(len(array)), partner].max() < 1e-3 * spacing
    return partner if symmetric else None


def align(vectors: np.ndarray, positions: np.ndarray, partner: np.ndarray | None) -> np.ndarray:
    """Vectors (n, M) with twins and phases chosen to match their nearest neighbours, one by one.

    Walks a minimum spanning tree of the positions (n, 3) [m]; each sample is compared with its four nearest
    predecessors.
    """
    n = len(vectors)
    order = _walk(positions)
    aligned = np.array(vectors, dtype=np.complex128)
    tree = cKDTree(positions)
    done = np.zeros(n, dtype=bool)
    done[order[0]] = True
    for i in order[1:]:
        near = _nearest_done(tree, positions, i, done, 4)
        distance = np.linalg.norm(positions[near] - positions[i], axis=1)
        weight = np.exp(-distance / max(distance[0], 1e-6)) / np.maximum(
            np.linalg.norm(aligned[near], axis=1), 1e-12
        )
        choices = [aligned[i]] if partner is None else [aligned[i], twin(aligned[i], partner)]
        overlaps = [aligned[near].conj() @ choice for choice in choices]
        best = int(np.argmax([(weight * np.abs(overlap)).sum() for overlap in overlaps]))
        turn = overlaps[best][0]
        aligned[i] = choices[best] * (np.conj(turn) / abs(turn) if abs(turn) > 0 else 1.0)
        done[i] = True
    return aligned


def _walk(positions: np.ndarray) -> np.ndarray:
    """Rows from the first along a spanning tree of short steps."""
    if len(positions) == 1:
        return np.zeros(1, dtype=np.int64)
    distance = cdist(positions, positions) + 1e-9  # zero would mean no edge
    tree = minimum_spanning_tree(distance)
    return breadth_first_order(tree + tree.T, 0, directed=False, return_predecessors=False)


def _nearest_done(tree: cKDTree, positions: np.ndarray, i: int, done: np.ndarray, count: int) -> np.ndarray:
    reach = 4 * count
    while True:
        found = np.atleast_1d(tree.query(positions[i], k=min(reach, len(positions)))[1])
        near = found[done[found]]
        if len(near) >= count or reach >= len(positions):
            return near[:count]
        reach *= 4


@dataclass(frozen=True)
class VectorGP:
    """Posterior of the array vector as a function of the transmitter's position.

    Attributes:
        kernel: correlations of the field with itself.
        positions: (n, 3) [m].
        vectors: (n, M) complex128, phases and twins aligned.
        inverse: (n, n) inverse of the correlation matrix with noise.
    """

    kernel: Kernel
    positions: np.ndarray
    vectors: np.ndarray
    inverse: np.ndarray

    def posterior(self, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (B, M) complex and variance (B,) in [0, 1], relative to the prior's, at (B, 3) [m]."""
        weights = self.inverse @ self.vectors
        mean = np.empty((len(queries), weights.shape[1]), dtype=np.complex128)
        unknown = np.empty(len(queries))
        for start in range(0, len(queries), QUERIES):
            part = slice(start, start + QUERIES)
            cross = self.kernel.cross(queries[part], self.positions)
            mean[part] = cross @ weights
            unknown[part] = 1 - np.einsum("ij,ij->i", cross @ self.inverse, cross)
        return mean, np.clip(unknown, 0.0, 1.0)

    def at_samples(self) -> tuple[np.ndarray, np.ndarray]:
        """`posterior(positions)` from `K = (K + noise) - noise`, without products of n x n matrices."""
        noise = self.kernel.noise
        mean = self.vectors - noise * (self.inverse @ self.vectors)
        return mean, np.clip(noise - noise**2 * np.diag(self.inverse), 0.0, 1.0)


def refine_alignment(
    vectors: np.ndarray, inverse: np.ndarray, partner: np.ndarray | None, sweeps: int = SWEEPS
) -> np.ndarray:
    """Phases and twins (n, M) of largest likelihood, one sample at a time given all others.

    The leave-one-out mean of sample i is `x_i - (K^-1 X)_i / (K^-1)_ii` (Rasmussen and Williams 2006,
    eq. 5.12).
    """
    aligned = np.ascontiguousarray(vectors, dtype=np.complex128)
    aligned = aligned.copy() if aligned is vectors else aligned
    parts = aligned.view(np.float64)  # a real row times complex columns would be made complex first
    diagonal = np.diag(inverse)
    size = np.linalg.norm(vectors, axis=1).sum()
    for _ in range(sweeps):
        change = 0.0
        for i in range(len(aligned)):
            old = aligned[i].copy()
            expected = old - (inverse[i] @ parts).view(np.complex128) / diagonal[i]
            new, overlap = old, np.vdot(old, expected)
            if partner is not None:
                other = twin(old, partner)
                other_overlap = np.vdot(other, expected)
                if abs(other_overlap) > TWIN_MARGIN * abs(overlap):
                    new, overlap = other, other_overlap
            if abs(overlap) > 0:
                new = new * (overlap / abs(overlap))
            change += float(np.linalg.norm(new - old))
            aligned[i] = new
        if change < TOLERANCE * size:
            break
    return aligned


def fit_vector_gp(
    vectors: np.ndarray, positions: np.ndarray, partner: np.ndarray | None, kernel: Kernel
) -> VectorGP:
    """Align phases and twins, then fit the process.

    Args:
        vectors: (n, M) complex, phases and twins unknown.
        positions: (n, 3) [m].
        partner: of `mirror_elements`.
        kernel: length and noise; its amplitude is set here.
    """
    inverse = np.linalg.inv(kernel.gram(positions))
    aligned = refine_alignment(align(vectors, positions, partner), inverse, partner)
    amplitude = float(np.einsum("im,ij,jm->", aligned.conj(), inverse, aligned).real) / aligned.size
    return VectorGP(replace(kernel, amplitude=amplitude), positions, aligned, inverse)
