"""A Gaussian process on whole targets of very many rows: a basis of few, and scores told by the nearest rows.

Principal components are those of rows that cover the site; all rows are projected on them, a block at a time,
and each query's scores are predicted from those of its neighbours alone (see `nearest_process`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from torch import Tensor

from gsparc.data.schema import Kind
from gsparc.methods.covering import covering
from gsparc.methods.neighbourhood import NEIGHBOURS, Neighbourhood
from gsparc.methods.power_kernel import PowerKernel
from gsparc.methods.target_rows import to_real
from gsparc.methods.vecchia import Sample, most_likely, weights_of

BLOCK = 256  # targets that are floats at a time
LOOKED_AT = 600  # rows that settings are chosen on
STRONGEST = 32  # components that they are chosen by


@dataclass(frozen=True)
class NearestTargets:
    """Scores by place.

    Attributes:
        near: places of the rows.
        scores: (n, P) float32.
        kernel: one length; its amplitude is the variance per real number of a target.
        lost: mean square per real number that the components leave out.
    """

    near: Neighbourhood
    scores: Tensor
    kernel: PowerKernel
    lost: float

    approximation = f"Vecchia {NEIGHBOURS}"

    def at(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (B, P) float32, with autograd, and the variance of a measurement, of the amplitude (B,)."""
        row, _ = self.near.nearest(queries.detach().numpy())
        near = torch.from_numpy(self.near.places[row])
        noise = torch.full(row.shape, self.kernel.noise, dtype=near.dtype)
        weights, known = weights_of(self.kernel, queries, near, noise)
        scores = torch.einsum("bk,bkp->bp", weights.float(), self.scores[torch.from_numpy(row)])
        return scores, (1 + self.kernel.noise - known).clamp_min(0.0)

    def state(self) -> dict[str, Any]:
        """Tensors and numbers that `of` needs."""
        arrays = {"places": torch.from_numpy(self.near.places), "level": torch.from_numpy(self.near.level)}
        return {**arrays, **self.kernel.state(), "scores": self.scores, "lost": self.lost}

    @classmethod
    def of(cls, state: dict[str, Any]) -> NearestTargets:
        """That whose `state()` this was."""
        near = Neighbourhood(state["places"].numpy(), state["level"].numpy())
        return cls(near, state["scores"], PowerKernel.of(state), float(state["lost"]))


def projected(
    targets: np.ndarray, kind: Kind, mean: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, float]:
    """Scores (n, P) float32 of stored targets (n, ...), and the mean square per real number beyond them.

    Args:
        targets: in memory or on disk: a block is read at a time.
        kind: of the targets.
        mean, axes: (D,) and (P, D), see `gp.Components`.
    """
    scores, beyond = np.empty((len(targets), len(axes)), np.float32), 0.0
    for start in range(0, len(targets), BLOCK):
        rows = to_real(targets[start : start + BLOCK], kind) - mean
        scores[start : start + BLOCK] = rows @ axes.T
        beyond += float((rows.astype(np.float64) ** 2).sum())
    beyond -= float((scores.astype(np.float64) ** 2).sum())
    return scores, max(beyond, 0.0) / (len(targets) * len(mean))


def learned(
    places: np.ndarray, scores: np.ndarray, lost: float, entries: int, start: PowerKernel, seed: int
) -> tuple[NearestTargets, str]:
    """The process of scores, its length and noise most likely given the nearest rows, and a note.

    Args:
        places, scores: (n, D) [m] and (n, P) float32.
        lost: see `NearestTargets`.
        entries: real numbers of a target.
        start: a kernel of one length, chosen on few rows.
        seed: of rows that are drawn.
    """
    near = Neighbourhood.of(places, seed)
    row = covering(places, LOOKED_AT, seed)
    rows = np.c_[row, _others(places, row)]
    strong = np.argsort(-(scores[row].astype(np.float64) ** 2).sum(0), kind="stable")[:STRONGEST]
    at, values = torch.from_numpy(places[rows]), torch.from_numpy(scores[rows][..., strong]).double()
    between = torch.cdist(at, at, compute_mode="donot_use_mm_for_euclid_dist")
    counts = torch.ones(rows.shape, dtype=torch.float64)
    sample = Sample(
        between[:, 0, 1:], between[:, 1:, 1:], values[:, 0], values[:, 1:], counts[:, 0], counts[:, 1:]
    )
    found = most_likely([start], sample, pdist(places[row]))
    share = float((scores[row] ** 2).sum()) / max(float((scores[row][:, strong] ** 2).sum()), 1e-30)
    amplitude = found.amplitude * len(strong) / entries * share
    kernel = PowerKernel(found.lengths, found.shares, found.noise, amplitude)
    said = f"settings chosen on {len(row)} of {len(places)} rows, each given its nearest {NEIGHBOURS}"
    return NearestTargets(near, torch.from_numpy(scores), kernel, lost), said


def _others(places: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Numbers (m, k) of the places nearest to those of rows (m,), themselves left out."""
    count = min(NEIGHBOURS + 1, len(places))
    near = cKDTree(places).query(places[row], k=np.arange(1, count + 1))[1]
    own = np.argsort(near == row[:, None], axis=1, kind="stable")[:, : count - 1]
    return np.take_along_axis(near, own, 1)
