"""Misfits of snapshots at cells, what is known of a place by them, and how far they are trusted:
from snapshots that the field did not learn from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.apps.locate.posterior import Cells, PlacePosterior
from gsparc.apps.locate.snapshots import HeardMoments, Scans
from gsparc.data.target import TARGETS
from gsparc.processes.uncertainty import conformal_quantile

TINY = 1e-30


@dataclass(frozen=True)
class Misfit:
    """Of n snapshots at G places.

    Attributes:
        squared: (n, G) sum of squared errors, each by its variance.
        size: (n, G) sum of logarithms of variances.
        count: (n,) real numbers that were compared.
        silent: (n, G) log probability that what was not heard is not heard; 0 where all was.
    """

    squared: Tensor
    size: Tensor
    count: Tensor
    silent: Tensor

    def __add__(self, other: Misfit) -> Misfit:
        """At the places of both, of the same snapshots."""
        pairs = (self.squared, other.squared), (self.size, other.size), (self.silent, other.silent)
        squared, size, silent = (torch.cat(pair, 1) for pair in pairs)
        return Misfit(squared, size, self.count, silent)

    def subset(self, places: np.ndarray) -> Misfit:
        """Return the misfit at places (g,) by number."""
        return Misfit(
            self.squared[:, places], self.size[:, places], self.count, self.silent[:, places]
        )


@dataclass(frozen=True)
class Trust:
    """How far a field's own variances are trusted.

    Errors of nearby pixels, tones and stations are not independent, which the temperature answers
    for, and some snapshots are worse than all others (somebody stood in the way), which the tail
    does: variances of a snapshot are known up to a factor of a scaled inverse chi-square
    distribution, so that its likelihood is that of a multivariate t (K. L. Lange et al., "Robust
    statistical modeling using the t distribution", JASA 84 (1989)).

    Attributes:
        inflation: of variances.
        temperature: share of the values in (0, 1] that count as independent.
        tail: degrees of freedom.
        spread: standard deviation of recorded places about the likelihood's along each axis [m].
        level: mass of the area that holds the promised share of places.
        worst: largest misfit at the likeliest place of any snapshot that was left out (see
            `Search.misfit`).
    """

    inflation: float = 1.0
    temperature: float = 0.1
    tail: float = 4.0
    spread: float = 0.0
    level: float = 0.9
    worst: float = math.inf

    def log_likelihood(self, misfit: Misfit) -> Tensor:
        """Return log likelihoods (n, G), up to a constant of each snapshot."""
        squared = self.temperature / self.inflation * misfit.squared
        count = self.temperature * misfit.count[:, None]
        # log1p: for small misfits the logarithm of 1 + x loses the digits of x.
        spread = (self.tail + count) * torch.log1p(squared / self.tail)
        return -0.5 * (spread + self.temperature * misfit.size) + self.temperature * misfit.silent


def spectrum_misfit(values: Tensor, mean: Tensor, variance: Tensor) -> Misfit:
    """Return the misfit of spectra (n, P) by means (G, P) and variances of a pixel (G, 1)."""
    spread = variance[:, 0].clamp_min(TINY)
    # |v - m|^2 as |v|^2 - 2 v m + |m|^2: one matrix product instead of an array (n, G, P).
    squared = values.square().sum(1)[:, None] - 2 * values @ mean.T + mean.square().sum(1)
    size = (values.shape[1] * spread.log()).expand(squared.shape)
    count = torch.full((len(values),), float(values.shape[1]), dtype=values.dtype)
    # Where both are alike the difference of squares may round below 0.
    return Misfit(squared.clamp_min(0) / spread, size, count, torch.zeros_like(squared))


def channel_misfit(values: Tensor, mean: Tensor, variance: Tensor, phase_known: bool) -> Misfit:
    """Return the misfit of complex values (n, P), NaN where missing, by means and variances (G, P).

    Without a known phase each snapshot is turned to where it fits best.
    """
    heard, seen = _where(values)
    mean, precision, log_variance = _moments(mean, variance)
    power = heard.abs().square() @ precision.T + seen @ (mean.abs().square() * precision).T
    overlap = heard @ (mean.conj() * precision).T
    # The best phase turns the overlap onto the real axis: its size is what is left of it.
    gain = overlap.real if phase_known else overlap.abs()
    # Twice: real and imaginary part each have half of a complex variance.
    squared = 2 * (power - 2 * gain).clamp_min(0)
    return Misfit(squared, 2 * seen @ log_variance.T, 2 * seen.sum(1), torch.zeros_like(squared))


def level_misfit(
    values: Tensor,
    mean: Tensor,
    variance: Tensor,
    offset_db: float = 0.0,
    floor: Tensor | None = None,
) -> Misfit:
    """Return the misfit of powers (n, P) [dB], NaN where missing, by means, variances (G, P) [dB,
    dB^2].

    Args:
        values: what was heard.
        mean, variance: of the places; NaN where a station has no prediction.
        offset_db: standard deviation of an offset that all powers of a snapshot share [dB]; it is
            integrated out in closed form.
        floor: (n, P) levels [dB] below which a silent power lies, NaN of those that were heard.
    """
    heard, seen = _where(values)
    means, precision, log_variance = _moments(mean, variance)
    weighed = means * precision
    square = heard.square() @ precision.T - 2 * heard @ weighed.T + seen @ (means * weighed).T
    slope = heard @ precision.T - seen @ weighed.T
    # Sherman and Morrison: (D + o^2 1 1^T)^-1 takes one rank out;
    # its determinant is |D| times this.
    shared = 1 + offset_db**2 * (seen @ precision.T)
    squared = (square - offset_db**2 * slope.square() / shared).clamp_min(0)
    size = seen @ log_variance.T + shared.log()
    silent = torch.zeros_like(squared)
    if floor is not None and not torch.isnan(floor).all():
        # log_ndtr, not the logarithm of ndtr, which is -inf from 38 deviations on.
        chance = torch.special.log_ndtr((floor[:, None] - mean) / (variance + offset_db**2).sqrt())
        silent = chance.nansum(2)  # of what is silent, and has a prediction
    return Misfit(squared, size, seen.sum(1), silent)


def _where(values: Tensor) -> tuple[Tensor, Tensor]:
    """Values with 0 where they are missing, and 1 where they are not."""
    there = ~torch.isnan(values.real)
    seen = there.to(values.real.dtype)
    return torch.where(there, values, torch.zeros_like(values)), seen


def _moments(mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means, inverse variances and logarithms of variances (G, P),
    all 0 where nothing is predicted.
    """
    is_predicted = ~torch.isnan(mean.real)
    safe = torch.where(is_predicted, variance.clamp_min(TINY), torch.ones_like(variance))
    precision = torch.where(is_predicted, 1 / safe, torch.zeros_like(safe))
    return torch.where(is_predicted, mean, torch.zeros_like(mean)), precision, safe.log()


@dataclass(frozen=True)
class Nuisances:
    """What differs by chance between snapshots.

    Attributes:
        phase_known: whether channels come in the phase of the trained ones.
        offset_db: standard deviation of a device's offset [dB], of powers.
    """

    phase_known: bool = False
    offset_db: float = 0.0


@dataclass(frozen=True)
class PlaceSearch:
    """One snapshot's misfit at cells that were halved where it fits."""

    cells: Cells
    misfit: Misfit

    def log_density(self, trust: Trust) -> np.ndarray:
        """Return log densities (G,) of total mass 1."""
        log_like, log_size = (
            trust.log_likelihood(self.misfit)[0],
            torch.from_numpy(np.log(self.cells.volume)),
        )
        return np.asarray(log_like - torch.logsumexp(log_like + log_size, 0))

    def least_misfit(self, trust: Trust) -> float:
        """Return the squared error by the variance, a mean over the values,
        at the likeliest cell.
        """
        return float(
            self.misfit.squared[0, self.log_density(trust).argmax()] / self.misfit.count[0]
        )

    def posterior(self, trust: Trust) -> PlacePosterior:
        """Return what is known of the place."""
        return PlacePosterior(self.cells, self.log_density(trust), trust.spread)


def compute_misfit(heard: Scans, moments: HeardMoments, unknown: Nuisances) -> Misfit:
    """Return the misfit of snapshots at places."""
    facts = TARGETS[heard.kind]
    if facts.is_image:
        return spectrum_misfit(heard.values, moments.mean, moments.variance)
    if facts.is_complex:
        return channel_misfit(heard.values, moments.mean, moments.variance, unknown.phase_known)
    if not facts.is_level:
        raise ValueError(f"{facts.called} are not located")
    return level_misfit(
        heard.values, moments.mean, moments.variance, unknown.offset_db, heard.floor
    )


# Bounds of the search, within which `decode_trust` clips the simplex.
TEMPERATURES, TAILS, INFLATIONS = (1e-4, 1.0), (0.5, 100.0), (0.05, 50.0)
SPREADS, SPREAD = (1e-3, 1.0), 0.2  # of the edge of a coarse cell
LOOKS = 100  # trials


def calibrate_trust(snapshots: Sequence[PlaceSearch], places: np.ndarray, start: Trust) -> Trust:
    """Return the trust under which held-out places are most likely:
    of the highest mean log density there.

    Args:
        snapshots: with their likelihoods over cells.
        places: (n, 3), where they were heard [m, local].
        start: of the search.
    """
    edge = float(np.max([snapshot.cells.edge.max() for snapshot in snapshots]))
    spans = np.log([INFLATIONS, TEMPERATURES, TAILS, SPREADS]).T

    # In logarithms: all are positive and known up to factors.
    def decode_trust(point: np.ndarray) -> Trust:
        inflation, temperature, tail, spread = np.exp(np.clip(point, *spans)).tolist()
        return Trust(inflation, temperature, tail, edge * spread)

    def surprise(point: np.ndarray) -> float:
        trust, pairs = decode_trust(point), zip(snapshots, places, strict=True)
        return -float(
            np.mean([pair.posterior(trust).log_density_at(place) for pair, place in pairs])
        )

    first = np.log([start.inflation, start.temperature, start.tail, start.spread / edge or SPREAD])
    # First steps, in logarithms: 1 is a factor of 2.7; the temperature is first tried lower.
    simplex = first + np.vstack([np.zeros(4), np.diag([1.0, -1.5, 1.0, 1.0])])
    how = {"maxfev": LOOKS, "initial_simplex": simplex}
    return decode_trust(minimize(surprise, first, method="Nelder-Mead", options=how).x)


def calibrate_level(
    trust: Trust, snapshots: Sequence[PlaceSearch], places: np.ndarray, share: float
) -> Trust:
    """Return the trust with the level whose areas hold a share of places (n, 3) [m],
    and the worst misfit.

    The level is the conformal quantile of masses down to the truth: whatever the model's errors,
    areas of that level hold the share of places that are exchangeable with these.
    """
    levels = [
        snapshot.posterior(trust).mass_above(place)
        for snapshot, place in zip(snapshots, places, strict=True)
    ]
    # Too few snapshots for this share: nothing less than the whole site is sure to hold it.
    level = min(conformal_quantile(levels, share), 1.0)
    return replace(
        trust,
        level=level,
        worst=max(snapshot.least_misfit(trust) for snapshot in snapshots),
    )
