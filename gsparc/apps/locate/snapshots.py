"""Snapshots: all that was heard at one moment, of every station and antenna, as one row of values;
mean and variance of what a trained model expects to be heard.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.moments import number_moments
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.target import Kind
from gsparc.models.predicting import predict_with_threads
from gsparc.prediction.predictor import Predictor

# About as many of a spectrum are compared: an array's have far fewer degrees of freedom
PIXELS = 1_000


@dataclass(frozen=True)
class Scans:
    """What was heard at n places.

    Attributes:
        kind: of the values.
        values: (n, P) float64 spectra, or complex128 channels, or decibels; NaN where missing.
        floor: (n, P) levels [dB] of powers that were too weak to be heard, NaN of the rest; None
            without any.
        place: (n, 3) [m, local], where they were heard.
        row: (n,) what each one's first row in its file is called; None: not known.
    """

    kind: Kind
    values: Tensor
    floor: Tensor | None
    place: np.ndarray
    row: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.values)

    def subset(self, chosen: np.ndarray) -> Scans:
        """Return the snapshots `chosen`."""
        index = torch.from_numpy(np.asarray(chosen))
        floor = None if self.floor is None else self.floor[index]
        row = None if self.row is None else self.row[chosen]
        return Scans(self.kind, self.values[index], floor, self.place[chosen], row)


def group_snapshots(data: Measurements, rows: np.ndarray) -> Scans:
    """Return rows (m,) of measurements as snapshots:
    rows of one place at different stations are one.

    Of several visits of a station to a place the first is of the first snapshot there, and so on.
    """
    site = data.site
    rows = np.sort(np.asarray(rows))
    count = len(site.every_station)
    station = data.stations_of(rows)
    moment = np.arange(len(rows)) if count == 1 else number_moments(data, rows)
    _, first, which = np.unique(moment, return_index=True, return_inverse=True)
    measured = flatten_targets(data.targets(rows))
    measured = measured.to(torch.complex128) if measured.is_complex() else measured.double()
    measured = site.target.in_error_unit(measured)
    side = torch.from_numpy(data.censored_side(rows))
    if data.mask is not None:
        mask = flatten_targets(torch.from_numpy(data.mask[rows])) | (side != 0)[:, None]
        measured = torch.where(mask, measured, torch.full_like(measured, np.nan))
    values = torch.full((len(first), count, measured.shape[1]), np.nan, dtype=measured.dtype)
    values[which, station] = measured
    quiet = torch.zeros(values.shape, dtype=torch.bool)
    quiet[which, station] = (side > 0)[:, None]
    parts = _without_silence(values.flatten(1), quiet.flatten(1) if quiet.any() else None)
    names = np.array([name.partition(", station")[0] for name in data.row_names])
    return Scans(
        site.kind, *parts, data.moving[rows][first], names[rows][first] if len(names) else None
    )


def snapshots_of_values(
    site: Site, values: np.ndarray | Tensor, silent: np.ndarray | Tensor | None = None
) -> Scans:
    """Return snapshots at unknown places from what predictions of the site look like.

    Args:
        site: with T stations, or one static end.
        values: (n, ...), where there are stations (n, T, ...): spectra, channels or linear powers
            in physical units; NaN where a station is missing.
        silent: bool like powers (n, T) or (n, 1): True where nothing was heard, and the value is
            the level below which it was.

    Raises:
        ValueError: of another kind or shape than what the site was measured with, or nothing in it.
    """
    heard = torch.as_tensor(values)
    count, each = site.stations and len(site.stations), site.target.axes
    ndim = each if count is None or site.target.is_level else each + 1
    shaped = heard.ndim == ndim and (not count or heard.shape[1] == count)
    if heard.is_complex() != site.target.is_complex or not shaped:
        stations = "" if count is None else f" of {count} stations"
        raise ValueError(
            f"locate: values {tuple(heard.shape)} {heard.dtype} are no {site.kind}{stations}"
        )
    if silent is not None and (not site.target.is_level or np.shape(silent) != tuple(heard.shape)):
        raise ValueError(
            f"locate: silent {np.shape(silent)} is not like powers {tuple(heard.shape)}"
        )
    if torch.isnan(heard.real).flatten(1).all(1).any():
        raise ValueError("locate: there is a snapshot in which nothing was heard")
    scaled = heard.to(torch.complex128 if heard.is_complex() else torch.float64) / site.target_scale
    flat = scaled if scaled.ndim == site.target.axes else scaled.flatten(0, 1)
    rows = flatten_targets(site.target.in_error_unit(flat)).reshape(len(heard), -1)
    parts = _without_silence(rows, None if silent is None else torch.as_tensor(silent))
    return Scans(site.kind, *parts, np.full((len(heard), 3), np.nan))


def flatten_targets(targets: Tensor) -> Tensor:
    """Return targets (n, ...) as rows (n, P): of spectra every k-th row and column."""
    if targets.ndim == 3 and not targets.is_complex():
        step = max(round((targets[0].numel() / PIXELS) ** 0.5), 1)
        targets = targets[:, step // 2 :: step, step // 2 :: step]
    return targets.flatten(1)


def _without_silence(values: Tensor, silent: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Values (n, P), NaN where `silent`, and the levels there, NaN elsewhere; None:
    everything was heard.
    """
    if silent is None:
        return values, None
    gap = torch.full_like(values, np.nan)
    return torch.where(silent, gap, values), torch.where(silent, values, gap)


# Values that are asked for at a time: all stations of some places, which share their work
CHUNK = 1024


@dataclass(frozen=True)
class HeardMoments:
    """What would be heard at G places.

    Attributes:
        mean: (G, P) as in `Snapshots.values`; NaN where a station has no prediction.
        variance: (G, P) expected squared error of a measurement, of powers in dB^2; of spectra (G,
            1).
    """

    mean: Tensor
    variance: Tensor


class SiteField:
    """Answers for all stations of a site together.

    Args:
        predictor: whose predictions have variances.

    Raises:
        ValueError: both ends move.
    """

    def __init__(self, predictor: Predictor) -> None:
        self.predictor, self.site = predictor, predictor.site
        if self.site.paired:
            raise ValueError("locate: both ends move; one that stands still is needed")
        self.count = len(self.site.every_station)

    @torch.no_grad()
    def moments_at(self, places: Tensor) -> HeardMoments:
        """Return what would be heard at places (G, 3) float64 [m, local].

        Raises:
            ValueError: the model states no variance.
        """
        parts = [self._chunk(chunk) for chunk in places.split(max(CHUNK // self.count, 1))]
        return HeardMoments(
            torch.cat([p.mean for p in parts]), torch.cat([p.variance for p in parts])
        )

    def _chunk(self, places: Tensor) -> HeardMoments:
        site = self.site
        station = (
            torch.arange(self.count).repeat(len(places)) if site.stations is not None else None
        )
        query = Query.from_places(site, places.float().repeat_interleave(self.count, 0), station)
        prediction = predict_with_threads(self.predictor.method, query)
        if prediction.variance is None:
            raise ValueError(
                f"locate: {self.predictor.method.name} states no variance of what is heard"
            )
        mean, variance = flatten_targets(prediction.mean), prediction.variance.double()[:, None]
        if site.target.is_image:
            return HeardMoments(mean.double(), variance)
        mean, variance = site.target.moments_in_error_unit(mean, variance)
        number = torch.complex128 if site.target.is_complex else torch.float64
        return self._joined(mean.to(number), variance.expand(mean.shape))

    def _joined(self, mean: Tensor, variance: Tensor) -> HeardMoments:
        """Of rows by place and station (G T, p): (G, T p)."""
        return HeardMoments(
            *(part.reshape(-1, self.count * part.shape[1]) for part in (mean, variance))
        )
