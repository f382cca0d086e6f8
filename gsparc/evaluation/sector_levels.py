"""Levels of a network's sectors over the angle from where they face, beside the learned patterns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.evaluation.drawing import PALETTE, panels, save
from gsparc.models.method import Method
from gsparc.models.per_station import PerStation
from gsparc.models.powers.together.field import JointPowerField
from gsparc.models.powers.together.terms import rows_of_stations
from gsparc.processes.sectors import NO_AZIMUTH, Sectors

MOST, ACROSS = 12, 4  # sectors drawn, those with most rows; beside each other
LEAST = 10  # rows that were heard of a sector


def draw_sector_levels(method: Method, data: Measurements, fold: Fold, path: Path) -> None:
    """Draw rows of sectors that were learned from, less the law of distance, where there are patterns."""
    every = method.all_stations() if isinstance(method, PerStation) else None
    field = None if every is None else every.joint_method()
    if not isinstance(field, JointPowerField) or field.network is None or data.site.stations is None:
        return
    trend = field.own.never.trend
    assert isinstance(trend, Sectors)
    heard = rows_of_stations(data, np.r_[fold.train, fold.val], field.places).measured_rows
    count = np.bincount(heard.station, minlength=len(field.places))
    # Without an azimuth there is no angle to draw over.
    count[trend.table[:, 0].numpy() == NO_AZIMUTH] = 0
    chosen = [int(t) for t in np.argsort(-count, kind="stable")[:MOST] if count[t] >= LEAST]
    if not chosen:
        return
    down = -(-len(chosen) // ACROSS)
    figure, axes = panels(9, 2.0 * down + 0.8, down, ACROSS, sharex=True, sharey=True)
    for axis, t in zip(axes.flat, chosen, strict=False):
        at = torch.from_numpy(np.c_[heard.select_station(t).places, np.full(count[t], t)])
        angle, distance = _about(at, float(trend.table[t, 0]))
        rest = torch.from_numpy(heard.select_station(t).decibels) - trend.mean(at) - trend.pattern_loss(at)
        axis.plot(angle, rest, ".", color=PALETTE[0], markersize=3, alpha=0.5)
        turn = np.linspace(-180, 180, 181)
        # Bearings from north, clockwise: east = sin, north = cos.
        bearing = np.radians(turn + float(trend.table[t, 0]))
        ring = np.median(distance) * np.c_[np.sin(bearing), np.cos(bearing)]
        height = np.full((len(ring), 1), float(at[:, 2].median()))
        around = np.c_[ring + field.places[t, :2], height, np.tile(np.r_[field.places[t], t], (len(ring), 1))]
        # A median: rows behind buildings are far below the pattern, and would lower a mean.
        gain = float((rest + trend.pattern_loss(at)).median())
        axis.plot(turn, gain - trend.pattern_loss(torch.from_numpy(around)), color=PALETTE[1])
        axis.set(title=f"{data.site.stations.shown[t]}, {float(trend.table[t, 0]):.0f} deg", xlim=(-180, 180))
        axis.set_xticks([-180, -90, 0, 90, 180])
    for axis in axes.flat[len(chosen) :]:
        axis.set_visible(False)
    figure.supxlabel("angle from the azimuth that is used [deg]")
    figure.supylabel("level less the law of distance [dB]")
    save(figure, path)


def _about(places: torch.Tensor, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n,) from an azimuth [deg] and flat distances (n,) [m] of places (n, 7)."""
    east, north = (places[:, :2] - places[:, 3:5]).numpy().T
    # Into [-180, 180): the back of the antenna stands at both ends.
    angle = (np.degrees(np.arctan2(east, north)) - azimuth + 180) % 360 - 180
    return angle, np.hypot(east, north)
