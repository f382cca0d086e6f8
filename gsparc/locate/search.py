"""From a coarse grid to fine cells where the likelihood has its mass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsparc.locate import likelihood
from gsparc.locate.cells import Cells
from gsparc.locate.likelihood import Misfit, Trust
from gsparc.locate.posterior import Posterior, likeliest
from gsparc.locate.site_field import Moments, SiteField
from gsparc.locate.snapshots import Snapshots

HALVED = 16  # cells that are halved at a time
KEPT = 0.9  # of the mass: cells beyond it stay as they are
LEVELS = 8  # halvings of a cell
ENOUGH = 32  # cells of one size that hold this mass need not be halved


@dataclass(frozen=True)
class Unknown:
    """What differs by chance between snapshots.

    Attributes:
        phase_known: whether channels come in the phase of the trained ones.
        offset_db: standard deviation of a device's offset [dB], of powers.
    """

    phase_known: bool = False
    offset_db: float = 0.0


@dataclass(frozen=True)
class Looked:
    """One snapshot's misfit at cells that were halved where it fits."""

    cells: Cells
    misfit: Misfit

    def by(self, trust: Trust) -> Posterior:
        """What is known of the place."""
        return Posterior(self.cells, _log_density(self.misfit, self.cells, trust), trust.spread)


def misfit(heard: Snapshots, there: Moments, unknown: Unknown) -> Misfit:
    """Of snapshots at places; see `gsparc.locate.likelihood`."""
    if heard.kind == "spectrum":
        return likelihood.of_spectra(heard.values, there.mean, there.variance)
    if heard.kind == "csi":
        return likelihood.of_channels(heard.values, there.mean, there.variance, unknown.phase_known)
    return likelihood.of_levels(heard.values, there.mean, there.variance, unknown.offset_db, heard.floor)


def looked(
    field: SiteField, heard: Snapshots, coarse: Cells, of_coarse: Misfit, unknown: Unknown, trust: Trust
) -> Looked:
    """Cells that are halved as long as few of them hold the mass.

    Args:
        field: asked about the middles of cells.
        heard: one snapshot.
        coarse: cells that cover where one can stand.
        of_coarse: its misfit at these.
        unknown, trust: see there.
    """
    cells, current = coarse, of_coarse
    for _ in range(LEVELS):
        likely = likeliest(_log_density(current, cells, trust), cells.size, KEPT)
        wide = cells.edge[likely].max(1)
        likely, wide = likely[wide > trust.spread], wide[wide > trust.spread]
        if not len(likely) or (len(likely) >= ENOUGH and wide.max() < 1.01 * wide.min()):
            break
        chosen = likely[wide >= 0.75 * wide[:HALVED].max()][:HALVED]
        finer = cells.at(chosen).halved()
        more = misfit(heard, field.at(torch.from_numpy(finer.centre)), unknown)
        rest = np.setdiff1d(np.arange(len(cells)), chosen)
        cells = cells.at(rest).with_others(finer)
        current = current.at(torch.from_numpy(rest)) + more
    return Looked(cells, current)


def _log_density(misfit: Misfit, cells: Cells, trust: Trust) -> np.ndarray:
    """(G,) of one snapshot, of total mass 1."""
    log_like, log_size = trust.log_likelihood(misfit)[0], torch.from_numpy(np.log(cells.size))
    return np.asarray(log_like - torch.logsumexp(log_like + log_size, 0))
