"""Where bundles of measured rays meet, when their directions have errors: places, how sure, and whose rays.

Each ray is a direction of arrival with an unknown error, N(0, sigma^2) about each of two axes, from one of K
points, or it means nothing and comes from anywhere. Points are found one after the other as in matching
pursuit: pairs of rays propose them, all rays judge them, a Bayesian evidence (likelihood against rays that
mean nothing, and how small a part of space the point is in: D. J. C. MacKay 2003, chapter 28) says which are
real. Then all points share all rays by expectation maximisation, which gives sigma as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

LEAST_ERROR, MOST_ERROR = 1e-4, 0.12  # [rad], of a direction: files keep no better ones, worse tell nothing
ERRORS = tuple(np.geomspace(LEAST_ERROR, MOST_ERROR, 7))  # tried on the first point
REACH_M = 40.0  # no image is farther from the receivers' middle
LEAST_EVIDENCE = 6.0  # [nats]
PAIRS = 600  # of receivers whose rays are intersected in a round
SAMPLED = 2000  # rays that say how large errors are
PROPOSED = 1200  # points of them that all rays judge
ROUNDS = 12
STEPS = 6  # of Gauss and Newton for a new point
SHARINGS = 12  # of expectation maximisation
SAME = 4.0  # standard deviations within which two points are one
LEAST_SHARINGS = 3  # how many rays mean nothing must have been heard by all
STILL = 0.02  # relative change of sigma that ends them
LEAST_LOST = 0.02  # share of the rays that mean nothing
LEAST_SHARE = 1e-3  # of a ray that counts for a point
WIDE = 15.0  # sigmas from a proposed point within which rays may be its
FAILURES = 20  # proposals without evidence that end a round
NEAR_M = 0.05  # no point is nearer to a receiver
LEAST_ANGLE = 0.02  # [rad], more parallel rays meet nowhere in particular


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
    def of(places: np.ndarray, rays: list[np.ndarray]) -> Rays:
        """From one array (paths, 3) per receiver."""
        flat = np.concatenate([np.zeros((0, 3)), *rays])
        flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        return Rays(places, flat, np.repeat(np.arange(len(rays)), [len(r) for r in rays]))

    def __len__(self) -> int:
        return len(self.owner)

    def take(self, kept: np.ndarray) -> Rays:
        """Some of them, of the same receivers."""
        return Rays(self.places, self.direction[kept], self.owner[kept])

    def miss(self, points: np.ndarray) -> np.ndarray:
        """Squared angles (K, N) [rad^2] by which the rays miss points (K, 3), as squared chords."""
        ahead = points @ self.direction.T - np.einsum("nc,nc->n", self.places[self.owner], self.direction)
        away = np.linalg.norm(points[:, None] - self.places[None], axis=-1)
        return np.maximum(2 - 2 * ahead / np.maximum(away, 1e-9)[:, self.owner], 0.0)


@dataclass(frozen=True)
class Bundles:
    """K points where rays meet.

    Attributes:
        points: (K, 3) [m].
        covariance: (K, 3, 3) [m^2], what the rays leave open of each.
        share: (K, N), probability that a ray comes from a point.
        error: sigma of a direction about each axis [rad].
    """

    points: np.ndarray
    covariance: np.ndarray
    share: np.ndarray
    error: float

    def seen(self, rays: Rays) -> np.ndarray:
        """(n, K), 1 where a receiver has a ray from a point, else 0."""
        table = np.zeros((len(rays.places), len(self.points)))
        k, ray = np.nonzero(self.share > 0.5)
        table[rays.owner[ray], k] = 1.0
        return table


def meet(rays: Rays, seed: int = 0) -> Bundles:
    """All points where rays meet, the most evident first."""
    rng = np.random.default_rng(seed)
    nowhere = Bundles(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(rays))), MOST_ERROR)
    error = _first_error(rays, rng)
    if error is None:
        return nowhere
    points: list[np.ndarray] = []
    free = np.ones(len(rays), bool)
    for _ in range(ROUNDS):
        found = _round(rays, free, error, rng)
        if not found:
            break
        points += found
        bundles = shared(rays, np.stack(points), error)
        points, error = list(bundles.points), bundles.error
        free = bundles.share.sum(0) < 0.5
    return bundles if points else nowhere


def shared(rays: Rays, points: np.ndarray, error: float) -> Bundles:
    """Points that share all rays: expectation maximisation; without those there twice or without evidence."""
    while True:
        covariance, share = np.zeros((0, 3, 3)), np.zeros((0, len(rays)))
        rate: np.ndarray | float = 1.0
        for turn in range(SHARINGS if len(points) else 0):
            miss = rays.miss(points)
            share = _share(miss, error, rate)
            lost = max(len(rays) - share.sum(), LEAST_LOST * len(rays))
            rate = (np.maximum(share.sum(1), 1e-3) / lost)[:, None]
            before = error
            error = math.sqrt((share * miss).sum() / max(2 * share.sum(), 1e-9))
            error = min(max(error, LEAST_ERROR), MOST_ERROR)
            points, covariance = _steps(rays, points, share, error)
            if turn >= LEAST_SHARINGS and abs(math.log(error / before)) < STILL:
                break
        evidence = _evidence(share, covariance)
        order = np.argsort(-evidence, kind="stable")
        points, covariance, share, evidence = (v[order] for v in (points, covariance, share, evidence))
        kept = _single(points, covariance)
        if kept.all():
            kept = evidence >= LEAST_EVIDENCE
        if kept.all():
            return Bundles(points, covariance, share, error)
        points = points[kept]


def _gain(miss: np.ndarray, error: float) -> np.ndarray:
    """Log likelihood of a ray that comes from a point, against one from anywhere [nats]."""
    return math.log(2 / error**2) - miss / (2 * error**2)


def _share(miss: np.ndarray, error: float, rate: np.ndarray | float = 1.0) -> np.ndarray:
    """Probability (K, N) that rays come from points, that have `rate` times as many as mean nothing."""
    gain = _gain(miss, error) + np.log(rate)
    top = np.maximum(gain.max(0), 0)
    weight = np.exp(gain - top)
    return weight / (weight.sum(0) + np.exp(-top))


def _evidence(share: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """What rays lose in likelihood without each point (K,), less what its place costs [nats]."""
    space = math.log(4 / 3 * math.pi * REACH_M**3)
    place = np.minimum(0.5 * np.linalg.slogdet(2 * math.pi * covariance)[1] - space, 0.0)
    return place - np.log1p(-np.minimum(share, 1 - 1e-12)).sum(1)


def _steps(rays: Rays, points: np.ndarray, share: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (K, 3) after a step of Gauss and Newton on their rays, and their covariances (K, 3, 3)."""
    k, ray = np.nonzero(share > LEAST_SHARE)
    offset = points[k] - rays.places[rays.owner[ray]]
    away = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), NEAR_M)
    towards, weight = offset / away, share[k, ray, None] / error**2
    across = (np.eye(3) - towards[:, :, None] * towards[:, None, :]) * (weight / away**2)[:, :, None]
    wrong = np.einsum("pcd,pd->pc", across, rays.direction[ray] * away)
    known, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    np.add.at(known, k, across)
    np.add.at(pull, k, wrong)
    covariance = np.linalg.inv(known + np.eye(3) / REACH_M**2)
    return points + np.einsum("kcd,kd->kc", covariance, pull), covariance


def _single(points: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Whether each point (K,) differs from all before it by more than their errors."""
    kept = np.ones(len(points), bool)
    for k in range(1, len(points)):
        apart = points[:k] - points[k]
        whitened = np.linalg.solve(covariance[:k] + covariance[k], apart[..., None])[..., 0]
        kept[k] = not bool((((apart * whitened).sum(1) < SAME**2) & kept[:k]).any())
    return kept


def _first_error(rays: Rays, rng: np.random.Generator) -> float | None:
    """Sigma [rad] of the rays of the most evident point of all, or None where none is."""
    best: tuple[float, float] | None = None
    if len(rays) > SAMPLED:
        rays = rays.take(np.sort(rng.choice(len(rays), SAMPLED, replace=False)))
    for error in ERRORS:
        proposed = _proposed(rays, error, rng, PAIRS // 2, PROPOSED // 4)
        if not len(proposed):
            continue
        miss = rays.miss(proposed)
        top = int(np.maximum(_gain(miss, error), 0).sum(1).argmax())
        evidence = _settled(rays, proposed[top], error)[1]
        if evidence > LEAST_EVIDENCE and (best is None or evidence > best[0]):
            best = evidence, error
    return None if best is None else best[1]


def _settled(rays: Rays, point: np.ndarray, error: float) -> tuple[np.ndarray, float]:
    """One point after its steps, and its evidence [nats]."""
    points, covariance = point[None], np.zeros((1, 3, 3))
    for _ in range(STEPS):
        points, covariance = _steps(rays, points, _share(rays.miss(points), error), error)
    return points[0], float(_evidence(_share(rays.miss(points), error), covariance)[0])


def _round(rays: Rays, free: np.ndarray, error: float, rng: np.random.Generator) -> list[np.ndarray]:
    """New points of the rays that are free."""
    left = rays.take(free)
    proposed = _proposed(left, error, rng, PAIRS, PROPOSED)
    if not len(proposed):
        return []
    gain = np.maximum(_gain(left.miss(proposed), error), 0).astype(np.float32)
    score, found, failed = gain.sum(1), [], 0
    while failed < FAILURES and score.max() > LEAST_EVIDENCE:
        top = int(score.argmax())
        near = left.take(left.miss(proposed[top : top + 1])[0] < (WIDE * error) ** 2)
        point, evidence = _settled(near, proposed[top], error)
        taken = gain[top] > 0
        if evidence >= LEAST_EVIDENCE:
            found.append(point)
            taken |= _gain(left.miss(point[None])[0], error) > 0
        else:
            failed += 1
        score -= gain[:, taken].sum(1)
        gain[:, taken] = 0
        score[top] = 0
    return found


def _proposed(rays: Rays, error: float, rng: np.random.Generator, pairs: int, most: int) -> np.ndarray:
    """Points (m, 3) half way between rays of two receivers that pass each other within their errors."""
    order = np.argsort(rays.owner, kind="stable")
    owners, starts = np.unique(rays.owner[order], return_index=True)
    if len(owners) < 2:
        return np.zeros((0, 3))
    groups = np.split(order, starts[1:])
    drawn = rng.integers(len(groups), size=(pairs, 2))
    points = []
    for a, b in drawn[drawn[:, 0] != drawn[:, 1]]:
        one, two = rays.direction[groups[a]], rays.direction[groups[b]]
        here, there = rays.places[owners[a]], rays.places[owners[b]]
        s, t, gap = _passing(here, one, there, two)
        near = gap < 3 * error * np.hypot(s, t)
        i, j = np.nonzero(near)
        points.append((here + s[i, j, None] * one[i] + there + t[i, j, None] * two[j]) / 2)
    found = np.concatenate([np.zeros((0, 3)), *points])
    found = found[np.linalg.norm(found - rays.places.mean(0), axis=1) < REACH_M]
    if len(found) > most:
        found = found[rng.choice(len(found), most, replace=False)]
    return found


def _passing(
    here: np.ndarray, one: np.ndarray, there: np.ndarray, two: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far along rays (P, 3) and (Q, 3) they pass each other, and in what distance: three of (P, Q) [m].

    The distance is infinite behind a receiver and between nearly parallel rays.
    """
    offset, cosine = there - here, one @ two.T
    first, second = (one @ offset)[:, None], (two @ offset)[None, :]
    sine2 = np.maximum(1 - cosine**2, LEAST_ANGLE**2)
    s, t = (first - cosine * second) / sine2, (cosine * first - second) / sine2
    gap = np.linalg.norm(offset + t[..., None] * two[None] - s[..., None] * one[:, None], axis=-1)
    return s, t, np.where((s > 0) & (t > 0) & (1 - cosine**2 > LEAST_ANGLE**2), gap, np.inf)
