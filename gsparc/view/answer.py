"""What a model answers at one pair of places, and why, in numbers that a picture or a sentence needs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gsparc.data.schema import Site
from gsparc.data.site_objects import SiteObjects
from gsparc.maps.levels import predicted
from gsparc.methods.export import Paths
from gsparc.methods.method import HasPaths
from gsparc.methods.predictor import Predictor

SILENT_DB = 30.0  # below the strongest, where paths are not shown
NEAREST_M = 0.1  # where a distance law ends
PHASES_DB = 2.0  # between a level and the sum of its paths' powers, that is spoken of


@dataclass(frozen=True)
class Answer:
    """A prediction at one pair of places.

    Attributes:
        ends: world places (3,) [m] that were given, and that of the static end where it is known.
        query_ms: of the mean alone at the chosen operating point [ms].
        level_db, spread_db: received power and its deviation [dB]; None of spectra.
        confidence: in [0, 1]; None where the method has none.
        spectrum: (H, W) in [0, 1]; None of other kinds.
        response: (A, K) complex channel; None of other kinds.
        strongest: azimuth and elevation in the world of the strongest direction of a spectrum [degrees].
        paths: None where there are none.
    """

    ends: Mapping[str, np.ndarray]
    query_ms: float
    level_db: float | None = None
    spread_db: float | None = None
    confidence: float | None = None
    spectrum: np.ndarray | None = None
    response: np.ndarray | None = None
    strongest: tuple[float, float] | None = None
    paths: Rays | None = None


@dataclass(frozen=True)
class Rays:
    """Propagation paths at one place, the strongest first, of those within `SILENT_DB` of it.

    Attributes:
        gain_db: (N,) mean over antennas.
        delay_ns: (N,).
        towards: (N, 3) unit vectors in the world towards where each comes from; None where not known.
    """

    gain_db: np.ndarray
    delay_ns: np.ndarray
    towards: np.ndarray | None


def ask(predictor: Predictor, ends: Mapping[str, np.ndarray]) -> Answer:
    """Ask about one place (two where both ends move).

    Args:
        predictor: of one station where there are several.
        ends: world places (3,) [m] of the ends that move.

    Raises:
        ValueError: a place that cannot be.
    """
    site, kind = predictor.site, predictor.site.kind
    start = time.perf_counter()
    mean = np.asarray(getattr(predictor, kind)(**ends))
    query_ms = (time.perf_counter() - start) * 1e3
    said = predictor.predict(**{end: np.atleast_2d(place) for end, place in ends.items()})
    still: dict[str, np.ndarray] = {}
    if site.static_end is not None and site.static_position is not None:
        still[site.static_end] = site.static_position + site.origin
    level = spread = None
    if kind != "spectrum":
        level, spread = (float(value[0]) for value in predicted(said, kind))
    return Answer(
        {**still, **ends}, query_ms, level, spread,
        None if said.confidence is None else float(said.confidence[0]),
        mean if kind == "spectrum" else None, mean if kind == "csi" else None,
        _strongest(mean, site) if kind == "spectrum" else None, _rays(predictor, ends),
    )  # fmt: skip


def azimuth_elevation(towards: np.ndarray) -> tuple[float, float]:
    """Of a direction (3,) [degrees]."""
    x, y, z = towards
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _strongest(spectrum: np.ndarray, site: Site) -> tuple[float, float]:
    assert site.grid is not None
    towards = site.grid.directions().numpy().reshape(-1, 3)[int(spectrum.argmax())]
    return azimuth_elevation(towards if site.rx_rotation is None else site.rx_rotation @ towards)


def _rays(predictor: Predictor, ends: Mapping[str, np.ndarray]) -> Rays | None:
    if predictor.site.kind != "csi" or not isinstance(predictor.method, HasPaths):
        return None
    try:
        found: Paths = predictor.paths(**ends)
    except ValueError:  # what was fitted has none
        return None
    power = (np.abs(found.gain[0]).astype(np.float64) ** 2).mean(axis=0)
    order = np.argsort(power)[::-1]
    order = order[power[order] > power.max(initial=0.0) * 10 ** (-SILENT_DB / 10)]
    delay = np.asarray(found.delay_s[0], np.float64).mean(axis=0)[order] * 1e9
    towards = None if found.direction is None else np.asarray(found.direction[0], np.float64)[order]
    return Rays(10 * np.log10(power[order]), delay, towards)


@dataclass(frozen=True)
class Usual:
    """What was measured at what distance: level = `at_one` - `slope` log10(distance).

    Attributes:
        at_one: [dB] at a metre.
        slope: [dB per decade].
        spread_db: of what was measured about it.
        tree: of measured places, world.
        distance_m: (n,) of what was measured; empty where the other end is unknown.
        level_db: (n,) there.
    """

    at_one: float
    slope: float
    spread_db: float
    tree: cKDTree
    distance_m: np.ndarray
    level_db: np.ndarray


def usual(places: np.ndarray, level_db: np.ndarray, other: np.ndarray | None) -> Usual:
    """The distance law of measured levels (n,) [dB] at places (n, 3) [m], the other end at (3,) or (n, 3);
    NaN where that is unknown."""
    known = np.isfinite(level_db)
    tree = cKDTree(places)
    level = level_db[known]
    if other is None or len(level) < 3:
        return Usual(np.nan, np.nan, np.nan, tree, np.zeros(0), level)
    distance = np.maximum(np.linalg.norm((places - other)[known], axis=1), NEAREST_M)
    far = np.log10(distance)
    slope, at_one = np.polyfit(far, level, 1) if np.ptp(far) > 0 else (0.0, level.mean())
    spread = float(np.std(level - at_one - slope * far))
    return Usual(float(at_one), float(-slope), spread, tree, distance, level)


def reasons(
    answer: Answer, moving: str, known: Usual | None, objects: SiteObjects, origin: np.ndarray
) -> list[str]:
    """Why the level is what it is, one line each, of what is measured and what the model holds.

    Args:
        answer: at a place.
        moving: the end that was dragged.
        known: of what was measured.
        objects: that the model found, local coordinates.
        origin: (3,) of the local coordinates, world [m].
    """
    said = []
    here, there = answer.ends[moving], answer.ends.get("rx" if moving == "tx" else "tx")
    if there is not None:
        far = float(np.linalg.norm(here - there))
        said.append(f"{far:.3g} m from the other end")
        if known is not None and answer.level_db is not None and np.isfinite(known.at_one):
            plain = known.at_one - known.slope * np.log10(max(far, NEAREST_M))
            gap = answer.level_db - plain
            how = "as usual" if abs(gap) <= known.spread_db else "weaker" if gap < 0 else "stronger"
            said.append(
                f"distance alone: {plain:.1f} dB; here {abs(gap):.1f} dB {'less' if gap < 0 else 'more'} "
                f"({how}, measured levels spread {known.spread_db:.1f} dB)"
            )
        if len(objects.means):
            crossed = crossed_losses(objects, here - origin, there - origin)
            strong = crossed[np.abs(crossed) >= 0.5]
            said.append(
                f"the straight path crosses {len(strong)} Gaussians that take {crossed.sum():.1f} dB "
                "by the model"
            )
    if known is not None:
        apart = float(known.tree.query(here)[0])
        said.append("measured here" if apart < 1e-3 else f"nearest measurement: {apart:.3g} m away")
    if answer.paths is not None and len(answer.paths.gain_db):
        rays = answer.paths
        more = ""
        if rays.towards is not None:
            more = " from azimuth {:.0f}°, elevation {:.0f}°".format(*azimuth_elevation(rays.towards[0]))
        said.append(
            f"{len(rays.gain_db)} paths within {SILENT_DB:g} dB; strongest {rays.gain_db[0]:.1f} dB at "
            f"{rays.delay_ns[0]:.1f} ns{more}"
        )
        if answer.level_db is not None and len(rays.gain_db) > 1:
            gap = answer.level_db - 10 * np.log10((10 ** (rays.gain_db / 10)).sum())
            if abs(gap) >= PHASES_DB:
                how = "cancel each other" if gap < 0 else "add up"
                said.append(
                    f"they {how}: {abs(gap):.1f} dB {'less' if gap < 0 else 'more'} than their powers"
                )
    return said


def crossed_losses(objects: SiteObjects, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Losses (N,) [dB] of Gaussians on the straight line between two local places (3,) [m].

    What a line through the middle loses, times exp(-d^2 / 2) of its least distance d in standard deviations.
    """
    cos, sin = np.cos(objects.turns), np.sin(objects.turns)

    def own(vector: np.ndarray) -> np.ndarray:
        x, y, z = vector.T
        return np.column_stack([cos * x + sin * y, cos * y - sin * x, z]) / objects.scales

    begin = own(start - objects.means)
    along = own(np.broadcast_to(end - start, objects.means.shape))
    square = np.maximum((along**2).sum(1), 1e-30)
    share = np.clip(-(begin * along).sum(1) / square, 0, 1)
    nearest = begin + share[:, None] * along
    return np.asarray(objects.losses * np.exp(-0.5 * (nearest**2).sum(1)))
