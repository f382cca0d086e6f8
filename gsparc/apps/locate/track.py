"""Places along a track: a filter over the posteriors of its snapshots, forwards and backwards.

A hidden Markov model: from one snapshot to the next one goes a normal step, and now and then anywhere (L. R.
Rabiner, "A tutorial on hidden Markov models", Proc. IEEE 77 (1989)). Errors that snapshots share, as of a
device or of a body in the way, are not averaged away by it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial.distance import cdist

from gsparc.apps.locate.likelihood import Misfit
from gsparc.apps.locate.locator import Located
from gsparc.apps.locate.posterior import Posterior
from gsparc.apps.locate.search import Looked
from gsparc.apps.locate.snapshots import Snapshots

KEPT = 500  # cells of a snapshot, the heaviest
ANYWHERE = 0.01  # probability of a step to a place that has nothing to do with the last


def speed(places: np.ndarray, seconds: np.ndarray, walk: np.ndarray) -> float:
    """Median speed [m/s] between rows (n, 3) [m] that follow each other in a walk; 0 where none do."""
    order = np.lexsort((seconds, walk))
    gone, took = np.linalg.norm(np.diff(places[order], axis=0), axis=1), np.diff(seconds[order])
    moved = (np.diff(walk[order]) == 0) & (took > 0)
    # A median: standing still and single jumps of recorded places leave it alone.
    return float(np.median(gone[moved] / took[moved])) if moved.any() else 0.0


def smoothed(posteriors: Sequence[Posterior], seconds: np.ndarray, metres_per_s: float) -> list[Posterior]:
    """Return what is known of each place given all snapshots of a track, over its heaviest cells.

    Args:
        posteriors: of each snapshot on its own, by an even prior.
        seconds: (n,) when each was heard.
        metres_per_s: a step of t seconds has the deviation `metres_per_s t / sqrt(2)` along an axis.
    """
    order = np.argsort(seconds, kind="stable")
    heaviest = [one.within(1.0)[:KEPT] for one in posteriors]
    cells = [one.cells.at(chosen) for one, chosen in zip(posteriors, heaviest, strict=True)]
    mass = [one.mass[chosen] for one, chosen in zip(posteriors, heaviest, strict=True)]

    def passed(over: list[np.ndarray], order: np.ndarray) -> None:
        """Multiplies masses `over` the cells of each snapshot by their density after all before it."""
        before = mass[order[0]]
        for start, end in pairwise(order):
            cell = np.median(np.r_[cells[start].edge.max(1), cells[end].edge.max(1)])
            # Never less than half a cell, or a slow step between two centres would be impossible.
            spread = max(metres_per_s * abs(seconds[end] - seconds[start]) / np.sqrt(2), cell / 2)
            near = cdist(cells[end].centre, cells[start].centre, "sqeuclidean")
            normal = (2 * np.pi * spread**2) ** ((cells[end].edge.max(0) > 0).sum() / 2)
            # Divided by its sum: over a long track products of masses would underflow.
            step = np.exp(near / (-2 * spread**2)) @ (before / before.sum()) / normal
            # A hundredth of steps goes anywhere, so that one wrong snapshot does not forbid all later ones.
            density = (1 - ANYWHERE) * step + ANYWHERE / posteriors[end].cells.size.sum()
            over[end], before = over[end] * density, mass[end] * density

    product = list(mass)
    # Forwards, then backwards: each snapshot's own mass counts once in the product.
    passed(product, order)
    passed(product, order[::-1])
    return [
        Posterior(some, np.log(one / one.sum() / some.size + 1e-300))
        for some, one in zip(cells, product, strict=True)
    ]


def as_looked(posterior: Posterior) -> Looked:
    """Return the same for calibration: of a trust its temperature alone changes it."""
    density = torch.from_numpy(posterior.log_density)[None]
    none = torch.zeros_like(density)
    return Looked(posterior.cells, Misfit(none, none, none[:, 0], density))


def followed(alone: Sequence[Located], trained: Snapshots, heard: Snapshots, level: float) -> list[Located]:
    """Each snapshot given all others, at the mean of its cells: rows are seconds of one track."""
    start, pace = time.perf_counter(), speed(trained.place, trained.rows, np.zeros(len(trained)))
    steps = smoothed([one.posterior for one in alone], heard.rows, pace)
    each = alone[0].seconds + (time.perf_counter() - start) / len(alone)
    return [Located.of(one, level, one.mass @ one.cells.centre, each) for one in steps]
