"""Snapshots: all that was heard at one moment, of every station and antenna, as one row of values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Kind, Measurements, Site

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
    """
    site = data.site
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


def of_values(
    site: Site, values: np.ndarray | Tensor, silent: np.ndarray | Tensor | None = None
) -> Snapshots:
    """Snapshots at unknown places from what predictions of the site look like.

    Args:
        site: with T stations, or one static end.
        values: (n, ...), where there are stations (n, T, ...): spectra, channels or linear powers in physical
            units; NaN where a station is missing.
        silent: bool like powers (n, T) or (n, 1): True where nothing was heard, and the value is the level
            below which it was.

    Raises:
        ValueError: of another kind or shape than what the site was measured with, or nothing in it.
    """
    heard = torch.as_tensor(values)
    count, each = site.stations and len(site.stations), {"spectrum": 3, "csi": 3, "rssi": 2}[site.kind]
    ndim = each if count is None or site.kind == "rssi" else each + 1
    if (
        heard.is_complex() != (site.kind == "csi")
        or heard.ndim != ndim
        or (count and heard.shape[1] != count)
    ):
        stations = "" if count is None else f" of {count} stations"
        raise ValueError(f"locate: values {tuple(heard.shape)} {heard.dtype} are no {site.kind}{stations}")
    if silent is not None and (site.kind != "rssi" or np.shape(silent) != tuple(heard.shape)):
        raise ValueError(f"locate: silent {np.shape(silent)} is not like powers {tuple(heard.shape)}")
    if torch.isnan(heard.real).flatten(1).all(1).any():
        raise ValueError("locate: there is a snapshot in which nothing was heard")
    scaled = heard.to(torch.complex128 if heard.is_complex() else torch.float64) / site.target_scale
    flat = (scaled if count is None or site.kind == "rssi" else scaled.flatten(0, 1)).contiguous()
    own = (
        10 * flat.clamp_min(1e-30).log10() if site.kind == "rssi" else compared(flat).reshape(len(heard), -1)
    )
    floor = None
    if silent is not None:
        quiet = torch.as_tensor(silent)
        floor = torch.where(quiet, own, torch.full_like(own, np.nan))
        own = torch.where(quiet, torch.full_like(own, np.nan), own)
    nowhere = np.full((len(heard), 3), np.nan)
    return Snapshots(site.kind, own, floor, nowhere, np.arange(len(heard)))


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
