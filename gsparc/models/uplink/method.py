"""`model=uplink`: plane-wave sources estimated in each uplink snapshot,
extrapolated to the downlink.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.method import Prediction
from gsparc.models.relative_error import RelativeErrorRegression
from gsparc.models.uplink.error_model import SearchedSnapshots, estimate_noise
from gsparc.models.uplink.interface import UplinkMethod, mean_power
from gsparc.models.uplink.search import SearchSettings, Sources, SourceSearch
from gsparc.physics.plane_waves import Aperture, mean_delay, phasor, planar_places
from gsparc.physics.waves import LIGHT
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

CHUNK = 32  # snapshots searched together
LEAKAGES = (1e-4, 3e-4, 1e-3)
# Of the downlink, one antenna each, added to the error model's training set
PIECES, PIECE_TONES = 4, 5


class UplinkField(UplinkMethod):
    """Plane-wave sources, estimated in every snapshot.

    Directions and delays are the same in both halves of a band; only their interference differs.
    Training snapshots set the hardware's leakage and the error model.

    Args:
        search: source search.
        teachers: largest number of training snapshots of the error model.
        shrink: shrink predictions towards zero by the expected error.
        seed: of the subsample of training snapshots; None: that of the run.
    """

    name = "uplink"

    def __init__(
        self,
        search: SearchSettings = SearchSettings(),
        teachers: int = 1200,
        shrink: bool = True,
        seed: int | None = None,
    ) -> None:
        if teachers < 50:
            raise ValueError(f"uplink: teachers={teachers}: expected at least 50 snapshots")
        self.settings, self.teachers = search, teachers
        self.shrink, self.seed = shrink, seed
        self.error_model: RelativeErrorRegression | None = None

    # ---- fitting ----
    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose the leakage on validation rows, fit the error model on training rows."""
        started = Stopwatch()
        self.site = self._require_uplink(data)
        self.error_model = None
        rng = np.random.default_rng(context.seed if self.seed is None else self.seed)
        few = rng.permutation(fold.val if len(fold.val) else fold.train)[:100]
        errors = {}
        for leakage in LEAKAGES:
            self._set_search(self.site, replace(self.settings, leakage=leakage))
            errors[leakage] = float(np.median(self._features_and_errors(data, few, rng, 0)[1]))
        best = min(errors, key=lambda leakage: errors[leakage])
        self._set_search(self.site, replace(self.settings, leakage=best))
        # The search is not fitted to training rows: their errors are unbiased.
        rows = rng.permutation(fold.train)[: self.teachers]
        pairs = self._features_and_errors(data, rows, rng, PIECES)
        self.error_model = RelativeErrorRegression.from_rows(*pairs)
        note = f"uplink: leakage {best:g} chosen on {len(few)} validation snapshots"
        return FitReport(started.seconds, (note,))

    @torch.no_grad()
    def _features_and_errors(
        self, data: Measurements, rows: np.ndarray, rng: np.random.Generator, pieces: int
    ) -> tuple[Tensor, Tensor]:
        """Features (n, S) and errors (n,), of the mean's power, of training snapshots,
        whole and in pieces.

        Pieces are one antenna and a few tones: narrow grids of one antenna fade deeper than the
        whole downlink.
        """
        features, error = [], []
        whole = self._downlink
        antennas, tones = len(whole.places), len(whole.tones)
        for start in range(0, len(rows), CHUNK):
            batch = data.batch(rows[start : start + CHUNK])
            assert batch.uplink is not None
            result = self._search_snapshots(batch.uplink, batch.noise_variance)
            views = [(slice(None), slice(None))]
            for _ in range(pieces if tones > PIECE_TONES else 0):
                antenna, first = (
                    int(rng.integers(antennas)),
                    int(rng.integers(tones - PIECE_TONES + 1)),
                )
                views.append((slice(antenna, antenna + 1), slice(first, first + PIECE_TONES)))
            everything = result.sources.channels(whole)
            for some, band in views:
                aperture = Aperture(whole.places[some], whole.tones[band])
                mean, true = everything[:, some, band], batch.target[:, some, band]
                error.append(mean_power(mean - true) / mean_power(mean))
                features.append(result.features(mean, aperture))
        return torch.cat(features), torch.cat(error)

    # ---- predicting ----
    def find_sources(self, uplink: Tensor, noise: Tensor | None = None) -> Sources:
        """Return the sources of snapshots (B, U, L): directions, delays, gains."""
        return self._search_snapshots(uplink, noise).sources

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; of the uplink alone."""
        return self._predict_at(self.query_uplinks(query), query.noise_variance, self._downlink)

    def predict_from_uplink(
        self,
        uplink: Tensor,
        frequency_hz: Tensor,
        noise: Tensor | None = None,
        antennas: slice = slice(None),
    ) -> Prediction:
        """Return the same at absolute frequencies (K,) [Hz] of one's own,
        and on some of the antennas.
        """
        tones = ((frequency_hz.double() - self._middle_hz) / self._spacing_hz).float()
        return self._predict_at(uplink, noise, Aperture(self._downlink.places[antennas], tones))

    def _predict_at(self, uplink: Tensor, noise: Tensor | None, aperture: Aperture) -> Prediction:
        assert self.error_model is not None
        with torch.inference_mode():  # a fifth less overhead in a single query
            result = self._search_snapshots(uplink, noise)
            mean = result.sources.channels(aperture)
            error = self.error_model.expected_error(result.features(mean, aperture))
            # Before shrinking: what was not found is not in the mean,
            # and shrinking does not take it away.
            variance = error * mean_power(mean)
            if self.shrink:
                mean = mean / (1 + error)[:, None, None]
        # Ordinary tensors again
        mean, error, variance = (part.clone() for part in (mean, error, variance))
        return Prediction(mean, variance, error / (1 + error))

    def _search_snapshots(self, uplink: Tensor, noise: Tensor | None) -> SearchedSnapshots:
        aperture = self.search.aperture
        if noise is None:
            noise = estimate_noise(uplink, aperture, self.settings.delay_window)
        # Timing differs between snapshots: search delays about their mean, then add it back.
        mean = mean_delay(uplink)
        straight = uplink * phasor(mean[:, None] * aperture.tones)[:, None]
        chunks = zip(straight.split(CHUNK), noise.split(CHUNK), strict=True)
        searched, residuals = zip(*(self.search(*chunk) for chunk in chunks), strict=True)
        sources = Sources(
            *map(torch.cat, zip(*(vars(part).values() for part in searched), strict=True))
        )
        return SearchedSnapshots(
            replace(sources, delay=sources.delay + mean[:, None]),
            torch.cat(residuals),
            uplink,
            noise,
        )

    def _set_search(self, site: Site, settings: SearchSettings) -> None:
        assert (
            site.uplink_hz is not None
            and site.uplink_array is not None
            and site.antennas is not None
        )
        assert site.subcarriers_hz is not None and site.carrier_hz is not None
        self._middle_hz = float(site.uplink_hz.mean())
        self._spacing_hz = float(np.diff(np.sort(site.uplink_hz)).min())
        places = planar_places(site.uplink_array, LIGHT / site.carrier_hz)

        def relative_tones(frequency: np.ndarray) -> Tensor:
            return torch.from_numpy((frequency - self._middle_hz) / self._spacing_hz).float()

        self.search = SourceSearch(Aperture(places, relative_tones(site.uplink_hz)), settings)
        chosen = torch.from_numpy(np.asarray(site.antennas))
        self._downlink = Aperture(places[chosen], relative_tones(site.subcarriers_hz))

    # ---- state ----
    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        error_model = None if self.error_model is None else self.error_model.state()
        return {"search": asdict(self.search.settings), "error_model": error_model}

    def restore(self, site: Site, state: Mapping[str, Any]) -> None:
        """See `Method.restore`."""
        self.site = site
        self._set_search(site, SearchSettings(**state["search"]))
        error_state = state["error_model"]
        self.error_model = (
            None if error_state is None else RelativeErrorRegression.read(error_state)
        )

    def count_components(self) -> int:
        """Return the number of sources of a snapshot."""
        return self.settings.rounds * self.settings.picks
