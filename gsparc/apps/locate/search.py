"""Misfits of snapshots at cells, what is known of a place by them, and how far they are trusted:
from snapshots that the field did not learn from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize

from gsparc.apps.locate import likelihood
from gsparc.apps.locate.likelihood import Misfit, Trust
from gsparc.apps.locate.posterior import Cells, PlacePosterior
from gsparc.apps.locate.snapshots import HeardMoments, Scans
from gsparc.data.target import TARGETS
from gsparc.processes.uncertainty import conformal_quantile


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


def compute_misfit(heard: Scans, there: HeardMoments, unknown: Nuisances) -> Misfit:
    """Return the misfit of snapshots at places; see `gsparc.apps.locate.likelihood`."""
    facts = TARGETS[heard.kind]
    if facts.is_image:
        return likelihood.spectrum_misfit(heard.values, there.mean, there.variance)
    if facts.is_complex:
        return likelihood.channel_misfit(
            heard.values, there.mean, there.variance, unknown.phase_known
        )
    return likelihood.level_misfit(
        heard.values, there.mean, there.variance, unknown.offset_db, heard.floor
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
