"""Misfits of snapshots at cells, and what is known of a place by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsparc.apps.locate import likelihood
from gsparc.apps.locate.cells import Cells
from gsparc.apps.locate.likelihood import Misfit, Trust
from gsparc.apps.locate.posterior import PlacePosterior
from gsparc.apps.locate.site_field import HeardMoments
from gsparc.apps.locate.snapshots import Scans
from gsparc.data.target import TARGETS


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
