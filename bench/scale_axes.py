"""Seconds against what a site has many of besides rows: antennas, tones, stations, Gaussians, receivers.

One line each as `scale.py` writes it, with the amount in place of the rows.
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import processes
from scale import Private, aside, decibels, each, peak_gb, relative
from town import TESTED, hall, stations

from gsparc.data.own import load_own
from gsparc.data.splits import Fold
from gsparc.simulate.campaign import simulate
from gsparc.simulate.effects import Effects
from gsparc.simulate.scenes.build import SceneSettings
from gsparc.simulate.settings import Campaign

ROWS = 2_000  # of channels
PLACES = 400  # where every station is heard
STEPS, BATCH = 42, 16
ROOM = SceneSettings(
    name="box", num_receivers=20, transmitter_m=(1.0, 1.5, 2.6), area_m=((0.2, 0.2), (5.8, 4.8)),
    height_m=(1.1, 1.5), carrier_hz=2.4e9, bandwidth_hz=40e6, subcarriers=4,
    room={"size_m": [6, 5, 3], "reflection": -0.6},
)  # fmt: skip


def axes(axis: str, amounts: Sequence[int]) -> None:
    """Lines of an axis by its name.

    Raises:
        ValueError: another name.
    """
    lines = {
        "antennas": channels, "tones": channels, "stations": powers, "gaussians": gaussians,
        "receivers": receivers,
    }  # fmt: skip
    if axis not in lines:
        raise ValueError(f"axes {axis}: expected one of {', '.join(lines)}")
    for amount in amounts:
        lines[axis](axis, amount)


def channels(axis: str, amount: int) -> None:
    """Channels of so many antennas at 16 tones, or of 4 antennas at so many tones."""
    with tempfile.TemporaryDirectory() as folder:
        path, size = Path(folder) / "hall.h5", {"antennas": (amount, 16), "tones": (4, amount)}[axis]
        hall(path, ROWS, *size)
        data, rows = load_own(path), np.arange(ROWS + TESTED)
        each(
            axis,
            ("nearest", "complex_gp"),
            data,
            Fold(rows[:ROWS], rows[:0], rows[-TESTED::4]),
            relative,
            amount,
        )


def powers(axis: str, amount: int) -> None:
    """Powers of so many stations, learned together."""
    data = stations(amount, PLACES)
    assert data.place is not None
    tested = data.place >= PLACES - PLACES // 10
    watched = ~tested & (data.place % 10 == 0)
    fold = Fold(*(np.flatnonzero(chosen) for chosen in (~tested & ~watched, watched, tested)))
    each(axis, ("gp", "gsparc"), data, fold, decibels, amount)


def gaussians(axis: str, amount: int) -> None:
    """A training step of spectra by so many rendered Gaussians, in place of a fit."""
    with tempfile.TemporaryDirectory() as folder:
        work = processes.Work(processes.invented(), STEPS, BATCH, amount)
        wall, cpu = processes.seconds(work, processes.Shared(1, 1), Path(folder))
    write(axis, "step", amount, cpu, wall, np.nan)


def receivers(axis: str, amount: int) -> None:
    """A simulation in a box room, spectra of 90 x 360, in place of a fit."""

    def work() -> None:
        private, asked = Private(), Campaign(replace(ROOM, num_receivers=amount), Effects())
        cpu, wall = time.process_time(), time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            simulate(asked, Path(folder) / "box.h5")
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        write(axis, "simulate", amount, cpu, wall, private.most)

    aside(work)


def write(axis: str, name: str, amount: int, cpu: float, wall: float, private: float) -> None:
    """A line of what is no fit."""
    figures = (cpu, wall, np.nan, np.nan, np.nan, np.nan, peak_gb(), private, os.getloadavg()[0])
    csv.writer(sys.stdout).writerow((axis, name, name, amount, *(f"{v:.4g}" for v in figures)))
    sys.stdout.flush()
