"""Baselines of localisation by name, on snapshots of any kind."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from gsparc.apps.locate.baselines.methods import Locator, kernel, neighbours, process
from gsparc.apps.locate.baselines.network import network
from gsparc.apps.locate.snapshots import Snapshots

BASELINES: dict[str, Callable[[np.ndarray, np.ndarray], Locator]] = {
    "nearest": partial(neighbours, counts=(1,)),
    "knn": partial(neighbours, weights="uniform"),
    "weighted_knn": neighbours,
    "kernel": kernel,
    "gp": process,
    "mlp": network,
}


def features(heard: Snapshots) -> np.ndarray:
    """Real rows (n, P), NaN where nothing was heard.

    Of channels the real and imaginary parts after the first value that was heard was turned to be real and
    positive, so that a common phase changes nothing.
    """
    values = heard.values.numpy()
    if not np.iscomplexobj(values):
        return values
    there = ~np.isnan(values.real)
    first = values[np.arange(len(values)), there.argmax(1)]
    turned = values * (first.conj() / np.maximum(np.abs(first), 1e-30))[:, None]
    return np.hstack([turned.real, turned.imag])


def located_by(name: str, trained: Snapshots, heard: Snapshots) -> tuple[np.ndarray, float, float]:
    """Places (n, 3) [m, local] of a baseline that learned from snapshots, ms of each, seconds of learning.

    Raises:
        ValueError: rows that cannot be learned from.
    """
    started = time.perf_counter()
    locate = BASELINES[name](features(trained), trained.place[:, :3])
    fitted = time.perf_counter()
    place = locate(features(heard))
    return place, (time.perf_counter() - fitted) / max(len(heard), 1) * 1e3, fitted - started
