"""Normalisation of positions and targets for fitting, and back."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.data.ends import Ends
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.models.abilities import QueryPaths
from gsparc.models.closed_form import ClosedForm, LeftOutRows, Moments
from gsparc.models.image_sources.rows import Rows, channel_places, static_array
from gsparc.models.method import Prediction
from gsparc.physics.waves import LIGHT
from gsparc.processes.places import first_end

SAME_ROTATION = 1e-3  # largest difference of the entries of rotations that are taken as equal


@dataclass(frozen=True)
class SourceFrame:
    """Offset and scale between local metres and stored units, and those of a fit.

    Attributes:
        site: that was measured.
        antennas: A, outputs of a measurement.
        middle: (3,) float64 [m], local; origin of the fit.
        scale: stored target = scale * normalised target.
        carrier_hz: amplitude goes with wavelength, so targets are multiplied by f / carrier first
            [Hz].
    """

    site: Site
    antennas: int
    middle: Tensor
    scale: float
    carrier_hz: float

    @staticmethod
    def from_rows(site: Site, antennas: int, rows: Rows) -> SourceFrame:
        """Return that in which these rows have zero mean position and unit power.

        Raises:
            ValueError: every channel is zero.
        """
        frequency = site.tones()
        carrier = float(frequency.mean()) if site.carrier_hz is None else float(site.carrier_hz)
        power = (rows.target * (rows.frequency / carrier)[:, None].float()).abs().square().mean()
        if not power > 0:
            raise ValueError(f"{site.name}: every training channel is zero, no source can be found")
        return SourceFrame(site, antennas, rows.position.mean(0), math.sqrt(float(power)), carrier)

    def normalise(self, rows: Rows) -> Rows:
        """Return rows in local metres and stored units, normalised."""
        flat = rows.target * (rows.frequency / self.carrier_hz)[:, None].float() / self.scale
        return replace(rows, position=rows.position - self.middle, target=flat)

    def places_and_count(self, query: Query) -> tuple[Tensor, int]:
        """Return antennas of the moving end (B E, 3) float64 in the frame, and B.

        With E antennas of the static end (B E, 6): see `Rows.places`.
        """
        ends = Ends.from_query(self.site, query)
        places = channel_places(self.site, self.antennas, ends.moving - self.middle, ends.turned)
        return places.flatten(0, 1), len(query)

    def to_left_out_rows(self, rows: Rows, predicted: Tensor) -> LeftOutRows:
        """Turn normalised predictions (n, R) of the rows back; of one channel per receiver."""
        scale = (self.carrier_hz / rows.frequency).float()[:, None] * self.scale
        # NaN: who needs a variance takes that of a prediction at the place.
        unknown = torch.full((len(predicted),), float("nan"))
        return LeftOutRows(rows.receiver.numpy(), (predicted * scale)[:, :, None], unknown)

    def state(self) -> dict[str, Any]:
        """Return what makes it again, of the same site."""
        return {name: value for name, value in vars(self).items() if name != "site"}


class SourcePaths(NamedTuple):
    """Paths from N sources to m places.

    Attributes:
        gain: (m, R, N) complex at the carrier, normalised.
        away: (m, N) [m], their lengths.
        sources: (N, 3) [m].
    """

    gain: Tensor
    away: Tensor
    sources: Tensor


class SourcesInFrame(ClosedForm):
    """Channels as sums of sources that a search proposes.

    Attributes:
        frame: of the fit.
        factors: (A,) complex64, what each antenna's channels were multiplied by before the fit;
            (1,) of all.
    """

    frame: SourceFrame
    factors = torch.ones(1, dtype=torch.complex64)

    @abstractmethod
    def _predict_normalised(self, places: Tensor, tones: Tensor, float64: bool) -> Moments:
        """Means (m, R, F) at places (m, 3 or 6) [m] and tones (F,) [Hz], variance and prior (m,);
        in float64?

        Normalised; the prior is the power that is expected without any rows.
        """

    @abstractmethod
    def _normalised_paths(self, places: Tensor) -> SourcePaths:
        """Gains (m, R, N) at the carrier, normalised, ranges (m, N) and sources (N, 3) [m]."""

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`.

        The variance is of gains, noise, visibility and between searches; the confidence is the
        explained share of the expected power.
        """
        frame = self._fitted_frame()
        places, count = frame.places_and_count(query)
        tones = torch.from_numpy(frame.site.tones())
        mean, variance, prior = self._predict_normalised(
            places, tones, query.tx.dtype == torch.float64
        )
        mean = mean * ((frame.carrier_hz / tones).float() * frame.scale)
        # Targets were multiplied by the antennas' factors before the fit.
        mean = mean.reshape(count, frame.antennas, len(tones)) / self.factors[:, None]
        # Without a query a size of -1 means nothing.
        each = len(places) // max(count, 1)
        variance, prior = (part.view(count, each).mean(1) for part in (variance, prior))
        return Prediction(mean, variance * frame.scale**2, (variance / prior).clamp(0, 1), mean)

    def paths(self, query: Query) -> QueryPaths:
        """Return the paths that `predict` sums, one per source,
        which several searches may have found.

        Returns:
            Gains (B, A, N) complex64 at the carrier, in stored units; delays (B, A, N) float64 [s];
            unit vectors (B, N, 3) float64 from the middle of the moving end's antennas to where a
            path comes from; the carrier [Hz].
        """
        frame = self._fitted_frame()
        places, count = frame.places_and_count(query)
        gain, away, sources = self._normalised_paths(places)
        gain = (gain * frame.scale).reshape(count, frame.antennas, -1) / self.factors[:, None]
        delay = (away / LIGHT).view(count, -1, away.shape[1]).expand(-1, frame.antennas, -1)
        ends = first_end(places)
        unit = normalize(sources - ends.reshape(count, -1, ends.shape[1]).mean(1)[:, None], dim=-1)
        return merge_equal_paths(QueryPaths(gain, delay, unit, frame.carrier_hz))

    def _fitted_frame(self) -> SourceFrame:
        return self.require_fitted(self.frame if self.site and self.count_components() else None)


def merge_equal_paths(paths: QueryPaths) -> QueryPaths:
    """Return paths whose sources are half a wavelength apart:
    gains of nearer ones add up in the first.
    """
    gain, delay, unit, carrier_hz = paths
    if not len(gain):
        return paths
    # A source is where the first query sees it: it stands still.
    places = unit[:1] * (LIGHT * delay[:1].mean(1))[..., None]
    first = (torch.cdist(places, places) < LIGHT / carrier_hz / 2).int().argmax(2).flatten()
    sources, number = first.unique(return_inverse=True)
    summed = gain.new_zeros(*gain.shape[:2], len(sources)).index_add_(2, number, gain)
    return QueryPaths(summed, delay[..., sources], unit[:, sources], carrier_hz)


def require_static_phase(site: Site, name: str) -> None:
    """Raise a `ValueError` in a method's name for data that sources
    with carrier phase cannot explain.
    """
    if not site.target.is_complex:
        raise ValueError(
            f"{name}: needs complex channels (csi), {site.name} has {site.kind}; take model=gp"
        )
    if site.static_position is None:
        raise ValueError(
            f"{name}: {site.name} lacks its static place: give it, or take model=complex_gp"
        )


def require_fixed_rotation(data: Measurements) -> None:
    """Raise a `ValueError` where a static receiver
    of several antennas turns between measurements.
    """
    antennas = data.target.shape[1]
    if static_array(data.site, antennas) is None:
        return
    turned = np.abs(data.rx_rotation - data.rx_rotation[:1]).max(axis=(1, 2)) > SAME_ROTATION
    if turned.any():
        row = int(np.flatnonzero(turned)[0])
        raise ValueError(
            f"{data.site.name}: row {row}: the static receiver of {antennas} antennas is turned "
            "otherwise "
            "than in row 0; give the rows of each rotation as a file of their own"
        )
