"""An audit of a published map: places are drawn before a drive, a verdict is read after it.

What is drawn by chance judges the claim whatever a model believes; the model only says where half
of the places are drawn, and weights take that out again (`gsparc.processes.betting`).
"""

from __future__ import annotations

from collections.abc import Sequence
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
from gsparc.processes.betting import claim_capital, detectable_shares, verdict_of

CLIP_DB = 20.0  # errors of levels beyond count as this much
PARTS = np.array([0.0, 0.25, 0.5])  # of a tour that is drawn where the model doubts
SPREAD_DB = 9.0  # of measured levels about a planned one, before any row
BELIEVED = 2.0  # failures that the model's doubt counts as much as
OFTEN = 0.8  # chance that rows show what they are said to
WRITTEN = ("audit", "tour", "stop", "place", "x", "y", "part", "ratio")  # of `draws.csv`


@dataclass(frozen=True)
class Demand:
    """What a claim is held to.

    Attributes:
        threshold_db: level from which on a place is served; None: levels are claimed.
        share: of the places called served that are.
        within_db: ends between which the mean of claimed less measured lies; 20 dB is no end.
    """

    threshold_db: float | None
    share: float = 0.95
    within_db: tuple[float, float] = (-CLIP_DB, CLIP_DB)

    def __post_init__(self) -> None:
        """Refuse what asks for both, or for nothing."""
        low, high = self.ends
        both = self.threshold_db is not None and self.within_db != (-CLIP_DB, CLIP_DB)
        if both or not 0 <= low < high <= 1 or high - low == 1:
            raise DataError(
                "say threshold_dbm=-110 share=0.95 for a claim of coverage, or for one of levels "
                f"within_db=[-3,3], within {CLIP_DB:g} dB; and not both"
            )

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the claimed mean, of values within 0 to 1."""
        low, high = (end / (2 * CLIP_DB) + 0.5 for end in self.within_db)
        return (low, high) if self.threshold_db is None else (self.share, 1.0)

    @property
    def words(self) -> str:
        """What is claimed."""
        if self.threshold_db is not None:
            return f"{self.share:.4g} of the claimed places reach {self.threshold_db:g} dBm"
        low, high = self.within_db
        return f"claimed less measured is {low:g} to {high:g} dB in the mean, clipped at 20"

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
            value, up = (level >= self.threshold_db) * 1.0, side < 0
            return np.where(side > 0, 0.0, value), np.where(up, 1.0, value)
        value = np.clip((claimed - level) / (2 * CLIP_DB) + 0.5, 0, 1)
        return np.where(side < 0, 0.0, value), np.where(side > 0, 1.0, value)

    def power(self, count: int) -> str:
        """Say what so many rows can show at all."""
        if self.threshold_db is None:
            return f"what {count} rows show of levels depends on their scatter: docs/audit.md"
        below, above = detectable_shares(count, self.share, OFTEN)
        fall = "none" if np.isnan(below) else f"only a share below {below:.2f}"
        stand = "none" if np.isnan(above) else f"only one above {above:.4f}"
        return f"with {count} rows {fall} can fall, {stand} can stand ({OFTEN:.0%} of the times)"


def digest_of(claim: Claim, demand: Demand) -> str:
    """Return what tells one audit from another: of file, places and demand, 16 digits."""
    return sha256(f"{claim.digest} {demand}".encode() + claim.place.round(3).tobytes()).hexdigest()[
        :16
    ]


def digest(path: str | Path) -> str:
    """Return what tells a file from others, 16 digits."""
    return sha256(Path(path).read_bytes()).hexdigest()[:16]


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


def sample_tours(
    claim: Claim,
    audit: str,
    doubt: np.ndarray,
    part: float,
    numbers: Sequence[int],
    size: int,
    seed: int,
    streets: StreetGraph | None = None,
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
    """
    chance = (1 - part + part * doubt) / len(claim.place)
    frames, ways_of = [], []
    for number in numbers:
        random = np.random.default_rng([seed, number])
        place = random.choice(len(claim.place), size, p=chance / chance.sum())
        each, times = np.unique(place, return_counts=True)
        ways = Ways.between(claim.place[each], streets)
        tour = Tour(ways.length, None, None)
        for each_place in range(len(each)):
            tour.add(each_place)
        walk = tour.walk[1:-1]
        place = np.repeat(each[walk], times[walk])
        columns: dict[str, Any] = {"audit": audit, "tour": number, "stop": range(1, size + 1)}
        columns |= {"place": place, **claim.coordinates(claim.place[place])}
        columns |= {"claim_db": claim.level[place].round(2), "part": part, "ratio": doubt[place]}
        frames.append(pd.DataFrame(columns | {"seed": seed}))
        ways_of.append(ways.path_through(walk))
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
    whole = {*WRITTEN} <= {*draws.columns} and draws.place.between(0, len(claim.place) - 1).all()
    if not whole or not len(draws) or (draws.audit != audit).any():
        raise DataError(
            f"drawn={path}: no draws of this claim, area, threshold and share ({audit}), as they "
            "were written; ask as when they were drawn, or draw anew without drawn="
        )
    return draws


@dataclass(frozen=True)
class DriveRows:
    """Rows of a drive, of what is audited.

    Attributes:
        place: (n, 2) in the claim's metres.
        level: (n,) measured [dB].
        side: (n,) see `Demand.bounds`.
        station: (n,) number; places are judged by the best of them.
    """

    place: np.ndarray
    level: np.ndarray
    side: np.ndarray
    station: np.ndarray

    def at_draws(
        self, claim: Claim, draws: pd.DataFrame, demand: Demand, reach: float
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
            ends = demand.bounds(claimed, self.level[rows], self.side[rows])
            kind = np.unique(self.station[rows], return_inverse=True)[1]
            means = np.array([np.bincount(kind, end) for end in ends]) / np.bincount(kind)
            # The strongest serves: most hold, and least is claimed beyond what it has.
            low[k], high[k] = means.max(1) if demand.threshold_db is not None else means.min(1)
        return low, high, np.array([len(rows) > 0 for rows in near], bool)


def judge(
    claim: Claim,
    draws: pd.DataFrame,
    rows: DriveRows,
    demand: Demand,
    reach: float,
    reachable_only: bool = False,
) -> tuple[str, int, pd.DataFrame]:
    """Return the verdict `stands`, `falls` or `open`, after how many drawn places, and the draws of
    the tours that were begun with bounds `low` and `high` of their values, whether they were
    `reached`, their `weight`, and the capitals `stands` and `falls`.

    A place without rows counts against both verdicts, so that a tour which goes on never takes one
    back; or, where the reachable area alone is judged, not at all.
    """
    low, high, reached = rows.at_draws(claim, draws, demand, reach)
    weight = np.where(
        reached | (not reachable_only), 1 / (1 - draws.part + draws.part * draws.ratio), 0.0
    )
    table = draws.assign(low=low, high=high, reached=reached, weight=weight)
    table = table[table.tour <= table.tour[reached].max()]
    low, high, most = (end.to_numpy() for end in (table.low, table.high, 1 / (1 - table.part)))
    stands, falls = claim_capital(low, high, demand.ends, table.weight.to_numpy(), most)
    verdict, count = verdict_of(stands, falls, count_draws_by_tour_end(table))
    return verdict, count, table.assign(stands=stands, falls=falls)


def count_draws_by_tour_end(table: pd.DataFrame) -> np.ndarray:
    """Return how many draws (T,) there are at the end of each tour."""
    return np.flatnonzero(np.diff(table.tour, append=np.inf)) + 1
