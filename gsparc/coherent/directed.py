"""`model=directed`: sources where measured directions of arrival meet; channels by one regression, no search.

Rays of several receivers meet at images of the transmitter, and who has a ray to which says who sees which.
With both known a channel is linear in the sources' gains:

    h(x, f) = sum_k m_k(x) g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,   m_k(x) in {0, 1}

with m known at the receivers. The gains are Gaussian processes as in `process.py`, nearly constant over
places; each source's power, and what all share, come by marginal likelihood. At a query m_k is a probability.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.coherent.frame import Frame, frame_of, refuse
from gsparc.coherent.phase import LIGHT, ranges, wave, wave_over_band
from gsparc.coherent.process import JITTER, Factor, steering
from gsparc.coherent.rows import Rows, gather, query_elements, tones_of
from gsparc.coherent.sightings import Sightings
from gsparc.coherent.visibility import matern32
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.method import FitReport, Method, Prediction
from gsparc.ops import Pose
from gsparc.peers.directions import virtual_transmitters, votes

# Receivers whose rays meet in a source; of more sources the most seen are kept.
LEAST_SEEN, MOST_SOURCES = 2, 60
MOST_RECEIVERS = 1000  # of more some are drawn: intersections and sightings grow faster than what they tell
CONSTANTS = (0.9, 0.97, 0.995)  # share of a gain's variance that is the same everywhere
LENGTHS_M = (0.5, 2.0)  # over which the rest of it varies
NOISES = (0.001, 0.01, 0.05)  # of the rows' power
ROUNDS = 4  # of powers and shared numbers in turn
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


LAWS = tuple(Law(c, length, noise) for c in CONSTANTS for length in LENGTHS_M for noise in NOISES)


class DirectedSources(Method):
    """Channels of a moving receiver whose directions of arrival were measured; queries need none.

    Args:
        rows: receivers times tones that the regression holds.
        seed: of which, where there are more.
    """

    name = "directed"

    def __init__(self, rows: int = 3000, seed: int = 0) -> None:
        if rows < 8:
            raise ValueError(f"directed: rows must be at least 8, got {rows}")
        self.row_limit, self.seed = rows, seed
        self.site: Site | None = None

    # ---- learning ----
    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Learn from `train` and `val`.

        Raises:
            ValueError: no channels of a moving receiver, no directions, or they meet nowhere.
        """
        started = time.monotonic()
        refuse(data.site, self.name)
        if data.directions is None:
            raise ValueError("directed: needs directions of arrival; this dataset has none")
        known = _some(np.concatenate([fold.train, fold.val]), self.seed)
        places = data.rx_position[known].astype(np.float64)
        rays = [(data.directions[i] @ data.rx_rotation[i].T).astype(np.float64) for i in known]
        centres, met = virtual_transmitters(places, rays)
        seen = votes(places, met, len(centres)).double().clamp_max(1)
        often = torch.nonzero(seen.sum(0) >= LEAST_SEEN).flatten()
        if not len(often):
            raise ValueError("directed: the directions of arrival meet nowhere")
        often = often[seen[:, often].sum(0).argsort(descending=True, stable=True)[:MOST_SOURCES]]
        self.site, self.antennas = data.site, data.target.shape[1]
        everything = gather(data, known, self.row_limit, self.seed)
        self.frame = frame_of(data.site, everything)
        self.sources = torch.from_numpy(centres)[often] - self.frame.middle
        self.sightings = Sightings.of(torch.from_numpy(places) - self.frame.middle, seen[:, often])
        self.rows = self.frame.inside(everything)
        at = {int(row): k for k, row in enumerate(known)}
        self.observer = torch.tensor([at[int(row)] for row in everything.receiver])
        self._learn()
        self._prepare()
        note = (
            f"directed: {len(self.sources)} sources where rays meet; {self.law.constant:.1%} of a gain is "
            "the same everywhere"
        )
        return FitReport(time.monotonic() - started, (note,))

    def _learn(self) -> None:
        """Powers and the law of gains in turn: expectation maximisation, and likelihood on a grid."""
        step = max(1, -(-len(self.rows) // JUDGED))
        some = torch.arange(0, len(self.rows), step)
        rows, observer = self.rows.take(some), self.observer[some]
        waves = self._seen(rows, observer)
        loud = float(waves.abs().square().sum(1).mean())
        self.power = torch.full((len(self.sources),), 1 / max(loud, 1e-30))
        alike = {law: law.correlation(rows.position, rows.position) for law in LAWS}
        for _ in range(ROUNDS):
            shared = (waves * self.power) @ waves.mH
            tried = [(_factor(shared * alike[law], rows, law), law) for law in LAWS]
            factor, self.law = min(tried, key=lambda one: one[0].nll)
            # E |g_k|^2 of the constant part, over outputs (Rasmussen and Williams, eq. 2.25 and 2.26)
            prior = self.power * self.law.constant
            mean = prior[:, None] * (waves.mH @ factor.alpha)
            known = (factor.root @ waves).abs().square().sum(0)
            self.power = (mean.abs().square().mean(1) + prior - prior.square() * known).clamp_min(1e-12)

    def _prepare(self) -> None:
        """What queries need beyond the state."""
        self.waves = self._seen(self.rows, self.observer)
        alike = self.law.correlation(self.rows.position, self.rows.position)
        self.factor = _factor((self.waves * self.power) @ self.waves.mH * alike, self.rows, self.law)

        # (n, K R), real and imaginary: what each row adds to each source's gain
        pulled = (self.power * self.waves.conj())[:, :, None] * self.factor.alpha[:, None]
        self.pulled = [part.flatten(1).contiguous() for part in (pulled.real, pulled.imag)]

    def _seen(self, rows: Rows, observer: Tensor) -> Tensor:
        """Waves (n, K) complex64 of the sources at every row, of those that its receiver sees."""
        return steering(rows, self.sources) * self.sightings.seen[observer].float()

    # ---- predicting ----
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; the variance counts gains, noise and who is seen."""
        flat, count = self._places(tx, rx)
        likely = self.sightings.likely(flat).float()
        correlation = self.law.correlation(flat, self.rows.position)
        away = ranges(flat, self.sources)
        arriving = wave(away, self.frame.carrier_hz)
        variance, prior = self._variance(arriving, likely, correlation)
        variance, prior = (v.reshape(count, -1).mean(1) for v in (variance, prior))
        return Prediction(
            self._sum(likely, correlation, away, count),
            confidence=(1 - variance / prior).clamp(0, 1),
            variance=variance * self.frame.scale**2,
        )

    def mean_at(self, tx: Tensor, rx: Pose) -> Tensor:
        """The mean alone (B, A, K) complex64."""
        flat, count = self._places(tx, rx)
        likely = self.sightings.likely(flat).float()
        correlation = self.law.correlation(flat, self.rows.position)
        return self._sum(likely, correlation, ranges(flat, self.sources), count)

    def _sum(self, likely: Tensor, correlation: Tensor, away: Tensor, count: int) -> Tensor:
        """Of the waves that places (m, ...) receive, as channels of `count` receivers."""
        tones = torch.from_numpy(tones_of(self._fitted()))
        gains = likely[:, :, None] * self._gains(correlation)
        mean = torch.einsum("mkr,mkf->mrf", gains, wave_over_band(away, tones))
        loudness = (self.frame.carrier_hz / tones).float()
        return (mean * (loudness * self.frame.scale)).reshape(count, self.antennas, len(tones))

    def paths(self, tx: Tensor, rx: Pose) -> tuple[Tensor, Tensor, Tensor]:
        """What `predict` sums, one path a source: see `VirtualSourceGP.paths`."""
        flat, count = self._places(tx, rx)
        away = ranges(flat, self.sources)
        gain = self._gains(self.law.correlation(flat, self.rows.position))
        gain = gain * (self.sightings.likely(flat).float() * wave(away, self.frame.carrier_hz))[:, :, None]
        gain = (gain * self.frame.scale).movedim(1, -1).reshape(count, self.antennas, -1)
        delay = (away / LIGHT).view(count, -1, away.shape[1]).expand(-1, self.antennas, -1)
        towards = self.sources - flat.view(count, -1, 3).mean(1)[:, None]
        return gain, delay, towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True)

    def _places(self, tx: Tensor, rx: Pose) -> tuple[Tensor, int]:
        """Antennas of the receivers (B E, 3) float64 in the regression's frame, and B."""
        places = query_elements(self._fitted(), rx, len(tx), self.antennas)
        return torch.from_numpy(places.reshape(-1, 3).copy()) - self.frame.middle, len(places)

    def _gains(self, correlation: Tensor) -> Tensor:
        """Posterior mean gains (m, K, R) where the law's correlation with the rows is (m, n)."""
        real, imag = (correlation @ part for part in self.pulled)
        return torch.complex(real, imag).unflatten(1, (len(self.sources), -1))

    def _variance(self, arriving: Tensor, likely: Tensor, correlation: Tensor) -> tuple[Tensor, Tensor]:
        """Expected squared error and expected power (m,) of waves (m, K) seen with these probabilities."""
        loud, expected = arriving.abs().square() * self.power, arriving * likely
        cross = ((expected * self.power) @ self.waves.mH) * correlation
        gains = (loud * likely.square()).sum(1) - (self.factor.root @ cross.mH).abs().square().sum(0)
        doubt = (loud * likely * (1 - likely)).sum(1)
        return gains.clamp_min(0) + doubt + self.law.noise, (loud * likely).sum(1) + self.law.noise

    def left_over(self) -> tuple[np.ndarray, Tensor]:
        """Receivers (n,) and what all others leave unexplained of their channels (n, R), in stored units.

        Who sees what is left out, too.
        """
        self._fitted()
        likely = self.sightings.left_out[self.observer].float()
        expected = steering(self.rows, self.sources) * likely
        cross = (expected * self.power) @ self.waves.mH
        cross = cross * self.law.correlation(self.rows.position, self.rows.position)
        said = cross @ self.factor.alpha
        for one in self.observer.unique():
            group = torch.nonzero(self.observer == one).flatten()
            own = torch.linalg.solve(self.factor.inverse[group[:, None], group], self.factor.alpha[group])
            said[group] -= cross[group] @ (self.factor.inverse[:, group] @ own)
        loud = (self.frame.carrier_hz / self.rows.frequency).float()[:, None] * self.frame.scale
        return self.rows.receiver.numpy(), (self.rows.target - said) * loud

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
            "power": self.power,
            "law": [self.law.constant, self.law.length, self.law.noise],
            "sightings": [seen.places, seen.seen, seen.length, seen.weights, seen.left_out],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.antennas = site, int(state["antennas"])
        self.frame, self.rows = Frame(*state["frame"]), Rows(*state["rows"])
        self.observer, self.sources, self.power = state["observer"], state["sources"], state["power"]
        self.law, self.sightings = Law(*state["law"]), Sightings(*state["sightings"])
        self._prepare()

    def size(self) -> int:
        """Sources."""
        return len(self.sources) if self.site is not None else 0

    def _fitted(self) -> Site:
        if self.site is None:
            raise ValueError("directed: not fitted yet; call fit or restore first")
        return self.site


def _some(known: np.ndarray, seed: int) -> np.ndarray:
    """At most `MOST_RECEIVERS` of them."""
    if len(known) <= MOST_RECEIVERS:
        return known
    return np.sort(np.random.default_rng(seed).choice(known, MOST_RECEIVERS, replace=False))


def _factor(covariance: Tensor, rows: Rows, law: Law) -> Factor:
    """Of the covariance (n, n) of the rows' channels, with the law's noise."""
    covariance.diagonal().add_(law.noise + JITTER)
    return Factor.of(covariance, rows.target)
