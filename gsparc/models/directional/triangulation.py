"""Triangulate sources from noisy directions of arrival: positions,
covariances and the rays of each.

Each ray is a direction of arrival with an unknown error, N(0, sigma^2) about each of two axes, from
one of K points, or an outlier of uniform direction. Points are found one after the other as in
matching pursuit: pairs of rays propose them, all rays score them, and a Bayesian evidence
(likelihood ratio against outliers times the Occam factor of the position: D. J. C. MacKay 2003,
chapter 28) accepts them. Expectation maximisation over all points
and rays then estimates responsibilities and sigma.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsparc.physics.rays import closest_ranges_and_gap

# [rad], of a direction: rounding in files; no position information
MIN_ERROR, MAX_ERROR = 1e-4, 0.12
ERRORS = tuple(np.geomspace(MIN_ERROR, MAX_ERROR, 7))  # [rad], tried on the first point
REACH_M = 40.0  # [m], largest distance of an image from the receivers' middle
MIN_EVIDENCE = 6.0  # [nats], of an accepted point
PAIRS = 600  # of receivers whose rays are intersected in a round
ERROR_SAMPLE = 2000  # rays that the initial sigma is estimated on
CANDIDATES = 1200  # intersections scored on all rays
ROUNDS = 12  # of matching pursuit
STEPS = 6  # Gauss-Newton steps of a new point
EM_ITERATIONS = 12
SAME_SIGMAS = 4.0  # standard deviations within which two points are the same
MIN_EM_ITERATIONS = 3  # until the outlier rate has reached all points
EM_TOLERANCE = 0.02  # relative change of sigma that ends the iterations
MIN_OUTLIERS = 0.02  # least share of outliers
MIN_RESPONSIBILITY = 1e-3  # of a ray that enters a point's Gauss-Newton step
GATE_SIGMAS = 15.0  # sigmas from a proposed point within which rays are used for it
MAX_FAILURES = 20  # rejected proposals that end a round
MIN_RANGE_M = 0.05  # [m], bounds the weight of rays near a point


@dataclass(frozen=True)
class Rays:
    """N rays of n receivers.

    Attributes:
        places: (n, 3) [m].
        direction: (N, 3), unit vectors in the frame of the places.
        owner: (N,), the receiver of each.
    """

    places: np.ndarray
    direction: np.ndarray
    owner: np.ndarray

    @staticmethod
    def from_receivers(places: np.ndarray, rays: list[np.ndarray]) -> Rays:
        """Gather one array (paths, 3) per receiver."""
        flat = np.concatenate([places[:0], *rays])
        flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), np.finfo(float).tiny)
        return Rays(places, flat, np.repeat(np.arange(len(rays)), [len(r) for r in rays]))

    def __len__(self) -> int:
        return len(self.owner)

    def select_rays(self, mask: np.ndarray) -> Rays:
        """Return a subset, of the same receivers."""
        return Rays(self.places, self.direction[mask], self.owner[mask])

    def squared_error(self, points: np.ndarray) -> np.ndarray:
        """Return squared angles (K, N) [rad^2] by which the rays miss points (K, 3),
        as squared chords.
        """
        ahead = points @ self.direction.T - np.einsum(
            "nc,nc->n", self.places[self.owner], self.direction
        )
        away = np.linalg.norm(points[:, None] - self.places[None], axis=-1)
        return np.maximum(
            2 - 2 * ahead / np.maximum(away, np.finfo(float).tiny)[:, self.owner], 0.0
        )


@dataclass(frozen=True)
class RayClusters:
    """K triangulated points.

    Attributes:
        points: (K, 3) [m].
        covariance: (K, 3, 3) [m^2].
        responsibility: (K, N), probability that a ray comes from a point.
        error: sigma of a direction about each axis [rad].
    """

    points: np.ndarray
    covariance: np.ndarray
    responsibility: np.ndarray
    error: float

    def seen_points(self, rays: Rays) -> np.ndarray:
        """Return (n, K), 1 where a receiver has a ray from a point, else 0."""
        table = np.zeros((len(rays.places), len(self.points)))
        k, ray = np.nonzero(self.responsibility > 0.5)
        table[rays.owner[ray], k] = 1.0
        return table


def triangulate(rays: Rays, seed: int = 0) -> RayClusters:
    """Return all points where rays intersect, by falling evidence."""
    rng = np.random.default_rng(seed)
    empty = fit_by_em(rays, rays.places[:0], MAX_ERROR)
    error = _initial_error(rays, rng)
    if error is None:
        return empty
    points: list[np.ndarray] = []
    free = np.ones(len(rays), bool)
    for _ in range(ROUNDS):
        new = _find_points(rays, free, error, rng)
        if not new:
            break
        points += new
        clusters = fit_by_em(rays, np.stack(points), error)
        points, error = list(clusters.points), clusters.error
        free = clusters.responsibility.sum(0) < 0.5
    return clusters if points else empty


def fit_by_em(rays: Rays, points: np.ndarray, error: float) -> RayClusters:
    """Run expectation maximisation over points and rays,
    without duplicates and points of weak evidence.
    """
    while True:
        responsibility = np.zeros((0, len(rays)))
        covariance = _step_points(rays, points[:0], responsibility, error)[1]
        rate: np.ndarray | float = 1.0
        for turn in range(EM_ITERATIONS if len(points) else 0):
            squared_error = rays.squared_error(points)
            responsibility = _responsibility(squared_error, error, rate)
            outliers = max(len(rays) - responsibility.sum(), MIN_OUTLIERS * len(rays))
            rate = (np.maximum(responsibility.sum(1), MIN_RESPONSIBILITY) / outliers)[:, None]
            before = error
            assigned = max(responsibility.sum(), MIN_RESPONSIBILITY)
            error = math.sqrt((responsibility * squared_error).sum() / (2 * assigned))
            error = min(max(error, MIN_ERROR), MAX_ERROR)
            points, covariance = _step_points(rays, points, responsibility, error)
            if turn >= MIN_EM_ITERATIONS and abs(math.log(error / before)) < EM_TOLERANCE:
                break
        evidence = _evidence(responsibility, covariance)
        order = np.argsort(-evidence, kind="stable")
        points, covariance, responsibility, evidence = (
            v[order] for v in (points, covariance, responsibility, evidence)
        )
        mask = _are_distinct(points, covariance)
        if mask.all():
            mask = evidence >= MIN_EVIDENCE
        if mask.all():
            return RayClusters(points, covariance, responsibility, error)
        points = points[mask]


def _log_ratio(squared_error: np.ndarray, error: float) -> np.ndarray:
    """Log likelihood ratio of a ray from a point to an outlier [nats]."""
    return math.log(2 / error**2) - squared_error / (2 * error**2)


def _responsibility(
    squared_error: np.ndarray, error: float, rate: np.ndarray | float = 1.0
) -> np.ndarray:
    """Probability (K, N) that rays come from points with `rate` times as many rays
    as there are outliers.
    """
    gain = _log_ratio(squared_error, error) + np.log(rate)
    top = np.maximum(gain.max(0), 0)
    weight = np.exp(gain - top)
    return weight / (weight.sum(0) + np.exp(-top))


def _evidence(responsibility: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Log likelihood that the rays lose without each point (K,),
    plus its log Occam factor [nats].
    """
    space = math.log(4 / 3 * math.pi * REACH_M**3)
    place = np.minimum(0.5 * np.linalg.slogdet(2 * math.pi * covariance)[1] - space, 0.0)
    return place - np.log1p(-np.minimum(responsibility, 1 - 1e-12)).sum(1)


def _step_points(
    rays: Rays, points: np.ndarray, responsibility: np.ndarray, error: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points (K, 3) after a Gauss-Newton step on their rays, and their covariances (K, 3, 3)."""
    k, ray = np.nonzero(responsibility > MIN_RESPONSIBILITY)
    offset = points[k] - rays.places[rays.owner[ray]]
    away = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), MIN_RANGE_M)
    towards, weight = offset / away, responsibility[k, ray, None] / error**2
    identity = np.eye(points.shape[1])
    across = (identity - towards[:, :, None] * towards[:, None, :]) * (weight / away**2)[:, :, None]
    wrong = np.einsum("pcd,pd->pc", across, rays.direction[ray] * away)
    information, pull = np.zeros((len(points), *identity.shape)), np.zeros_like(points)
    np.add.at(information, k, across)
    np.add.at(pull, k, wrong)
    covariance = np.linalg.inv(information + identity / REACH_M**2)
    return points + np.einsum("kcd,kd->kc", covariance, pull), covariance


def _are_distinct(points: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Whether each point (K,) differs from all before it by more than their errors."""
    mask = np.ones(len(points), bool)
    for k in range(1, len(points)):
        offset = points[:k] - points[k]
        whitened = np.linalg.solve(covariance[:k] + covariance[k], offset[..., None])[..., 0]
        mask[k] = not bool((((offset * whitened).sum(1) < SAME_SIGMAS**2) & mask[:k]).any())
    return mask


def _initial_error(rays: Rays, rng: np.random.Generator) -> float | None:
    """Sigma [rad] of the rays of the point of largest evidence, or None without one."""
    trials: list[tuple[float, float]] = []
    if len(rays) > ERROR_SAMPLE:
        rays = rays.select_rays(np.sort(rng.choice(len(rays), ERROR_SAMPLE, replace=False)))
    for error in ERRORS:
        proposed = _midpoints(rays, error, rng, PAIRS // 2, CANDIDATES // 4)
        if not len(proposed):
            continue
        squared_error = rays.squared_error(proposed)
        top = int(np.maximum(_log_ratio(squared_error, error), 0).sum(1).argmax())
        evidence = _refine_point(rays, proposed[top], error)[1]
        if evidence > MIN_EVIDENCE:
            trials.append((evidence, error))
    return max(trials)[1] if trials else None


def _refine_point(rays: Rays, point: np.ndarray, error: float) -> tuple[np.ndarray, float]:
    """One point after `STEPS` Gauss-Newton steps, and its evidence [nats]."""
    points = point[None]
    for _ in range(STEPS):
        responsibility = _responsibility(rays.squared_error(points), error)
        points, covariance = _step_points(rays, points, responsibility, error)
    return points[0], float(
        _evidence(_responsibility(rays.squared_error(points), error), covariance)[0]
    )


def _find_points(
    rays: Rays, mask: np.ndarray, error: float, rng: np.random.Generator
) -> list[np.ndarray]:
    """New points of the mask rays."""
    rest = rays.select_rays(mask)
    proposed = _midpoints(rest, error, rng, PAIRS, CANDIDATES)
    if not len(proposed):
        return []
    gain = np.maximum(_log_ratio(rest.squared_error(proposed), error), 0).astype(np.float32)
    score, points, failed = gain.sum(1), [], 0
    while failed < MAX_FAILURES and score.max() > MIN_EVIDENCE:
        top = int(score.argmax())
        near = rest.select_rays(
            rest.squared_error(proposed[top : top + 1])[0] < (GATE_SIGMAS * error) ** 2
        )
        point, evidence = _refine_point(near, proposed[top], error)
        assigned = gain[top] > 0
        if evidence >= MIN_EVIDENCE:
            points.append(point)
            assigned |= _log_ratio(rest.squared_error(point[None])[0], error) > 0
        else:
            failed += 1
        score -= gain[:, assigned].sum(1)
        gain[:, assigned] = 0
        score[top] = 0
    return points


def _midpoints(
    rays: Rays, error: float, rng: np.random.Generator, pairs: int, limit: int
) -> np.ndarray:
    """Midpoints (m, 3) of rays of two receivers that pass each other within their errors."""
    order = np.argsort(rays.owner, kind="stable")
    owners, starts = np.unique(rays.owner[order], return_index=True)
    if len(owners) < 2:
        return rays.places[:0]
    groups = np.split(order, starts[1:])
    couples = rng.integers(len(groups), size=(pairs, 2))
    points = []
    for a, b in couples[couples[:, 0] != couples[:, 1]]:
        direction, other_direction = rays.direction[groups[a]], rays.direction[groups[b]]
        place, other_place = rays.places[owners[a]], rays.places[owners[b]]
        s, t, gap = closest_ranges_and_gap(place, direction, other_place, other_direction)
        near = gap < 3 * error * np.hypot(s, t)
        i, j = np.nonzero(near)
        points.append(
            (
                place
                + s[i, j, None] * direction[i]
                + other_place
                + t[i, j, None] * other_direction[j]
            )
            / 2
        )
    midpoints = np.concatenate([rays.places[:0], *points])
    midpoints = midpoints[np.linalg.norm(midpoints - rays.places.mean(0), axis=1) < REACH_M]
    if len(midpoints) > limit:
        midpoints = midpoints[rng.choice(len(midpoints), limit, replace=False)]
    return midpoints
