"""What a model answers at one pair of places, in numbers that a picture or a sentence needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.prediction.answers import ask
from gsparc.prediction.channels import Paths
from gsparc.prediction.levels import predicted_levels
from gsparc.prediction.predictor import Predictor

SILENT_DB = 30.0  # below the strongest, where paths are not shown
SAME_NS = 0.25  # between delays of one path, as several searches find it
SAME_COSINE = 0.998  # the same of its directions: 3.6 degrees


@dataclass(frozen=True)
class PlaceAnswer:
    """A prediction at one pair of places.

    Attributes:
        ends: world places (3,) [m] that were given, and that of the static end where it is known.
        level_db, spread_db: received power and its deviation [dB]; None of spectra.
        confidence: in [0, 1]; None where the method has none.
        spectrum: (H, W) in [0, 1]; None of other kinds.
        response: (A, K) complex channel; None of other kinds.
        paths: None where there are none.
    """

    ends: Mapping[str, np.ndarray]
    level_db: float | None = None
    spread_db: float | None = None
    confidence: float | None = None
    spectrum: np.ndarray | None = None
    response: np.ndarray | None = None
    paths: PlacePaths | None = None


@dataclass(frozen=True)
class PlacePaths:
    """Propagation paths at one place, the strongest first, of those within `SILENT_DB` of it.

    Attributes:
        gain_db: (N,) mean over antennas.
        delay_ns: (N,).
        towards: (N, 3) unit vectors in the world towards where each comes from; None where not
            known.
    """

    gain_db: np.ndarray
    delay_ns: np.ndarray
    towards: np.ndarray | None


def predict_answer(predictor: Predictor, ends: Mapping[str, np.ndarray]) -> PlaceAnswer:
    """Predict at world places (3,) [m] of the ends that move,
    of one station where there are several.

    Raises:
        ValueError: a place that cannot be.
    """
    site, facts = predictor.site, predictor.site.target
    there = {end: np.atleast_2d(place) for end, place in ends.items()}
    prediction = ask(predictor, there, linear=True)
    mean = prediction.mean[0].numpy()
    known = site.every_station.position[0] + site.origin
    still: dict[str, np.ndarray] = {} if np.isnan(known).any() else {site.still_end: known}
    level = spread = None
    if not facts.is_image:
        level, spread = (float(value[0]) for value in predicted_levels(prediction, site.kind))
    return PlaceAnswer(
        {**still, **ends},
        level,
        spread,
        None if prediction.confidence is None else float(prediction.confidence[0]),
        mean if facts.is_image else None,
        mean if facts.is_complex else None,
        _rays(predictor, ends),
    )


def azimuth_elevation(towards: np.ndarray) -> tuple[float, float]:
    """Return azimuth and elevation of a direction (3,) [degrees]."""
    x, y, z = towards
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _rays(predictor: Predictor, ends: Mapping[str, np.ndarray]) -> PlacePaths | None:
    try:
        paths: Paths = predictor.paths(**ends)
    except ValueError:  # of another kind, or what was fitted has none
        return None
    delay = np.asarray(paths.delay_s[0], np.float64).mean(axis=0) * 1e9
    towards = None if paths.direction is None else np.asarray(paths.direction[0], np.float64)
    return merge_paths(paths.gain[0], delay, towards)


def merge_paths(gain: np.ndarray, delay_ns: np.ndarray, towards: np.ndarray | None) -> PlacePaths:
    """Return paths as they are shown; those that several searches found alike are one,
    of their summed gain.

    Args:
        gain: (A, N) complex, with their phases.
        delay_ns: (N,).
        towards: (N, 3); None where not known.
    """
    gain = gain.astype(np.complex128)
    queue = np.argsort(-(np.abs(gain) ** 2).mean(axis=0))
    firsts, power = [], []
    while len(queue):
        first = queue[0]
        alike = queue == first
        if towards is not None:
            near = np.abs(delay_ns[queue] - delay_ns[first]) < SAME_NS
            alike |= near & (towards[queue] @ towards[first] > SAME_COSINE)
        firsts.append(first)
        power.append(float((np.abs(gain[:, queue[alike]].sum(axis=1)) ** 2).mean()))
        queue = queue[~alike]
    level = np.array(power)
    order = np.argsort(-level)
    order = order[level[order] > level.max(initial=0.0) * from_decibels(-SILENT_DB)]
    chosen = np.array(firsts, np.int64)[order]
    return PlacePaths(
        to_decibels(level[order]), delay_ns[chosen], None if towards is None else towards[chosen]
    )
