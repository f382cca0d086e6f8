"""`model=directional_gp`: sources triangulated from directions of arrival, channels by one regression.

Rays of several receivers intersect at images of the transmitter, and the receivers with a ray to an image are
those that see it. With positions and visibility known a channel is linear in the sources' gains:

    h(x, f) = sum_k m_k(x) g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,   m_k(x) in {0, 1}

with m known at the receivers. The gains are Gaussian processes as in `gp_likelihood.py`, nearly constant over
places; each source's power and the shared kernel maximise the marginal likelihood. At a query m_k is a
probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.directional.position_refine import PositionRefinement, UncertainPositions, coherence
from gsparc.models.directional.triangulation import Rays, triangulate
from gsparc.models.image_sources.frame import Frame, refuse
from gsparc.models.image_sources.gp_likelihood import with_noise
from gsparc.models.image_sources.rows import Rows, gather
from gsparc.models.image_sources.scene import steering
from gsparc.models.image_sources.visibility_gp import RayErrorRates, VisibilityGP, flips
from gsparc.models.in_double import in_double
from gsparc.models.method import Prediction
from gsparc.physics.waves import ranges, wave, wave_over_band
from gsparc.processes.kernel import apart, matern32_of_squares
from gsparc.processes.left_out import left_out_group
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import TimeBudget

# Receivers with a ray to a source; of more sources those seen by most are kept.
MIN_SEEN, MAX_SOURCES = 2, 60
MAX_RECEIVERS = 1000  # subsampled beyond: the cost of intersections grows with their square
CONSTANTS = (0.9, 0.97, 0.995)  # share of a gain's variance that is the same everywhere
LENGTHS_M = (0.5, 2.0)  # over which the rest of it varies
NOISES = (0.001, 0.01, 0.05)  # of the rows' power
ROUNDS = 4  # of expectation maximisation of powers, and choice of the kernel
REFINEMENT_ROWS = 400  # rows used for position refinement
VISIBILITY_UPDATES, REFIT_EVERY = 9, 3  # rounds, each of which changes one entry per receiver at most
SELECTION_ROWS = 700  # rows that the kernel is chosen on


@dataclass(frozen=True)
class GainKernel:
    """Covariance of gains over places.

    Attributes:
        constant: share of the variance that is the same everywhere.
        length: of the rest [m].
        noise: variance, in units of the rows' power.
    """

    constant: float
    length: float
    noise: float

    def correlation(self, first: Tensor, second: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(n, m) of places (n, 3) and (m, 3) float64 [m]."""
        squared = (apart(first, second) / self.length).square()
        return (self.constant + (1 - self.constant) * matern32_of_squares(squared)).to(dtype)


@dataclass(frozen=True)
class QueryGeometry:
    """Query places, `count` receivers times their antennas, and what depends on geometry alone.

    Attributes:
        places: (m, 3) float64 [m].
        count: of the receivers.
        away: (m, K) float64 [m], ranges to the sources.
        probability: (m, K), of seeing them.
        correlation: (m, n), of gains with the rows'.
        retained: (K', m, n), coherence retained under position uncertainty, of uncertain sources.
    """

    places: Tensor
    count: int
    away: Tensor
    probability: Tensor
    correlation: Tensor
    retained: Tensor


KERNELS = tuple(GainKernel(c, length, noise) for c in CONSTANTS for length in LENGTHS_M for noise in NOISES)
REFINEMENT_KERNEL = GainKernel(0.97, 2.0, 0.01)  # during position refinement


class DirectionalGP(ClosedForm):
    """Gaussian process on channels of a moving receiver with measured directions; queries need none.

    Args:
        rows: largest number of receivers times tones in the regression.
        seed: of the subsample.
    """

    name = "directional_gp"
    _doubled: DirectionalGP | None = None  # made when first asked in float64

    def __init__(self, rows: int = 3000, seed: int = 0) -> None:
        if rows < 8:
            raise ValueError(f"directional_gp: rows must be at least 8, got {rows}")
        self.row_limit, self.seed = rows, seed

    # ---- fitting ----
    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Learn from `train` and `val`.

        Raises:
            ValueError: no channels of a moving receiver, no directions, or rays that do not intersect.
        """
        started = TimeBudget()
        refuse(data.site, self.name)
        if data.directions is None:
            raise ValueError("directional_gp: needs directions of arrival; this dataset has none")
        known = np.concatenate([fold.train, fold.val])
        if len(known) > MAX_RECEIVERS:
            known = np.sort(np.random.default_rng(self.seed).choice(known, MAX_RECEIVERS, replace=False))
        places = data.rx_position[known].astype(np.float64)
        rays = [(data.directions[i] @ data.rx_rotation[i].T).astype(np.float64) for i in known]
        all_rays = Rays.of(places, rays)
        clusters = triangulate(all_rays, self.seed)
        seen = torch.from_numpy(clusters.seen(all_rays))
        sources = torch.nonzero(seen.sum(0) >= MIN_SEEN).flatten()
        if not len(sources):
            raise ValueError("directional_gp: the directions of arrival do not intersect at any source")
        sources = sources[seen[:, sources].sum(0).argsort(descending=True, stable=True)[:MAX_SOURCES]]
        self.site = data.site
        everything = gather(data, known, self.row_limit, self.seed)
        self.frame = Frame.of(data.site, data.target.shape[1], everything)
        points, covariance = (torch.from_numpy(v)[sources] for v in (clusters.points, clusters.covariance))
        self.positions = UncertainPositions(points - self.frame.middle, covariance)
        self.visibility = VisibilityGP.of(torch.from_numpy(places) - self.frame.middle, seen[:, sources])
        self.rows = self.frame.inside(everything)
        at = {int(row): k for k, row in enumerate(known)}
        self.observer = torch.tensor([at[int(row)] for row in everything.receiver])
        self._refine_positions()
        self._refit()
        changed = self._update_visibility()
        note = (
            f"directional_gp: {len(self.sources)} triangulated sources, direction error "
            f"{math.degrees(clusters.error):.2g} degrees; {changed} visibility entries changed by channels; "
            f"constant share of the gains' variance {self.kernel.constant:.1%}"
        )
        return FitReport(started.spent, (note,))

    @property
    def sources(self) -> Tensor:
        """Places (K, 3) float64 [m] in the regression's frame."""
        return self.positions.points

    def _few(self, limit: int) -> tuple[Tensor, Rows]:
        """Every so many-th row, at most `limit`: indices and rows."""
        some = torch.arange(0, len(self.rows), max(1, -(-len(self.rows) // limit)))
        return some, self.rows.take(some)

    def _refine_positions(self) -> None:
        """Refine positions by the phases of the channels, where directions leave them uncertain."""
        some, rows = self._few(REFINEMENT_ROWS)
        correlation = REFINEMENT_KERNEL.correlation(rows.position, rows.position)
        self.positions = PositionRefinement(
            rows, self.visibility.seen[self.observer[some]].float(), self.positions, correlation
        ).run()

    def _refit(self) -> None:
        """Powers by expectation maximisation and the kernel by likelihood on a grid, in turn."""
        some, rows = self._few(SELECTION_ROWS)
        waves, uncertain, _, retained = self._prior(rows, self.observer[some])
        mean_power = float(waves.abs().square().sum(1).mean())
        self.power = torch.full((len(self.sources),), 1 / max(mean_power, 1e-30))
        correlation = {kernel: kernel.correlation(rows.position, rows.position) for kernel in KERNELS}
        for _ in range(ROUNDS):
            covariance = _covariance(waves, waves, self.power, uncertain, retained)
            tried = {
                kernel: with_noise(covariance * each, kernel.noise, rows.target)
                for kernel, each in correlation.items()
            }
            self.kernel, conditioned = min(tried.items(), key=lambda one: one[1].nll)
            # E |g_k|^2 of the constant part, over outputs (Rasmussen and Williams, eq. 2.25 and 2.26)
            prior = self.power * self.kernel.constant
            mean = prior[:, None] * (waves.mH @ conditioned.weights)
            known = (conditioned.factor.root @ waves).abs().square().sum(0)
            self.power = (mean.abs().square().mean(1) + prior - prior.square() * known).clamp_min(1e-12)
        self._prepare()

    def _prepare(self) -> None:
        """Quantities derived from the state that queries need."""
        rows, self._doubled = self.rows, None
        self.waves, self.uncertain, self.phase_vectors, retained = self._prior(rows, self.observer)
        correlation = self.kernel.correlation(rows.position, rows.position)
        covariance = _covariance(self.waves, self.waves, self.power, self.uncertain, retained)
        self.conditioned = with_noise(covariance * correlation, self.kernel.noise, rows.target)

        # (n, K, R, 2), real and imaginary: what each row adds to each source's gain
        dual_weights = (self.power * self.waves.conj())[:, :, None] * self.conditioned.weights[:, None]
        self.dual_weights = torch.view_as_real(dual_weights).contiguous()

    def _update_visibility(self) -> int:
        """Update visibility by the channels (see `flips`); returns how many entries changed.

        Only with one row per receiver: more of them determine the gains of their own receiver.
        """
        if len(self.observer.unique()) < len(self.observer):
            return 0
        rays = self.visibility.seen.float()
        probability = self.visibility.left_out.float()
        rates, rows = RayErrorRates.first(rays), self.observer
        for turn in range(VISIBILITY_UPDATES):
            if turn % REFIT_EVERY == REFIT_EVERY - 1:
                self._refit()
            places = self.rows.position
            query = QueryGeometry(
                places,
                len(rows),
                ranges(places, self.sources),
                probability[rows],
                self.kernel.correlation(places, places),
                coherence(self.phase_vectors, self.phase_vectors),
            )
            one = self._gains(query) * steering(self.rows, self.sources)[:, :, None]
            seen, odds = self.visibility.seen.float(), rates.odds(rays, probability)
            flip = flips(seen[rows], odds[rows], *self.conditioned.left_out(), one)
            if not bool(flip.any()):
                break
            seen[rows] = torch.where(flip, 1 - seen[rows], seen[rows])
            rates = RayErrorRates.of(rays, seen)
            self.visibility = replace(self.visibility, seen=seen.double())
            self._prepare()
        changed = int((self.visibility.seen.float() != rays).sum())
        if changed:
            self.visibility = VisibilityGP.of(self.visibility.places, self.visibility.seen)
            self._refit()
        return changed

    def _prior(self, rows: Rows, observer: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Waves (n, K), zero where a receiver does not see a source; of uncertain sources (K',) the rest.

        These are `UncertainPositions.phase_vectors` (K', n, 3), and the `coherence` (K', n, n) of these.
        """
        waves = steering(rows, self.sources) * self.visibility.seen[observer].float()
        uncertain = self.positions.uncertain(rows.position, rows.frequency)
        turned = self.positions.only(uncertain).phase_vectors(rows.position, rows.frequency)
        return waves, uncertain, turned, coherence(turned, turned)

    # ---- predicting ----
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; the variance includes gains, noise and visibility."""
        answering = self._exact() if query.tx.dtype == torch.float64 else self
        seen = answering._query(query)
        return self.frame.prediction(answering._sum(seen), *answering._variance(seen))

    def _exact(self) -> DirectionalGP:
        """The same in float64."""
        if self._doubled is None:
            self._doubled = in_double(self)
        return self._doubled

    def _sum(self, query: QueryGeometry) -> Tensor:
        """Predicted mean channels (B, A, K) of a query's receivers."""
        tones = torch.from_numpy(self._fitted().site.tones())
        gains = query.probability[:, :, None] * self._gains(query)
        return self.frame.stored(gains.mT @ wave_over_band(query.away, tones, self.power.dtype), tones)

    def paths(self, query: Query) -> tuple[Tensor, Tensor, Tensor, float]:
        """The paths that `predict` sums, one per source: see `ImageSourceGP.paths`."""
        seen = self._query(query)
        gain = seen.probability * wave(seen.away, self.frame.carrier_hz)
        gain = self._gains(seen) * gain[:, :, None]
        towards = self.sources - seen.places.view(seen.count, -1, 3).mean(1)[:, None]
        return self.frame.paths(gain.movedim(1, -1), seen.away, towards)

    def _query(self, query: Query) -> QueryGeometry:
        """Query geometry of receivers, their antennas in the regression's frame."""
        flat, count = self._fitted().places(query)
        dtype = self.power.dtype
        retained = torch.zeros(0, len(flat), len(self.rows), dtype=dtype)
        if len(self.uncertain):
            several, carrier = self.positions.only(self.uncertain), torch.tensor(self.frame.carrier_hz)
            retained = coherence(several.phase_vectors(flat, carrier, dtype), self.phase_vectors)
        return QueryGeometry(
            flat,
            count,
            ranges(flat, self.sources),
            self.visibility.probability(flat).to(dtype),
            self.kernel.correlation(flat, self.rows.position, dtype),
            retained,
        )

    def _gains(self, query: QueryGeometry) -> Tensor:
        """Posterior mean gains (m, K, R) at a query's places."""
        weights = self.dual_weights
        gain = (query.correlation @ weights.flatten(1)).unflatten(1, weights.shape[1:])
        if len(self.uncertain):
            retained = query.retained * query.correlation
            gain[:, self.uncertain] = torch.einsum("kmn,nkrc->mkrc", retained, weights[:, self.uncertain])
        return torch.view_as_complex(gain)

    def _variance(self, query: QueryGeometry) -> tuple[Tensor, Tensor]:
        """Expected squared error and expected power (m,) at a query's places."""
        probability = query.probability
        arriving = wave(query.away, self.frame.carrier_hz, self.power.dtype)
        powers = arriving.abs().square() * self.power
        cross = _covariance(arriving * probability, self.waves, self.power, self.uncertain, query.retained)
        cross = cross * query.correlation
        gains = (powers * probability.square()).sum(1) - self.conditioned.known(cross)
        visibility_variance = (powers * probability * (1 - probability)).sum(1)
        power = (powers * probability).sum(1)
        return gains.clamp_min(0) + visibility_variance + self.kernel.noise, power + self.kernel.noise

    def left_out(self) -> LeftOutRows:
        """Receivers, each predicted from all others.

        A receiver's own visibility of the sources is left out, too.
        """
        self._fitted()
        probability = self.visibility.left_out[self.observer].float()
        expected = steering(self.rows, self.sources) * probability
        retained = coherence(self.phase_vectors, self.phase_vectors)
        cross = _covariance(expected, self.waves, self.power, self.uncertain, retained)
        cross = cross * self.kernel.correlation(self.rows.position, self.rows.position)
        predicted = self.conditioned.mean(cross)
        inverse = self.conditioned.factor.inverse
        for one in self.observer.unique():
            group = torch.nonzero(self.observer == one).flatten()
            own, _ = left_out_group(inverse, self.conditioned.weights, group)
            predicted[group] -= cross[group] @ (inverse[:, group] @ own)
        return self.frame.left_out(self.rows, predicted)

    # ---- state ----
    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {
            **self._fitted().state(self.rows),
            "observer": self.observer,
            "sources": self.sources,
            "open": self.positions.covariance,
            "power": self.power,
            "law": [*vars(self.kernel).values()],
            "sightings": [getattr(self.visibility, each.name) for each in fields(self.visibility)],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, (self.frame, self.rows) = site, Frame.read(site, state)
        self.observer, self.power, points = state["observer"], state["power"], state["sources"]
        self.positions = UncertainPositions(points, state["open"])
        self.kernel, self.visibility = GainKernel(*state["law"]), VisibilityGP(*state["sightings"])
        self._prepare()

    def _fitted(self) -> Frame:
        if self.site is None or not self.size():
            raise ValueError(f"{self.name}: not fitted yet; call fit or restore first")
        return self.frame

    @property
    def terms(self) -> tuple[str, ...]:
        """Of sources whose receivers are measured, too."""
        return ("phase", "visibility")

    def size(self) -> int:
        """Sources."""
        return len(self.sources) if self.site is not None else 0


def _covariance(first: Tensor, second: Tensor, power: Tensor, uncertain: Tensor, retained: Tensor) -> Tensor:
    """Covariance (m, n) of waves (m, K) and (n, K); (K',) uncertain sources have coherence (K', m, n)."""
    exact = power.index_fill(0, uncertain, 0.0) if len(uncertain) else power
    total = (first * exact) @ second.mH
    for k, coherent in zip(uncertain.tolist(), retained, strict=True):
        total += (power[k] * first[:, k])[:, None] * second[:, k].conj() * coherent
    return total
