"""`model=directed`: sources where measured directions of arrival meet; channels by one regression, no search.

Rays of several receivers meet at images of the transmitter, and who has a ray to which says who sees which.
With both known a channel is linear in the sources' gains:

    h(x, f) = sum_k m_k(x) g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,   m_k(x) in {0, 1}

with m known at the receivers. The gains are Gaussian processes as in `process.py`, nearly constant over
places; each source's power, and what all share, come by marginal likelihood. At a query m_k is a probability.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.method import FitContext, FitReport, LeftOut, Prediction, PredictsVariance
from gsparc.multipath.frame import Frame, frame_of, refuse
from gsparc.multipath.gp_likelihood import JITTER, Factor, steering
from gsparc.multipath.position_refine import Pinning
from gsparc.multipath.position_uncertainty import Open, coherence
from gsparc.multipath.rows import Rows, gather, query_elements
from gsparc.multipath.triangulation import Rays, meet
from gsparc.multipath.visibility_gp import Sightings
from gsparc.multipath.visibility_kernel import matern32
from gsparc.multipath.visibility_update import Rates, flips
from gsparc.ops import Pose
from gsparc.physics.waves import LIGHT, ranges, wave, wave_over_band

# Receivers whose rays meet in a source; of more sources the most seen are kept.
LEAST_SEEN, MOST_SOURCES = 2, 60
MOST_RECEIVERS = 1000  # of more some are drawn: intersections and sightings grow faster than what they tell
CONSTANTS = (0.9, 0.97, 0.995)  # share of a gain's variance that is the same everywhere
LENGTHS_M = (0.5, 2.0)  # over which the rest of it varies
NOISES = (0.001, 0.01, 0.05)  # of the rows' power
ROUNDS = 4  # of powers and shared numbers in turn
PINNED = 400  # rows that places are pinned by
REVOTES, RELEARNT = 9, 3  # rounds in which each channel changes one sighting at most
JUDGED = 700  # rows that the shared numbers are chosen on


@dataclass(frozen=True)
class Law:
    """How gains vary.

    Attributes:
        constant: share of the variance that is the same everywhere.
        length: of the rest [m].
        noise: variance, in units of the rows' power.
    """

    constant: float
    length: float
    noise: float

    def correlation(self, first: Tensor, second: Tensor) -> Tensor:
        """(n, m) float32 of places (n, 3) and (m, 3) float64 [m]."""
        squared = (torch.cdist(first, second) / self.length).square()
        return (self.constant + (1 - self.constant) * matern32(squared)).float()


@dataclass(frozen=True)
class Query:
    """Places that channels are asked for, `count` receivers of some antennas.

    Attributes:
        places: (m, 3) float64 [m].
        count: of the receivers.
        away: (m, K) float64 [m], ranges to the sources.
        likely: (m, K), probabilities to see them.
        alike: (m, n), the law's correlation with the rows.
        left: (K', m, n), what open places leave of it.
    """

    places: Tensor
    count: int
    away: Tensor
    likely: Tensor
    alike: Tensor
    left: Tensor


LAWS = tuple(Law(c, length, noise) for c in CONSTANTS for length in LENGTHS_M for noise in NOISES)


PINNING = Law(0.97, 2.0, 0.01)  # while places are pinned


class DirectedSources(PredictsVariance):
    """Channels of a moving receiver whose directions of arrival were measured; queries need none.

    Args:
        rows: receivers times tones that the regression holds.
        seed: of which, where there are more.
    """

    name = "directional_gp"

    def __init__(self, rows: int = 3000, seed: int = 0) -> None:
        if rows < 8:
            raise ValueError(f"directional_gp: rows must be at least 8, got {rows}")
        self.row_limit, self.seed = rows, seed
        self.site: Site | None = None

    # ---- learning ----
    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Learn from `train` and `val`.

        Raises:
            ValueError: no channels of a moving receiver, no directions, or they meet nowhere.
        """
        started = time.monotonic()
        refuse(data.site, self.name)
        if data.directions is None:
            raise ValueError("directional_gp: needs directions of arrival; this dataset has none")
        known = _some(np.concatenate([fold.train, fold.val]), self.seed)
        places = data.rx_position[known].astype(np.float64)
        rays = [(data.directions[i] @ data.rx_rotation[i].T).astype(np.float64) for i in known]
        found = Rays.of(places, rays)
        bundles = meet(found, self.seed)
        seen = torch.from_numpy(bundles.seen(found))
        often = torch.nonzero(seen.sum(0) >= LEAST_SEEN).flatten()
        if not len(often):
            raise ValueError("directional_gp: the directions of arrival meet nowhere")
        often = often[seen[:, often].sum(0).argsort(descending=True, stable=True)[:MOST_SOURCES]]
        self.site, self.antennas = data.site, data.target.shape[1]
        everything = gather(data, known, self.row_limit, self.seed)
        self.frame = frame_of(data.site, everything)
        points, covariance = (torch.from_numpy(v)[often] for v in (bundles.points, bundles.covariance))
        self.open = Open(points - self.frame.middle, covariance)
        self.sightings = Sightings.of(torch.from_numpy(places) - self.frame.middle, seen[:, often])
        self.rows = self.frame.inside(everything)
        at = {int(row): k for k, row in enumerate(known)}
        self.observer = torch.tensor([at[int(row)] for row in everything.receiver])
        self._pin()
        self._relearn()
        changed = self._revote()
        note = (
            f"directional_gp: {len(self.sources)} sources where rays meet, their directions' error "
            f"{math.degrees(bundles.error):.2g} degrees; "
            f"{changed} sightings by the channels; {self.law.constant:.1%} of a gain is the same everywhere"
        )
        return FitReport(time.monotonic() - started, (note,))

    @property
    def sources(self) -> Tensor:
        """Places (K, 3) float64 [m] in the regression's frame."""
        return self.open.points

    def _pin(self) -> None:
        """Places by the phases of the channels, where directions leave them open."""
        step = max(1, -(-len(self.rows) // PINNED))
        some = torch.arange(0, len(self.rows), step)
        rows = self.rows.take(some)
        alike = PINNING.correlation(rows.position, rows.position)
        self.open = Pinning(rows, self.sightings.seen[self.observer[some]].float(), self.open, alike).run()

    def _relearn(self) -> None:
        self._learn()
        self._prepare()

    def _learn(self) -> None:
        """Powers and the law of gains in turn: expectation maximisation, and likelihood on a grid."""
        step = max(1, -(-len(self.rows) // JUDGED))
        some = torch.arange(0, len(self.rows), step)
        rows, observer = self.rows.take(some), self.observer[some]
        waves, blurred = self._seen(rows, observer), self.open.blurred(rows.position, rows.frequency)
        loud = float(waves.abs().square().sum(1).mean())
        self.power = torch.full((len(self.sources),), 1 / max(loud, 1e-30))
        alike = {law: law.correlation(rows.position, rows.position) for law in LAWS}
        turns = self.open.only(blurred).turns(rows.position, rows.frequency)
        left = coherence(turns, turns)
        for _ in range(ROUNDS):
            shared = _shared(waves, waves, self.power, blurred, left)
            tried = [(_factor(shared * alike[law], rows, law), law) for law in LAWS]
            factor, self.law = min(tried, key=lambda one: one[0].nll)
            # E |g_k|^2 of the constant part, over outputs (Rasmussen and Williams, eq. 2.25 and 2.26)
            prior = self.power * self.law.constant
            mean = prior[:, None] * (waves.mH @ factor.alpha)
            known = (factor.root @ waves).abs().square().sum(0)
            self.power = (mean.abs().square().mean(1) + prior - prior.square() * known).clamp_min(1e-12)

    def _prepare(self) -> None:
        """What queries need beyond the state."""
        rows = self.rows
        self.waves = self._seen(rows, self.observer)
        self.blurred = self.open.blurred(rows.position, rows.frequency)
        self.turns = self.open.only(self.blurred).turns(rows.position, rows.frequency)
        alike = self.law.correlation(rows.position, rows.position)
        shared = _shared(self.waves, self.waves, self.power, self.blurred, coherence(self.turns, self.turns))
        self.factor = _factor(shared * alike, rows, self.law)

        # (n, K, R), real and imaginary: what each row adds to each source's gain
        pulled = (self.power * self.waves.conj())[:, :, None] * self.factor.alpha[:, None]
        self.pulled = [part.contiguous() for part in (pulled.real, pulled.imag)]

    def _revote(self) -> int:
        """Let channels vote on who sees what; returns how many sightings changed.

        Where each receiver has one row: more of them tell the gains of their own receiver.
        """
        if len(self.observer.unique()) < len(self.observer):
            return 0
        rays = self.sightings.seen.float()
        likely = self.sightings.left_out.float()
        rates, rows = Rates.first(rays), self.observer
        for turn in range(REVOTES):
            if turn % RELEARNT == RELEARNT - 1:
                self._relearn()
            places, known = self.rows.position, self.factor.inverse.diagonal().real
            query = Query(
                places,
                len(rows),
                ranges(places, self.sources),
                likely[rows],
                self.law.correlation(places, places),
                coherence(self.turns, self.turns),
            )
            one = self._gains(query) * steering(self.rows, self.sources)[:, :, None]
            seen, odds = self.sightings.seen.float(), rates.odds(rays, likely)
            left = self.factor.alpha / known[:, None]  # eq. 5.12
            flip = flips(seen[rows], odds[rows], left, 1 / known, one)
            if not bool(flip.any()):
                break
            seen[rows] = torch.where(flip, 1 - seen[rows], seen[rows])
            rates = Rates.of(rays, seen)
            self.sightings = replace(self.sightings, seen=seen.double())
            self._prepare()
        changed = int((self.sightings.seen.float() != rays).sum())
        if changed:
            self.sightings = Sightings.of(self.sightings.places, self.sightings.seen)
            self._relearn()
        return changed

    def _seen(self, rows: Rows, observer: Tensor) -> Tensor:
        """Waves (n, K) complex64 of the sources at every row, of those that its receiver sees."""
        return steering(rows, self.sources) * self.sightings.seen[observer].float()

    # ---- predicting ----
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the variance counts gains, noise and who is seen."""
        query = self._query(tx, rx)
        variance, prior = self._variance(query)
        variance, prior = (v.reshape(query.count, -1).mean(1) for v in (variance, prior))
        return Prediction(
            self._sum(query),
            confidence=(1 - variance / prior).clamp(0, 1),
            variance=variance * self.frame.scale**2,
        )

    def mean_at(self, tx: Tensor, rx: Pose) -> Tensor:
        """The mean alone (B, A, K) complex64."""
        return self._sum(self._query(tx, rx))

    def _sum(self, query: Query) -> Tensor:
        """Of the waves that a query's places receive, as channels of its receivers."""
        tones = torch.from_numpy(self._fitted().tones())
        gains = query.likely[:, :, None] * self._gains(query)
        mean = torch.einsum("mkr,mkf->mrf", gains, wave_over_band(query.away, tones))
        loudness = (self.frame.carrier_hz / tones).float()
        return (mean * (loudness * self.frame.scale)).reshape(query.count, self.antennas, len(tones))

    def paths(self, tx: Tensor, rx: Pose) -> tuple[Tensor, Tensor, Tensor, float]:
        """What `predict` sums, one path a source: see `VirtualSourceGP.paths`."""
        query = self._query(tx, rx)
        gain = query.likely * wave(query.away, self.frame.carrier_hz)
        gain = self._gains(query) * gain[:, :, None]
        gain = (gain * self.frame.scale).movedim(1, -1).reshape(query.count, self.antennas, -1)
        away = query.away.view(query.count, -1, len(self.sources))
        delay = (away / LIGHT).expand(-1, self.antennas, -1)
        towards = self.sources - query.places.view(query.count, -1, 3).mean(1)[:, None]
        towards = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
        return gain, delay, towards, self.frame.carrier_hz

    def _query(self, tx: Tensor, rx: Pose) -> Query:
        """What the regression needs to know of places, antennas of the receivers in its frame."""
        places = query_elements(self._fitted(), rx, len(tx), self.antennas)
        flat = torch.from_numpy(places.reshape(-1, 3).copy()) - self.frame.middle
        turns = self.open.only(self.blurred).turns(flat, torch.tensor(self.frame.carrier_hz))
        return Query(
            flat,
            len(places),
            ranges(flat, self.sources),
            self.sightings.likely(flat).float(),
            self.law.correlation(flat, self.rows.position),
            coherence(turns, self.turns),
        )

    def _gains(self, query: Query) -> Tensor:
        """Posterior mean gains (m, K, R) at a query's places."""
        parts = []
        for part in self.pulled:
            gain = (query.alike @ part.flatten(1)).unflatten(1, part.shape[1:])
            if len(self.blurred):
                left = query.left * query.alike
                gain[:, self.blurred] = torch.einsum("kmn,nkr->mkr", left, part[:, self.blurred])
            parts.append(gain)
        return torch.complex(*parts)

    def _variance(self, query: Query) -> tuple[Tensor, Tensor]:
        """Expected squared error and expected power (m,) of what a query's places receive."""
        likely, arriving = query.likely, wave(query.away, self.frame.carrier_hz)
        loud = arriving.abs().square() * self.power
        cross = _shared(arriving * likely, self.waves, self.power, self.blurred, query.left) * query.alike
        gains = (loud * likely.square()).sum(1) - (self.factor.root @ cross.mH).abs().square().sum(0)
        doubt = (loud * likely * (1 - likely)).sum(1)
        return gains.clamp_min(0) + doubt + self.law.noise, (loud * likely).sum(1) + self.law.noise

    def leave_one_out(self) -> LeftOut:
        """Residuals (n, R) of receivers (n,), each predicted from all others; see `LeaveOneOut`.

        A receiver's own visibility of the sources is left out, too.
        """
        self._fitted()
        likely = self.sightings.left_out[self.observer].float()
        expected = steering(self.rows, self.sources) * likely
        left = coherence(self.turns, self.turns)
        cross = _shared(expected, self.waves, self.power, self.blurred, left)
        cross = cross * self.law.correlation(self.rows.position, self.rows.position)
        said = cross @ self.factor.alpha
        for one in self.observer.unique():
            group = torch.nonzero(self.observer == one).flatten()
            own = torch.linalg.solve(self.factor.inverse[group[:, None], group], self.factor.alpha[group])
            said[group] -= cross[group] @ (self.factor.inverse[:, group] @ own)
        loud = (self.frame.carrier_hz / self.rows.frequency).float()[:, None] * self.frame.scale
        return LeftOut(self.rows.receiver.numpy(), (self.rows.target - said) * loud)

    # ---- keeping ----
    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        self._fitted()
        rows, seen = self.rows, self.sightings
        return {
            "antennas": self.antennas,
            "frame": [self.frame.middle, self.frame.scale, self.frame.carrier_hz],
            "rows": [rows.position, rows.frequency, rows.target, rows.receiver],
            "observer": self.observer,
            "sources": self.sources,
            "open": self.open.covariance,
            "power": self.power,
            "law": [self.law.constant, self.law.length, self.law.noise],
            "sightings": [seen.places, seen.seen, seen.length, seen.weights, seen.left_out],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.antennas = site, int(state["antennas"])
        self.frame, self.rows = Frame(*state["frame"]), Rows(*state["rows"])
        self.observer, self.power, points = state["observer"], state["power"], state["sources"]
        # checkpoints of before directions had errors have no covariances
        self.open = Open(points, state.get("open", torch.zeros(len(points), 3, 3, dtype=torch.float64)))
        self.law, self.sightings = Law(*state["law"]), Sightings(*state["sightings"])
        self._prepare()

    def size(self) -> int:
        """Sources."""
        return len(self.sources) if self.site is not None else 0

    def _fitted(self) -> Site:
        if self.site is None:
            raise ValueError("directional_gp: not fitted yet; call fit or restore first")
        return self.site


def _some(known: np.ndarray, seed: int) -> np.ndarray:
    """At most `MOST_RECEIVERS` of them."""
    if len(known) <= MOST_RECEIVERS:
        return known
    return np.sort(np.random.default_rng(seed).choice(known, MOST_RECEIVERS, replace=False))


def _factor(covariance: Tensor, rows: Rows, law: Law) -> Factor:
    """Of the covariance (n, n) of the rows' channels, with the law's noise."""
    loud = max(1.0, float(covariance.diagonal().real.mean()))
    covariance.diagonal().add_(law.noise + JITTER * loud)
    return Factor.of(covariance, rows.target)


def _shared(first: Tensor, second: Tensor, power: Tensor, blurred: Tensor, left: Tensor) -> Tensor:
    """Covariance (m, n) by sources seen as waves (m, K) and (n, K), of which (K',) keep `left` (K', m, n)."""
    loud = power.clone()
    loud[blurred] = 0
    total = (first * loud) @ second.mH
    for k, coherent in zip(blurred.tolist(), left, strict=True):
        total += (power[k] * first[:, k])[:, None] * second[:, k].conj() * coherent
    return total
