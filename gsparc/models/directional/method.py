"""`model=directional_gp`: sources triangulated from directions of arrival,
channels by one regression.

Rays of several receivers intersect at images of the transmitter, and the receivers with a ray to an
image are those that see it. With positions and visibility known a channel is linear in the sources'
gains: what this search proposes, and refines by phases of channels,
`SightedSources` conditions on the rows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.closed_form import LeftOutRows, Moments, from_containers, to_containers
from gsparc.models.directional.position_refine import PositionRefinement, UncertainPositions
from gsparc.models.directional.posterior import (
    CONSTANTS,
    LENGTHS_M,
    NOISES,
    GainKernel,
    SightedSources,
)
from gsparc.models.directional.triangulation import Rays, triangulate
from gsparc.models.directional.visibility import RayErrorRates, VisibilityGP, entries_to_flip
from gsparc.models.image_sources.frame import (
    SourceFrame,
    SourcePaths,
    SourcesInFrame,
    require_static_phase,
)
from gsparc.models.image_sources.rows import LEAST_ROWS, rows_of_measurements
from gsparc.models.image_sources.search import Found, SearchSettings
from gsparc.physics.waves import point_wave, wave_over_band
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

# Receivers with a ray to a source; of more than `SearchSettings.max_sources` those seen by most
MIN_SEEN = 2
MAX_RECEIVERS = 1000  # subsampled beyond: the cost of intersections grows with their square
REFINEMENT_ROWS = 400  # rows used for position refinement
REFINEMENT_KERNEL = GainKernel(CONSTANTS[1], LENGTHS_M[1], NOISES[1])  # meanwhile
# Rounds, each of which changes one entry per receiver at most
VISIBILITY_UPDATES, REFIT_EVERY = 9, 3


class DirectionalGP(SourcesInFrame):
    """Gaussian process on channels of a moving receiver with measured directions;
    queries need none.

    Args:
        rows: largest number of receivers times tones in the regression.
        seed: of the subsample.
        visibility: whether receivers see the sources that their rays point at; else every one sees
            all.
    """

    name = "directional_gp"
    posterior: SightedSources
    receivers = np.zeros(0, np.int64)  # (n,) rows that the sources were found by
    sighted: VisibilityGP  # at these

    def __init__(
        self, rows: int = SearchSettings.rows, seed: int = 0, visibility: bool = True
    ) -> None:
        if rows < LEAST_ROWS:
            raise ValueError(f"directional_gp: rows must be at least {LEAST_ROWS}, got {rows}")
        self.row_limit, self.seed, self.visibility = rows, seed, visibility

    # ---- the search ----
    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Learn from `train` and `val`.

        Raises:
            ValueError: no channels of a moving receiver, no directions, or rays that do not
                intersect.
        """
        started = Stopwatch()
        require_static_phase(data.site, self.name)
        if data.directions is None:
            raise ValueError("directional_gp: needs directions of arrival; this dataset has none")
        rows = fold.learned()
        if len(rows) > MAX_RECEIVERS:
            rows = np.sort(
                np.random.default_rng(self.seed).choice(rows, MAX_RECEIVERS, replace=False)
            )
        self.receivers = rows
        places = data.rx_position[rows].astype(np.float64)
        rays = Rays.from_receivers(
            places, [(data.directions[i] @ data.rx_rotation[i].T).astype(np.float64) for i in rows]
        )
        clusters = triangulate(rays, self.seed)
        seen = torch.from_numpy(clusters.seen_points(rays))
        sources = torch.nonzero(seen.sum(0) >= MIN_SEEN).flatten()
        if not len(sources):
            raise ValueError(
                "directional_gp: the directions of arrival do not intersect at any source"
            )
        order = seen[:, sources].sum(0).argsort(descending=True, stable=True)
        sources = sources[order[: SearchSettings.max_sources]]
        everything = rows_of_measurements(data, rows, self.row_limit, self.seed)
        self.frame = SourceFrame.from_rows(data.site, data.target.shape[1], everything)
        points, covariance = (
            torch.from_numpy(v)[sources] for v in (clusters.points, clusters.covariance)
        )
        at = {int(row): k for k, row in enumerate(rows)}
        seen = seen[:, sources] if self.visibility else torch.ones_like(seen[:, sources])
        self.posterior = SightedSources(
            self.frame.normalise(everything),
            torch.tensor([at[int(row)] for row in everything.receiver]),
            UncertainPositions(points - self.frame.middle, covariance),
            VisibilityGP.from_visibility(torch.from_numpy(places) - self.frame.middle, seen),
            torch.ones(len(sources)),
            REFINEMENT_KERNEL,
        )
        self.site = data.site
        self._refine_positions()
        self._refit_powers_and_kernel()
        changed = ""
        if self.visibility:
            pairs = self._update_visibility()
            changed = f"{pairs} pairs of receiver and source seen or hidden otherwise by channels; "
        self.sighted = self.posterior.precompute().visibility
        note = (
            f"directional_gp: {self.count_components()} sources where directions cross, "
            "direction error "
            f"{math.degrees(clusters.error):.2g} degrees; {changed}"
            f"{self.posterior.kernel.constant:.1%} of the gains' variance alike at all places"
        )
        return FitReport(started.seconds, (note,))

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Set the weights from rows (n,): sources, and who sees them, stay as they were found.

        Of receivers whose rays were not looked at they are sought anew.
        """
        order = np.argsort(self.receivers)
        if not np.isin(rows, self.receivers).all():
            return super().condition(data, rows)
        some = torch.from_numpy(order[np.searchsorted(self.receivers, rows, sorter=order)])
        thinned = rows_of_measurements(data, rows, self.row_limit, self.seed)
        number = np.argsort(rows)[np.searchsorted(np.sort(rows), thinned.receiver.numpy())]
        self.posterior = replace(
            self.posterior,
            rows=self._fitted_frame().normalise(thinned),
            observer=torch.from_numpy(number),
            visibility=VisibilityGP.from_visibility(
                self.sighted.places[some], self.sighted.seen[some]
            ),
        ).precompute()

    def _thin_posterior(self, limit: int) -> SightedSources:
        """Every so many-th row, at most `limit`."""
        whole = self.posterior
        some = torch.arange(0, len(whole.rows), max(1, -(-len(whole.rows) // limit)))
        return replace(whole, rows=whole.rows.select_rows(some), observer=whole.observer[some])

    def _refine_positions(self) -> None:
        """Refine positions by the phases of the channels, where directions leave them uncertain."""
        few = self._thin_posterior(REFINEMENT_ROWS)
        correlation = few.kernel.correlation(few.rows.position, few.rows.position)
        refined = PositionRefinement(few.rows, few.seen_by_rows, few.positions, correlation).run()
        self.posterior = replace(self.posterior, positions=refined)

    def _refit_powers_and_kernel(self) -> None:
        """Powers and kernel."""
        few = self._thin_posterior(SearchSettings.search_rows).fit_powers_and_kernel()
        self.posterior = replace(self.posterior, power=few.power, kernel=few.kernel)

    def _update_visibility(self) -> int:
        """Update visibility by the channels (see `entries_to_flip`);
        returns how many entries changed.

        Only with one row per receiver: more of them determine the gains of their own receiver.
        """
        rows, visibility = self.posterior.observer, self.posterior.visibility
        if len(rows.unique()) < len(rows):
            return 0
        rays, probability = visibility.seen.float(), visibility.left_out.float()
        rates = RayErrorRates.from_rays(rays)
        for turn in range(VISIBILITY_UPDATES):
            if turn % REFIT_EVERY == REFIT_EVERY - 1:
                self._refit_powers_and_kernel()
            now = self.posterior
            gains = (
                now.mean_gains(now.arrival_at_rows(probability))
                * now.unobstructed_waves[:, :, None]
            )
            seen, odds = visibility.seen.float(), rates.log_odds_seen(rays, probability)
            flip = entries_to_flip(seen[rows], odds[rows], *now.conditioned.left_out(), gains)
            if not bool(flip.any()):
                break
            seen[rows] = torch.where(flip, 1 - seen[rows], seen[rows])
            rates = RayErrorRates.from_visibility(rays, seen)
            visibility = replace(visibility, seen=seen.double())
            self.posterior = replace(now, visibility=visibility)
        changed = int((visibility.seen.float() != rays).sum())
        if changed:
            again = VisibilityGP.from_visibility(visibility.places, visibility.seen)
            self.posterior = replace(self.posterior, visibility=again)
            self._refit_powers_and_kernel()
        return changed

    def points_and_amplitudes(self) -> Found:
        """Return places [m], local, and amplitudes of the sources, to start a search from."""
        return (
            self.posterior.positions.points + self._fitted_frame().middle,
            self.posterior.power.sqrt(),
        )

    # ---- answers ----
    def _predict_normalised(self, places: Tensor, tones: Tensor, float64: bool) -> Moments:
        """See `SourcesInFrame`."""
        process = self.posterior.in_float64 if float64 else self.posterior
        at = process.arrival_at(places, torch.tensor(self.frame.carrier_hz))
        gains = at.probability[:, :, None] * process.mean_gains(at)
        mean = gains.mT @ wave_over_band(at.away, tones, process.power.dtype)
        return Moments(mean, *process.error_and_power(at, self.frame.carrier_hz))

    def _normalised_paths(self, places: Tensor) -> SourcePaths:
        """See `SourcesInFrame`."""
        at = self.posterior.arrival_at(places, torch.tensor(self.frame.carrier_hz))
        gain = at.probability * point_wave(at.away, self.frame.carrier_hz)
        gain = self.posterior.mean_gains(at) * gain[:, :, None]
        return SourcePaths(gain.mT, at.away, self.posterior.positions.points)

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """Return receivers, each predicted from all others; its own visibility is left out, too."""
        return self._fitted_frame().to_left_out_rows(
            self.posterior.rows, self.posterior.predict_left_out()
        )

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {"frame": self._fitted_frame().state(), "posterior": to_containers(self.posterior)}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.frame = site, SourceFrame(site, **state["frame"])
        self.posterior = from_containers(SightedSources, state["posterior"]).precompute()

    @property
    def terms(self) -> tuple[str, ...]:
        """`visibility` where some receiver does not see a source."""
        return ("phase",) if bool(self.posterior.visibility.seen.all()) else ("phase", "visibility")

    def count_components(self) -> int:
        """Return the number of sources."""
        return len(self.posterior.power) if self.site is not None else 0
