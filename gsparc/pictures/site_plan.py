"""A site from above: where was measured, what looks wrong,
and what a field found beside what is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gsparc.data.outliers import find_outliers, too_far
from gsparc.data.schema import ENDS, Measurements
from gsparc.datasets.describe import (
    distinct_places,
    held_out_block_rows,
    propose_side,
    spacing_words,
)
from gsparc.physics.decibels import to_decibels
from gsparc.pictures.drawing import PALETTE, save
from gsparc.pictures.from_above import (
    INCHES,
    annotate,
    draw_stations,
    draw_values,
    legend_below,
    map_panels,
    set_bounds,
    split_frame,
)
from gsparc.tables.checks.level_steps import LevelStep, LinkLevels
from gsparc.tables.checks.plausibility import find_outlier_rows

NAMED = 15  # stations; of more only their number is said
MOST_JUMPS = 4  # stations in the second column: those that change most
MOST_MARKS = 8  # suspicious places that are named
HELD_OUT = "#F3C9A5"


@dataclass(frozen=True)
class Spots:
    """Distinct places of the moving end.

    Attributes:
        place: (n, 2) world x and y [m].
        level_db: (n,) [dB], NaN where nothing was heard; None of spectra.
        label: what the level is.
        rows: (n,) what messages call the first row at each.
        far: (n,) bool, too far from all others to be drawn among them.
        suspicious: (n,) bool, rows of outliers and of levels far from those around.
    """

    place: np.ndarray
    level_db: np.ndarray | None
    label: str
    rows: list[str]
    far: np.ndarray
    suspicious: np.ndarray


def find_spots(data: Measurements, levels: LinkLevels | None) -> Spots:
    """Return places of the moving end, levels there and what looks wrong;
    of the receiver where both move.
    """
    site = data.site
    of_row = data.moving[:, -3:]
    # np.unique sorts by coordinate; `first` leads back to the order of measuring.
    place, first, which = np.unique(of_row, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # as measured: later ones are drawn above
    which = np.argsort(order)[which.reshape(-1)]
    place, count = place[order], len(place)
    far, suspicious = np.zeros((2, count), bool)
    far[which[too_far(data.moving)]] = True
    for rows in find_outliers(data).values():
        suspicious[which[rows]] = True
    if levels is not None:
        outliers = [rows for _, rows, _ in find_outlier_rows(levels)]
        wild = levels.position[np.concatenate([np.zeros(0, np.int64), *outliers])]
        suspicious[cKDTree(place + site.origin).query(wild)[1]] = True
    level, label = _levels(data, which, count)
    names = [data.row_names[i].partition(", station")[0] for i in first[order]]
    return Spots(place[:, :2] + site.origin[:2], level, label, names, far, suspicious)


def _levels(data: Measurements, which: np.ndarray, count: int) -> tuple[np.ndarray | None, str]:
    """Level (count,) [dB] at each place that rows `which` (S,) are of, and what it is."""
    several = data.site.several
    if not (data.site.target.is_complex or data.site.target.is_level):
        return None, ""
    power = data.powers()
    heard = np.ones(power.shape, bool) if data.mask is None else data.mask.reshape(power.shape)
    heard = heard | (data.censored_side() < 0)[:, None]  # in saturation, too
    row, entry = np.nonzero(heard & (power > 0))
    in_decibels, value = data.site.target.is_level, power[row, entry]
    # Powers of channels are averaged linearly, levels of a station in decibels.
    value = to_decibels(value) if in_decibels else value
    each = [which[row], data.stations_of(row) if in_decibels else which[row]]
    level = (
        pd.Series(value)
        .groupby(each)
        .mean()
        .groupby(level=0)
        .max()
        .reindex(range(count))
        .to_numpy()
    )
    if in_decibels:
        of = " of the strongest station" if several else ""
        return level, f"received power{of} [{data.site.level_unit}]"
    with np.errstate(divide="ignore"):
        return to_decibels(level), "mean channel power" + (
            " of all stations" if several else ""
        ) + " [dB]"


def draw_site(
    data: Measurements,
    path: Path,
    levels: LinkLevels | None,
    steps: Sequence[tuple[int, LevelStep]] = (),
) -> None:
    """Save a map of places and stations as PNG and, beside it, the levels of stations that jump.

    `levels` are the `link_levels` of powers, `steps` their `level_steps.find_level_steps`.
    """
    places = find_spots(data, levels)
    points = [places.place[~places.far], static_positions(data)]  # but those far outside
    points += [data.ends[end][:, :2] + data.site.origin[:2] for end in data.site.moving_ends[:-1]]
    frames = split_frame(np.concatenate(points))
    jumping = sorted(
        {t for t, _ in steps}, key=lambda t: -max(abs(s.change_db) for u, s in steps if u == t)
    )
    jumping = jumping[:MOST_JUMPS] if levels is not None else []
    figure, axes, room = map_panels(frames, 1, 6.0 * bool(jumping), 2.2 * len(jumping))
    if room is not None and levels is not None:
        rows = room.subgridspec(len(jumping), 1).subplots(squeeze=False)[:, 0]
        for panel, t in zip(rows, jumping, strict=True):
            panel.grid(alpha=0.3)
            of_station = [step for u, step in steps if u == t]
            _draw_level(panel, levels, t, of_station, data.site.level_unit)
    size = _size(places.place[~places.far], float(max((high - low).max() for low, high in frames)))
    heard = ~places.far
    if places.level_db is not None:
        heard = heard & np.isfinite(places.level_db)
        if heard.any():
            draw_values(
                axes[0],
                places.place[heard],
                places.level_db[heard],
                size,
                0.01,
                places.label,
                extend="both",
            )
    for axis, (low, high) in zip(axes[0], frames, strict=True):
        axis.grid(alpha=0.3)
        _draw_map(axis, data, places, low, high, jumping, size)
    legend_below(figure, 4)
    figure.suptitle(_title(data, places))
    save(figure, path)


def _title(data: Measurements, places: Spots) -> str:
    stations, called = data.site.stations, data.site.target.called
    at = "" if stations is None else f", {len(stations)} station{'s' * (len(stations) > 1)}"
    spacing = spacing_words(distinct_places(data), data.site.carriers).partition(";")[0]
    return f"{data.site.name}: {len(data)} {called} at {len(places.place)} places{at}\n{spacing}"


def static_positions(data: Measurements) -> np.ndarray:
    """Return world x and y (T, 2) of the ends that stand still, where that is known."""
    place = data.site.every_station.position[:, :2] + data.site.origin[:2]
    return place if np.isfinite(place).any() else place[:0]


def _draw_map(
    axis: Any,
    data: Measurements,
    places: Spots,
    low: np.ndarray,
    high: np.ndarray,
    jumping: Sequence[int],
    size: float,
) -> None:
    site, inside = data.site, ~places.far
    for end in site.moving_ends[:-1]:
        other = np.unique(data.ends[end][:, :2], axis=0) + site.origin[:2]
        axis.scatter(*other.T, s=10, c="0.55", marker="s", linewidths=0, label=ENDS[end])
    name = ENDS[site.moving_end]
    if places.level_db is None or not np.isfinite(places.level_db[inside]).any():
        axis.scatter(*places.place[inside].T, s=size, c=PALETTE[0], linewidths=0, label=name)
    else:
        silent = places.place[inside & ~np.isfinite(places.level_db)]
        if len(silent):
            axis.scatter(*silent.T, s=size, c="0.8", linewidths=0, label=f"{name}, nothing heard")
        axis.scatter([], [], s=25, c="0.4", linewidths=0, label=name)  # whose colours are the bar's
    side = propose_side(data)
    test = np.zeros(0, np.int64) if side is None else held_out_block_rows(data, side)
    if len(test):
        ring = np.unique(data.moving[test, -3:-1], axis=0) + site.origin[:2]
        label = f"pale rim: held out by split=blocks split.side_m={side:g}"
        # Beneath the values: what is held out is seen, and its levels are, too.
        axis.scatter(*ring.T, s=4 * size, c=HELD_OUT, linewidths=0, zorder=0.5, label=label)
    set_bounds(axis, low, high, site.georeference)
    _draw_stations(axis, data, jumping)
    _draw_suspicious(axis, places, low, high)


def _size(place: np.ndarray, extent: float) -> float:
    """Area [points^2] of a mark as large as the distance between neighbours."""
    spacing = (
        float(np.median(cKDTree(place).query(place, k=2)[0][:, 1])) if len(place) > 1 else extent
    )
    # 72 points are an inch; clipped to what is seen (2.5) and hides no neighbours (9).
    return float(np.clip(72 * INCHES * spacing / extent, 2.5, 9.0)) ** 2


def _draw_stations(axis: Any, data: Measurements, jumping: Sequence[int]) -> None:
    place, site = static_positions(data), data.site
    if not len(place):
        return
    noun = ENDS[site.still_end]
    label = f"the {noun}" if len(place) == 1 else f"{len(place)} stations ({noun}s)"
    draw_stations(axis, place, label, zorder=2)
    if jumping:
        draw_stations(axis, place[list(jumping)], "its level jumps", zorder=2, color="red")
    if site.stations is None or len(place) > NAMED:
        return
    names = site.stations.label or site.stations.name
    # All sectors of a mast in one text: one above the other the last alone would be read.
    masts, mast = np.unique(place.round(1), axis=0, return_inverse=True)
    for number, where in enumerate(masts):
        sectors = np.flatnonzero(mast.reshape(-1) == number).tolist()
        if np.isfinite(where).all():
            colour = "red" if set(sectors) & set(jumping) else "black"
            annotate(axis, ", ".join(names[t] for t in sectors), where, colour)


def _draw_suspicious(axis: Any, places: Spots, low: np.ndarray, high: np.ndarray) -> None:
    near, far = np.flatnonzero(places.suspicious & ~places.far), np.flatnonzero(places.far)
    if len(near):
        label = f"suspicious level ({len(near)} place{'s' * (len(near) > 1)})"
        axis.scatter(
            *places.place[near].T,
            label=label,
            zorder=3,
            s=90,
            facecolors="none",
            edgecolors="red",
            linewidths=1.5,
        )
    if len(far):
        # At the edge, 2 % inside: at its place it would shrink the site to a point.
        edge = np.clip(
            places.place[far],
            *(corner + s * 0.02 * (high - low) for corner, s in ((low, 1), (high, -1))),
        )
        axis.scatter(
            *edge.T,
            c="red",
            marker="x",
            s=60,
            zorder=3,
            label=f"far outside, at the edge ({len(far)})",
        )
        for row, where in zip(far[:MOST_MARKS], edge, strict=False):
            at = ", ".join(f"{v:.4g}" for v in places.place[row])
            annotate(axis, f"{places.rows[row]} at ({at})", where, "red")
    for row in near[:MOST_MARKS]:
        annotate(axis, places.rows[row], places.place[row], "red")


def _draw_level(
    axis: Any, levels: LinkLevels, station: int, steps: Sequence[LevelStep], unit: str
) -> None:
    """Levels of a station by row; those between two steps in one colour."""
    rows = np.flatnonzero(levels.station == station)
    level = levels.level_db[rows]
    number = np.arange(len(rows))
    edges = [0, *(int(np.searchsorted(rows, step.first)) for step in steps), len(rows)]
    for k, (start, stop) in enumerate(pairwise(edges)):
        axis.plot(number[start:stop], level[start:stop], ".", markersize=2.5, color=f"C{k}")
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.3 * (high - low))  # room for words
    for step in steps:
        last, first = (int(np.searchsorted(rows, row)) for row in (step.last, step.first))
        # At least one place wide, or a step between neighbours would not be seen.
        axis.axvspan(last, max(first, last + 1), facecolor="red", alpha=0.2)
        axis.axvline(first, color="red", linewidth=1.2)
        note = (
            f" {step.change_db:+.0f} dB from {levels.rows[step.last]} to {levels.rows[step.first]} "
        )
        annotate(axis, note.strip(), np.array([first, high]), "red")
    wild = [bad for t, bad, _ in find_outlier_rows(levels) if t == station]
    for row in np.concatenate([np.zeros(0, np.int64), *wild]):
        axis.plot(np.searchsorted(rows, row), levels.level_db[row], "o", mec="red", mfc="none")
    axis.set(
        title=f"{levels.names[station]}: steps that the places do not explain",
        xlabel="place, in the order of measuring",
        ylabel=f"level [{unit}]",
    )
