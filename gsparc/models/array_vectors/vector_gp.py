"""Array vectors whose phases and twins are unknown, aligned under a Gaussian process;
used in training only.

Each spectrum gives its vector up to a global phase and a twin. Both are free parameters of every
sample, set in turn to the value under which its vector is most likely given all others (coordinate
ascent of the likelihood).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.processes.factor import Factor
from gsparc.processes.kernel import Kernel

SWEEPS = 30
TOLERANCE = 1e-3  # mean change per vector and sweep, relative to its norm, that ends the sweeps
TWIN_MARGIN = 1.02  # factor by which a twin's overlap must be larger for a swap


def twin_vectors(vectors: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Return vectors (n, M) with the same spectra: conjugate,
    elements reflected through the array's centre.

    Args:
        partner: (M,) index of each element's mirror element.
    """
    return vectors.conj()[..., partner]


def index_mirror_elements(array: np.ndarray) -> np.ndarray | None:
    """Return indices (M,) of elements reflected through the array's centre;
    None of an asymmetric one.
    """
    centred = array - array.mean(0)
    distance = cdist(centred, -centred)
    partner = distance.argmin(1)
    spacing = cdist(array, array)[~np.eye(len(array), dtype=bool)].min()
    symmetric = distance[np.arange(len(array)), partner].max() < 1e-3 * spacing
    return partner if symmetric else None


def align_along_tree(
    vectors: np.ndarray, positions: np.ndarray, partner: np.ndarray | None
) -> np.ndarray:
    """Return vectors (n, M) with twins and phases that match a neighbour's,
    along a tree of short steps.

    The tree is the minimum spanning one of the positions (n, 3) [m].
    """
    aligned = np.array(vectors, dtype=np.complex128)
    if len(aligned) > 1:
        distance = cdist(positions, positions) + 1e-9  # zero would mean no edge
        order, before = breadth_first_order(minimum_spanning_tree(distance), 0, directed=False)
        for i in order[1:]:
            aligned[i] = match_phase_and_twin(aligned[i], aligned[before[i]], partner)
    return aligned


def match_phase_and_twin(
    vector: np.ndarray, expected: np.ndarray, partner: np.ndarray | None, margin: float = 1.0
) -> np.ndarray:
    """Return a vector (M,), or its twin if that overlaps more with the expected one,
    in its phase.
    """
    overlap = np.vdot(vector, expected)
    if partner is not None:
        other = twin_vectors(vector, partner)
        if abs(of_other := np.vdot(other, expected)) > margin * abs(overlap):
            vector, overlap = other, of_other
    return vector * (overlap / abs(overlap)) if abs(overlap) > 0 else vector


def refine_alignment(
    vectors: np.ndarray, inverse: np.ndarray, partner: np.ndarray | None, sweeps: int = SWEEPS
) -> np.ndarray:
    """Return phases and twins (n, M) of largest likelihood, one sample at a time given all others.

    The leave-one-out mean of sample i is `x_i - (K^-1 X)_i / (K^-1)_ii` (Rasmussen and Williams
    2006, eq. 5.12).
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
            new = match_phase_and_twin(old, expected, partner, TWIN_MARGIN)
            change += float(np.linalg.norm(new - old))
            aligned[i] = new
        if change < TOLERANCE * size:
            break
    return aligned


def align_by_likelihood(
    vectors: np.ndarray, positions: np.ndarray, partner: np.ndarray | None, kernel: Kernel
) -> np.ndarray:
    """Return vectors (n, M) complex128 with the phases and twins
    that are most likely under a kernel.

    Args:
        vectors: (n, M) complex, phases and twins unknown.
        positions: (n, 3) [m].
        partner: of `index_mirror_elements`.
        kernel: length and noise.
    """
    inverse = Factor.from_gram(kernel.gram(torch.from_numpy(positions))).inverse.numpy()
    return refine_alignment(align_along_tree(vectors, positions, partner), inverse, partner)


def align_to_nearest(
    vectors: np.ndarray,
    positions: np.ndarray,
    known: np.ndarray,
    places: np.ndarray,
    partner: np.ndarray | None,
) -> np.ndarray:
    """Return vectors (m, M) complex128 of the phases and twins
    that match the nearest of aligned ones.

    Args:
        vectors, positions: (m, M) complex and (m, 3) [m], phases and twins unknown.
        known, places: (n, M) complex128 and (n, 3) [m], aligned.
        partner: of `index_mirror_elements`.
    """
    near = known[cKDTree(places).query(positions)[1]]
    return np.stack(
        [match_phase_and_twin(*pair, partner) for pair in zip(vectors, near, strict=True)]
    )
