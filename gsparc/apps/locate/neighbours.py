"""Places by the nearest rows in feature space: beside a model's answers, and of fingerprints.

P. Bahl and V. Padmanabhan, "RADAR: an in-building RF-based user location and tracking system",
INFOCOM 2000.
"""

from __future__ import annotations

import time

import numpy as np
from sklearn.model_selection import GridSearchCV, GroupKFold, PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor

from gsparc.apps.locate.snapshots import Scans

# Numbers of neighbours that are tried
PLAIN = {"nearest": (1,), "weighted_knn": (1, 2, 3, 4, 5, 7, 9, 13)}
FOLDS = 5  # of places, that choose the number where no groups are given
MAX_ROWS = 2_000  # that choose it
BELOW = 0.02  # of the range of values, that a silent one is put below the least


def locate_by_neighbours(
    name: str, trained: Scans, heard: Scans, group: np.ndarray | None = None
) -> tuple[np.ndarray, float, float]:
    """Return places (n, 3) of snapshots by the nearest trained ones,
    weighed by their inverse distances.

    Args:
        name: of `PLAIN`; of several numbers of neighbours the one of least error at places left out
            is taken.
        trained: snapshots of known places, in whose coordinates places come [m].
        heard: snapshots to be placed.
        group: (m,) int64 of trained ones, left out together to choose that number, -1 where never;
            None: fifths of the places.

    Returns:
        Places, milliseconds of each, and seconds of learning.

    Raises:
        ValueError: nothing was heard in any of those that are learned from.
    """
    started = time.perf_counter()
    features, queries, places = feature_vectors(trained), feature_vectors(heard), trained.place
    if not np.isfinite(features).any():
        raise ValueError(f"{name}: no row that could be learned from holds a value")
    floor = np.nanmin(features) - BELOW * (np.nanmax(features) - np.nanmin(features))
    features, queries = (
        np.where(np.isfinite(levels), levels, floor) for levels in (features, queries)
    )
    count = _count(PLAIN[name], features, places, group)
    nearest = KNeighborsRegressor(count, weights="distance", algorithm="brute").fit(
        features, places
    )
    fitted = time.perf_counter()
    place = nearest.predict(queries)
    return place, (time.perf_counter() - fitted) / max(len(heard), 1) * 1e3, fitted - started


def feature_vectors(heard: Scans) -> np.ndarray:
    """Return real rows (n, P), NaN where nothing was heard.

    Of channels the real and imaginary parts after the first value that was heard was turned to be
    real and positive, so that a common phase changes nothing.
    """
    values = heard.values.numpy()
    if not np.iscomplexobj(values):
        return values
    there = ~np.isnan(values.real)
    first = values[np.arange(len(values)), there.argmax(1)]
    turned = values * (first.conj() / np.maximum(np.abs(first), 1e-30))[:, None]
    return np.hstack([turned.real, turned.imag])


def _count(
    counts: tuple[int, ...], known: np.ndarray, places: np.ndarray, group: np.ndarray | None
) -> int:
    """The number of neighbours of least median error at places left out; else the first."""
    rows = np.random.default_rng(0).permutation(len(known))[:MAX_ROWS]
    place = np.unique(places[rows], axis=0, return_inverse=True)[1].reshape(-1)
    # Half of the rows: a fold without a place that was visited often has not many more.
    possible = [count for count in counts if count <= len(rows) // 2]
    if len(possible) < 2 or place.max() + 1 < FOLDS:
        return counts[0]

    def score(fitted: KNeighborsRegressor, asked: np.ndarray, true: np.ndarray) -> float:
        return -float(np.median(np.linalg.norm(fitted.predict(asked) - true, axis=1)))

    folds = (
        GroupKFold(FOLDS).split(rows, groups=place)
        if group is None
        else PredefinedSplit(group[rows])
    )
    model = KNeighborsRegressor(weights="distance", algorithm="brute")
    search = GridSearchCV(model, {"n_neighbors": possible}, scoring=score, cv=folds)
    return int(search.fit(known[rows], places[rows]).best_params_["n_neighbors"])
