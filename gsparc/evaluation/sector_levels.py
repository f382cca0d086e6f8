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
from gsparc.processes.sectors import NO_AZIMUTH

MOST, ACROSS = 12, 4  # sectors drawn, contradicted azimuths and then most rows first; beside each other
LEAST = 10  # rows that were heard of a sector, whose azimuth is not contradicted


def draw_sector_levels(method: Method, data: Measurements, fold: Fold, path: Path) -> None:
    """Draw rows of sectors that were learned from, less the law of distance, where there are patterns."""
    every = method.all_stations() if isinstance(method, PerStation) else None
    field = None if every is None else every.joint_method()
    if not isinstance(field, JointPowerField) or field.network is None or data.site.stations is None:
        return
    trend = field.network
    heard = rows_of_stations(data, np.r_[fold.train, fold.val], field.places).measured_rows
    count = np.bincount(heard.station, minlength=len(field.places))
    azimuth, stations = trend.table[:, 0].numpy(), data.site.stations
    # Without an azimuth there is no angle to draw over.
    count[azimuth == NO_AZIMUTH] = 0
    given = azimuth if stations.sector is None else stations.sector[:, 0] % 360
    turned = ~np.isclose(azimuth, given)  # as levels contradict what was given
    enough = count >= np.where(turned, 1, LEAST)
    chosen = [int(t) for t in np.lexsort((-count, ~turned)) if enough[t]][:MOST]
    if not chosen:
        return
    down = -(-len(chosen) // ACROSS)
    figure, axes = panels(9, 2.0 * down + 0.8, down, ACROSS, sharex=True, sharey=True)
    for axis, t in zip(axes.flat, chosen, strict=False):
        at = torch.from_numpy(np.c_[heard.select_station(t).places, np.full(count[t], t)])
        angle, distance = _about(at, azimuth[t])
        rest = torch.from_numpy(heard.select_station(t).decibels) - trend.mean(at) - trend.pattern_loss(at)
        axis.plot(angle, rest, ".", color=PALETTE[0], markersize=3, alpha=0.5)
        turn = np.linspace(-180, 180, 181)
        # Bearings from north, clockwise: east = sin, north = cos.
        bearing = np.radians(turn + azimuth[t])
        ring = np.median(distance) * np.c_[np.sin(bearing), np.cos(bearing)]
        height = np.full((len(ring), 1), float(at[:, 2].median()))
        around = np.c_[ring + field.places[t, :2], height, np.tile(np.r_[field.places[t], t], (len(ring), 1))]
        # A median: rows behind buildings are far below the pattern, and would lower a mean.
        gain = float((rest + trend.pattern_loss(at)).median())
        axis.plot(turn, gain - trend.pattern_loss(torch.from_numpy(around)), color=PALETTE[1])
        title = f"{stations.shown[t]}, {azimuth[t]:.0f} deg" + f" (given {given[t]:.0f})" * int(turned[t])
        axis.set(title=title, xlim=(-180, 180), xticks=range(-180, 181, 90))
    figure.suptitle(f"{len(chosen)} of {len(count)} sectors, contradicted azimuths first")
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
