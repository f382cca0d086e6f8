"""Where predictions are off beside measured levels: by cell, by ring of distance, by area.

Rows of a square of floor err together, so that a mean error is known no better than its squares
tell; intervals are wide enough that all of them hold at once in 90 of 100 drives.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsparc.data.spacing import squares_of_extent
from gsparc.processes.uncertainty import half_width, standard_error

ALL_HOLD = 0.9
RINGS = np.array([1.0, 2.0, 5.0]) * 10.0 ** np.arange(-1, 5)[:, None]  # ends of rings [m]
SIDES, SQUARES = 10, 40  # areas, and squares that err together, along the longer side of a drive
LEAST_ROWS, LEAST_SQUARES = 10, 3  # of a part
MOST_LISTED = 5  # parts that are surely off


@dataclass(frozen=True)
class Drive:
    """Measured levels beside what was said of them.

    Attributes:
        error_db: (n,) predicted less measured; NaN where nothing was said.
        half_db: (n,) half of the interval said; NaN where none was.
        place: (n, 2) [m].
        distance: (n,) from its station [m], NaN where that is unknown.
        station: (n,) number, and the stations' names.
        names: see `station`.
        share: of measurements that intervals are to hold.
    """

    error_db: np.ndarray
    half_db: np.ndarray
    place: np.ndarray
    distance: np.ndarray
    station: np.ndarray
    names: Sequence[str]
    share: float = 0.9

    @property
    def area_m(self) -> float:
        """Side of an area [m], a round number."""
        wanted = max(float(np.ptp(self.place, axis=0).max()), 1e-3) / SIDES
        return float(RINGS.ravel()[max(np.searchsorted(RINGS.ravel(), wanted) - 1, 0)])

    def parts(self) -> Iterator[tuple[str, str, np.ndarray]]:
        """Return kind, name and rows (n,) bool of all parts with rows enough; `all` first."""
        said = np.isfinite(self.error_db)
        yield "all", "", said
        ring = np.searchsorted(RINGS.ravel(), self.distance)
        ring = np.where(np.isfinite(self.distance), ring, -1)
        corner = np.floor(self.place / self.area_m).astype(int)
        ends = np.concatenate([[0.0], RINGS.ravel()])
        for number in np.unique(self.station):
            yield "cell", self.names[number], said & (self.station == number)
        for k in np.unique(ring[ring >= 0]):
            yield (
                "ring",
                f"{ends[k]:g} to {ends[min(k + 1, len(ends) - 1)]:g} m",
                said & (ring == k),
            )
        for at in np.unique(corner, axis=0):
            name = " ".join(f"{v:g}" for v in (at + 0.5) * self.area_m)
            yield "area", name, said & (corner == at).all(axis=1)

    def judge(self) -> list[dict[str, Any]]:
        """Return a record for each part: rows, squares, bias with its interval, rmse [dB], share of
        rows within their own interval, None where none was said.
        """
        if not len(self.place):
            return []
        square = squares_of_extent(self.place, SQUARES)
        parts = [
            part
            for part in self.parts()
            if part[2].sum() >= LEAST_ROWS and len(np.unique(square[part[2]])) >= LEAST_SQUARES
        ]
        wanted = 1 - (1 - ALL_HOLD) / max(len(parts), 1)
        records = []
        for kind, name, rows in parts:
            error, half, squares = self.error_db[rows], self.half_db[rows], square[rows]
            bias, count = float(error.mean()), len(np.unique(squares))
            spread = half_width(wanted, count - 1) * standard_error(error, squares)
            said = np.isfinite(half)
            record = {"part": kind, "name": name, "rows": len(error), "squares": count}
            ends = {"bias_low_db": bias - spread, "bias_high_db": bias + spread}
            record |= {"bias_db": bias, **ends, "rmse_db": float(np.sqrt(np.mean(error**2)))}
            within = float((np.abs(error) <= half)[said].mean()) if said.any() else None
            records.append({**record, "within": within})
        return records


def describe_parts(records: Sequence[dict[str, Any]], share: float) -> list[str]:
    """Return what a reader must know of `Drive.judge`: the whole, and parts that are surely off."""
    if not records:
        return ["too few rows to judge by"]
    whole, *others = records
    within = whole["within"]
    held = "" if within is None else f", {within:.1%} within {share:.0%} intervals"
    size = f"{whole['rows']} rows: predicted less measured {whole['bias_db']:+.2f} dB in the mean"
    lines = [f"{size}, rmse {whole['rmse_db']:.2f} dB{held}"]
    sure = [row for row in others if row["bias_low_db"] > 0 or row["bias_high_db"] < 0]
    sure.sort(key=lambda row: -abs(row["bias_db"]))
    if sure:
        listed = ", ".join(
            f"{row['part']} {row['name']} {row['bias_db']:+.1f} dB ({row['rows']} rows)"
            for row in sure[:MOST_LISTED]
        )
        few = f"{len(sure)} of {len(others)} cells, rings and areas are surely off (by_part.csv)"
        lines.append(f"{few}: {listed}")
    return lines
