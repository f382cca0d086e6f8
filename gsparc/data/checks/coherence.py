"""Whether channels of neighbouring rows share phase, delay and level, or each packet has its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gsparc.data.moments import Snapshots
from gsparc.data.schema import Measurements
from gsparc.physics.row_factors import Freedom, turning

NEAR = 0.125  # wavelengths between rows whose channels are nearly alike
PAIRS = 400
FEWEST = 12  # pairs that tell
PER_ROW = 4  # neighbours of a row that are looked at
APART, ALIKE = 0.4, 0.8  # correlation of neighbours: below, their phases differ; above, their shapes do not
MORE = 0.1  # of correlation that a free delay must bring
SCATTER_DB = 2.0  # of levels between neighbours of one shape, more than fading within an eighth wavelength


@dataclass(frozen=True)
class Coherence:
    """What neighbouring rows have in common; correlations are 1 where nothing differs.

    Attributes:
        pairs: of neighbours that were compared.
        distance: between them, the median [m].
        as_measured: size of the mean correlation, with the phases as they are.
        phase, delay: mean correlation after a free phase, and after a delay too, of each pair.
        level_db: scatter of levels between neighbours [dB].
        freedom: what each row must be allowed.
    """

    pairs: int
    distance: float
    as_measured: float
    phase: float
    delay: float
    level_db: float
    freedom: Freedom

    def __str__(self) -> str:
        return (
            f"rows {self.distance * 1e3:.3g} mm apart correlate by {self.as_measured:.2f} as measured, by "
            f"{self.phase:.2f} after a free phase, {self.delay:.2f} after a free delay too; their levels "
            f"scatter by {self.level_db:.1f} dB ({self.pairs} pairs)"
        )


def coherence(data: Measurements) -> Coherence | None:
    """The verdict on channels; None where no rows are near enough to tell, or there is one entry a row.

    Rows are compared within a run, and all antennas or stations of a moment as one. Nothing is drawn.
    """
    site = data.site
    if site.kind != "csi" or site.wavelength is None or data.uplink is not None:
        return None
    rows = Snapshots.of(data, np.arange(len(data)))
    if rows.values[0].size < 2:
        return None
    one, two, distance = _pairs(rows, NEAR * site.wavelength)
    if len(one) < FEWEST:
        return None
    a, b = rows.values[one], rows.values[two] * (rows.values[one] != 0)
    a = a * (b != 0)
    size = np.sqrt((np.abs(a) ** 2).sum((1, 2)) * (np.abs(b) ** 2).sum((1, 2)))
    told = size > 0
    a, b, size, distance = a[told], b[told], size[told], distance[told]
    if len(a) < FEWEST:
        return None
    own = (a * b.conj()).sum((1, 2)) / size
    delayed = a * turning(a, b, rows.tones, "phase+delay")[:, None]
    after = (delayed * b.conj()).sum((1, 2)).real / size
    levels = 10 * np.log10((np.abs(a) ** 2).sum((1, 2)) / (np.abs(b) ** 2).sum((1, 2)))
    scatter = float(1.4826 * np.median(np.abs(levels))) / np.sqrt(2)
    measured, phase, delay = abs(own.mean()), float(np.abs(own).mean()), float(after.mean())
    freedom: Freedom = "none"
    if measured < APART and max(phase, delay) > ALIKE:
        slopes = delay > phase + MORE
        freedom = "phase+delay" if slopes else "phase"
        if scatter > SCATTER_DB:
            freedom = "phase+delay+gain"
    return Coherence(
        len(a), float(np.median(distance)), float(measured), phase, delay, scatter, freedom
    )


def _pairs(rows: Snapshots, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Neighbours of one run within `reach` [m]: numbers (P,) of both, and distances (P,) [m], near ones first."""
    near, index = cKDTree(rows.places).query(rows.places, k=min(PER_ROW + 1, len(rows.places)))
    near, index = near.reshape(len(rows.places), -1), index.reshape(len(rows.places), -1)
    one = np.repeat(np.arange(len(index)), index.shape[1])
    two, distance = index.ravel(), near.ravel()
    good = (one < two) & (distance <= reach) & (rows.run[one] == rows.run[two % len(rows.run)])
    one, two, distance = one[good], two[good], distance[good]
    chosen = np.unique(np.linspace(0, len(one) - 1, PAIRS).astype(int)) if len(one) else one
    return one[chosen], two[chosen], distance[chosen]
