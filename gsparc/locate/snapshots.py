"""Snapshots: all that was heard at one moment, of every station and antenna, as one row of values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Kind, Measurements

PIXELS = 1_000  # about as many of a spectrum are compared: an array's have far fewer degrees of freedom


@dataclass(frozen=True)
class Snapshots:
    """What was heard at n places.

    Attributes:
        kind: of the values.
        values: (n, P) float64 spectra, or complex128 channels, or decibels; NaN where missing.
        floor: (n, P) levels [dB] of powers that were too weak to be heard, NaN of the rest; None without any.
        place: (n, 3) [m, local], where they were heard.
        rows: (n,) first row of the measurements of each.
    """

    kind: Kind
    values: Tensor
    floor: Tensor | None
    place: np.ndarray
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.values)

    def at(self, chosen: np.ndarray) -> Snapshots:
        """The snapshots `chosen`."""
        index = torch.from_numpy(np.asarray(chosen))
        floor = None if self.floor is None else self.floor[index]
        return Snapshots(self.kind, self.values[index], floor, self.place[chosen], self.rows[chosen])


def snapshots(data: Measurements, rows: np.ndarray) -> Snapshots:
    """Rows (m,) of measurements as snapshots: rows of one place at different stations are one.

    Of several visits of a station to a place the first is of the first snapshot there, and so on.

    Raises:
        ValueError: both ends move.
    """
    site = data.site
    if site.static_end is None:
        raise ValueError("locate: both ends move; one that stands still is needed")
    rows = np.sort(np.asarray(rows))
    station = np.zeros(len(rows), np.int64) if data.station is None else data.station[rows]
    count = 1 if site.stations is None else len(site.stations)
    number, visit = _groups(rows if data.place is None or count == 1 else data.place[rows], station)
    keys, first, which = np.unique(np.c_[number, visit], axis=0, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    silent = None if data.censored is None else data.censored[rows]
    flat = compared(data.targets(rows))
    own = flat.to(torch.complex128) if flat.is_complex() else flat.double()
    if site.kind == "rssi":
        own = 10 * own.clamp_min(1e-30).log10()
    if data.mask is not None:
        mask = compared(torch.from_numpy(data.mask[rows]))
        mask = mask if silent is None else mask | torch.from_numpy(silent)[:, None]
        own = torch.where(mask, own, torch.full_like(own, np.nan))
    each = own.shape[1]
    values = torch.full((len(keys), count, each), np.nan, dtype=own.dtype)
    values[which, station] = own
    floor = None
    if silent is not None and silent.any():
        floor = torch.full_like(values, np.nan)
        quiet = torch.from_numpy(silent)
        floor[which[silent], station[silent]] = own[quiet]
        values[which[silent], station[silent]] = np.nan
        floor = floor.flatten(1)
    return Snapshots(site.kind, values.flatten(1), floor, data.moving[rows][first], rows[first])


def compared(targets: Tensor) -> Tensor:
    """Targets (n, ...) as rows (n, P): of spectra every k-th row and column."""
    if targets.ndim == 3 and not targets.is_complex():
        step = max(round((targets[0].numel() / PIXELS) ** 0.5), 1)
        targets = targets[:, step // 2 :: step, step // 2 :: step]
    return targets.flatten(1)


def _groups(place: np.ndarray, station: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (m,) of places, and which visit of its station to its place each row is."""
    order = np.lexsort((np.arange(len(place)), station, place))
    key = np.c_[place, station][order]
    fresh = np.r_[True, (key[1:] != key[:-1]).any(1)] if len(key) else np.zeros(0, bool)
    begin = np.maximum.accumulate(np.where(fresh, np.arange(len(key)), 0))
    visit = np.empty(len(place), np.int64)
    visit[order] = np.arange(len(key)) - begin
    return place, visit
