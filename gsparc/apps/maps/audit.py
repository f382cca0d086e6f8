"""An audit of a published map: places are drawn before a drive, a verdict is read after it.

What is drawn by chance judges the claim whatever a model believes; the model only says where half
of the places are drawn, and weights take that out again (`gsparc.processes.betting`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gsparc.apps.maps.claim import Claim
from gsparc.apps.maps.streets import StreetGraph, Tour, Ways
from gsparc.base.errors import DataError, explain_error
from gsparc.processes.betting import claim_capital, power_of_rows, verdict_of

CLIP_DB = 20.0  # errors of levels beyond count as this much
PARTS = np.array([0.0, 0.25, 0.5])  # of a tour that is drawn where the model doubts
BELIEVED = 2.0  # failures that the model's doubt counts as much as
WRITTEN = ("audit", "tour", "stop", "place", "x", "y", "part", "ratio")  # of `draws.csv`


@dataclass(frozen=True)
class Question:
    """What a claim is held to.

    Attributes:
        threshold_db: level from which on a place is served; None: levels are claimed.
        share: of the places called served that are.
        within_db: ends between which the mean of claimed less measured lies; None: no end.
    """

    threshold_db: float | None
    share: float = 0.95
    within_db: tuple[float | None, float | None] | None = None

    def __post_init__(self) -> None:
        """Refuse what asks for both, or for nothing."""
        if (self.threshold_db is None) == (self.within_db is None):
            raise DataError(
                "say threshold_dbm=-110 share=0.95 for a claim of coverage, or within_db=3 for one "
                "of levels, and not both"
            )
        low, high = self.ends
        if not 0 <= low < high <= 1 or (low, high) == (0, 1):
            raise DataError(f"within_db={self.within_db}: expected ends within {CLIP_DB:g} dB")

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the claimed mean, of values within 0 to 1."""
        if self.within_db is None:
            return self.share, 1.0
        low, high = (
            end if db is None else (db + CLIP_DB) / (2 * CLIP_DB)
            for db, end in zip(self.within_db, (0.0, 1.0), strict=True)
        )
        return low, high

    @property
    def words(self) -> str:
        """What is claimed."""
        if self.threshold_db is not None:
            return f"{self.share:.4g} of the claimed places reach {self.threshold_db:g} dBm"
        low, high = (
            end if db is None else f"{db:g}"
            for db, end in zip(self.within_db or (), ("anything", "anything"), strict=True)
        )
        return f"claimed less measured is within {low} to {high} dB in the mean"

    def bounds(
        self, claimed: np.ndarray, level: np.ndarray, side: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds (n,) of values within 0 to 1 of rows (n,).

        Args:
            claimed: [dB].
            level: measured [dB].
            side: 1 where the level lies below what is written, -1 above, 0 measured.
        """
        if self.threshold_db is not None:
            reached = (level >= self.threshold_db) * 1.0
            low, high = np.where(side > 0, 0.0, reached), np.where(side < 0, 1.0, reached)
            return low, high
        value = np.clip((claimed - level) / (2 * CLIP_DB) + 0.5, 0, 1)
        return np.where(side < 0, 0.0, value), np.where(side > 0, 1.0, value)

    def power(self, count: int) -> str:
        """Say what so many rows can show at all."""
        if self.threshold_db is None:
            return _power_of_levels(self, count)
        below, above = power_of_rows(count, self.share, 0.8)
        if np.isnan(below):
            return f"with {count} rows nothing can stand or fall"
        stand = "none can stand" if np.isnan(above) else f"only one above {above:.4f} can stand"
        return f"with {count} rows only a share below {below:.2f} can fall; {stand} (4 of 5 times)"


def _power_of_levels(question: Question, count: int) -> str:
    random, found = np.random.default_rng(0), list[tuple[int, str]]()
    low, high = question.within_db or (0.0, 0.0)
    for bias in range(int(low or 0), int(CLIP_DB) + 1):
        error = random.normal(bias, 9.0, (100, count))
        value = np.clip(error / (2 * CLIP_DB) + 0.5, 0, 1)
        stands, falls = (c[:, -1] >= 20 for c in claim_capital(value, value, question.ends))
        if stands.mean() >= 0.8:
            found.append((bias, "stand"))
        if falls.mean() >= 0.8 and bias > (high or 0):
            found.append((bias, "fall"))
    stand = [bias for bias, word in found if word == "stand"]
    fall = [bias for bias, word in found if word == "fall"]
    return (
        f"with {count} rows of a deviation of 9 dB "
        + (f"a bias up to {max(stand)} dB can stand" if stand else "none can stand")
        + (f"; one from {min(fall)} dB on falls" if fall else "; none can fall")
        + " (4 of 5 times)"
    )


def digest_of(claim: Claim, question: Question) -> str:
    """Return what tells one audit from another: of file, places and question, 16 digits."""
    content = f"{claim.digest} {question}".encode() + claim.place.round(3).tobytes()
    return sha256(content).hexdigest()[:16]


def doubt_part(
    weight: np.ndarray, failed: np.ndarray, ratio: np.ndarray, doubt: np.ndarray
) -> float:
    """Return which part of the next tour is drawn where the model doubts: as if failures lay as
    they did so far, and a few of them as the model believes.

    Bets gain most where failures have small weights: these are what is made least. It depends on
    earlier tours alone, so that bets remain fair.

    Args:
        weight, failed: (n,) of rows so far, see `betting_capital`.
        ratio: (n,) how much likelier doubt alone made each than an even draw.
        doubt: (M,) the same of all places.
    """
    by_rows, by_doubt = (1 / (1 - PARTS + PARTS * r[:, None]) for r in (ratio, doubt))
    costs = (weight * failed) @ by_rows + BELIEVED * np.mean(doubt[:, None] * by_doubt, axis=0)
    return float(PARTS[costs.argmin()])


def draw_tours(
    claim: Claim,
    audit: str,
    doubt: np.ndarray,
    part: float,
    numbers: Sequence[int],
    size: int,
    seed: int,
    streets: StreetGraph | None = None,
    start: Sequence[float] | None = None,
) -> tuple[pd.DataFrame, list[np.ndarray]]:
    """Draw tours of places and order each into a short way; returns the rows of `draws.csv`, and
    corners (m, 2) [m] of each way.

    Args:
        claim: places that are drawn.
        audit: see `digest_of`.
        doubt: (M,) how much likelier doubt alone makes each than an even draw; 1 in the mean.
        part: of places that are drawn by doubt.
        numbers: of the tours; each has random numbers of its own.
        size: places of a tour.
        seed: of what is drawn.
        streets: along which the way goes; None: straight.
        start: (2,) where each begins [m]; None: anywhere.
    """
    chance = (1 - part + part * doubt) / len(claim)
    frames, ways_of = [], []
    for number in numbers:
        random = np.random.default_rng([seed, number])
        place = random.choice(len(claim), size, p=chance / chance.sum())
        each, index = np.unique(place, return_inverse=True)
        begin = np.zeros((0, 2)) if start is None else np.reshape(start, (1, 2)).astype(float)
        ways = Ways.between(np.concatenate([claim.place[each], begin]), streets)
        tour = Tour(ways.length, len(each) if len(begin) else None, None)
        for each_stop in range(len(each)):
            tour.add(each_stop)
        walk = tour.walk[1:-1]
        stop = np.argsort(walk)[index.reshape(-1)]
        order = np.argsort(stop, kind="stable")
        place, stop = place[order], stop[order] + 1
        columns: dict[str, Any] = {"audit": audit, "tour": number, "stop": stop, "place": place}
        columns |= claim.coordinates(claim.place[place])
        columns |= {"claim_db": claim.level[place].round(2), "part": part, "ratio": doubt[place]}
        frames.append(pd.DataFrame(columns | {"seed": seed}))
        ways_of.append(ways.path_through(tour.walk[0 if len(begin) else 1 : -1]))
    return pd.concat(frames, ignore_index=True), ways_of


def read_draws(path: str | Path, audit: str, claim: Claim) -> pd.DataFrame:
    """Read drawn places.

    Raises:
        DataError: none, or those of another audit.
    """
    try:
        draws = pd.read_csv(path, dtype={"audit": str})
    except (OSError, ValueError) as error:
        raise DataError(f"drawn={path}: {explain_error(error)}") from None
    if missing := {*WRITTEN} - {*draws.columns}:
        raise DataError(f"drawn={path}: no draws.csv of gsparc audit, lacks {sorted(missing)}")
    if not len(draws) or (draws.audit != audit).any():
        raise DataError(
            f"drawn={path}: drawn for another claim, area, threshold or share ({audit} is asked); "
            "repeat these as they were, or draw anew without drawn="
        )
    if not draws.place.between(0, len(claim) - 1).all() or (np.diff(draws.tour) < 0).any():
        raise DataError(f"drawn={path}: its rows were edited; expected them as they were written")
    return draws


@dataclass(frozen=True)
class DriveRows:
    """Rows of a drive, of what is audited.

    Attributes:
        place: (n, 2) in the claim's metres.
        level: (n,) measured [dB].
        side: (n,) see `Question.bounds`.
        station: (n,) number; places are judged by the best of them.
    """

    place: np.ndarray
    level: np.ndarray
    side: np.ndarray
    station: np.ndarray

    def at_draws(
        self, claim: Claim, draws: pd.DataFrame, question: Question, reach: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return bounds (n,) of the value of each drawn place, and whether it was reached (n,).

        A place has the share of its rows within reach [m] that hold, of its best station.
        """
        number = draws.place.to_numpy()
        near = cKDTree(self.place).query_ball_point(claim.place[number], reach)
        low, high = np.zeros(len(draws)), np.ones(len(draws))
        for k, rows in enumerate(near):
            if not rows:
                continue
            claimed = np.full(len(rows), claim.level[number[k]])
            ends = question.bounds(claimed, self.level[rows], self.side[rows])
            kind = np.unique(self.station[rows], return_inverse=True)[1]
            means = np.array([np.bincount(kind, end) for end in ends]) / np.bincount(kind)
            # The strongest serves: most hold, and least is claimed beyond what it has.
            low[k], high[k] = means.max(1) if question.threshold_db is not None else means.min(1)
        return low, high, np.array([len(rows) > 0 for rows in near], bool)


@dataclass(frozen=True)
class Outcome:
    """An audit after its tours.

    Attributes:
        verdict: `stands`, `falls` or `open`.
        rows: drawn places that it took.
        reached: (n,) bool, of the drawn places of all tours that were begun.
        low, high: (n,) bounds of their values.
        stands, falls: (n,) capitals.
        weight: (n,) of each place.
        ends: (T,) places at the end of each tour.
    """

    verdict: str
    rows: int
    reached: np.ndarray
    low: np.ndarray
    high: np.ndarray
    stands: np.ndarray
    falls: np.ndarray
    weight: np.ndarray
    ends: np.ndarray


def judge(
    claim: Claim,
    draws: pd.DataFrame,
    rows: DriveRows,
    question: Question,
    reach: float,
    reachable_only: bool = False,
) -> Outcome:
    """Return the verdict at the end of the tours that were begun.

    A place without rows counts against both verdicts, so that a tour which goes on never takes one
    back; or, where the reachable area alone is judged, not at all.
    """
    low, high, reached = rows.at_draws(claim, draws, question, reach)
    tour = draws.tour.to_numpy()
    begun = tour <= (tour[reached].max() if reached.any() else -1)
    low, high, reached, tour = low[begun], high[begun], reached[begun], tour[begun]
    part, ratio = (draws[name].to_numpy()[begun] for name in ("part", "ratio"))
    weight = 1 / (1 - part + part * ratio)
    counted = np.where(reached | (not reachable_only), weight, 0.0)
    stands, falls = claim_capital(low, high, question.ends, counted, 1 / (1 - part))
    ends = np.flatnonzero(np.diff(tour, append=np.inf)) + 1
    verdict, count = verdict_of(stands, falls, ends)
    return Outcome(verdict, count, reached, low, high, stands, falls, weight, ends)


def even_rate(outcome: Outcome) -> tuple[float, float]:
    """Return bounds of the mean value of all places by those drawn, weights in it."""
    total = max(float(outcome.weight.sum()), 1e-300)
    low, high = (float(outcome.weight @ end) / total for end in (outcome.low, outcome.high))
    return low, high


def doubt_ratio(chance: np.ndarray | None, count: int) -> np.ndarray:
    """Return chances of failing (M,) over their mean; 1 of each where nothing tells them apart."""
    if chance is None or not np.ptp(chance) > 0:
        return np.ones(count)
    return np.asarray(chance / chance.mean())


def outside(claim: Claim, place: np.ndarray, given: Mapping[str, Any]) -> np.ndarray:
    """Return which rows (n,) at places (n, 2) lie in no claimed square.

    Raises:
        DataError: all do.
    """
    away = claim.nearest(place, 0.75 * claim.step) < 0
    if away.all():
        middle = [np.round(np.median(at, axis=0)).tolist() for at in (claim.place, place)]
        raise DataError(
            f"rows={given['rows']}: all {len(place)} rows lie outside what is claimed, about "
            f"{middle[1]} m, the claim about {middle[0]} m"
        )
    return away
