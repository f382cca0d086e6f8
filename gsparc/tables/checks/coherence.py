"""Whether channels of neighbouring rows share phase, delay and level,
or each packet has its own.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.limits import SettingError, choice
from gsparc.data.blocks import rows_by
from gsparc.data.moments import Snapshots
from gsparc.data.schema import Measurements
from gsparc.data.spacing import neighbour_distance
from gsparc.physics.decibels import to_decibels
from gsparc.physics.row_factors import (
    UNKNOWN_FACTORS,
    UnknownFactor,
    align_factors,
    describe_factor,
    resolvable_delays,
)
from gsparc.processes.few_rows import evenly_spaced

log = logging.getLogger(__name__)

# Wavelengths between rows of nearly one channel, and of a steady phase advance
NEAR, IN_LINE = 0.125, 0.5
MOST_ENTRIES = 4_000_000  # of channels from the first row on, which tell of all
MOST = 400  # pairs or triples that are looked at
FEWEST = 12
AROUND = 6  # neighbours of a row that are looked at
STRAIGHT, EVEN = -0.9, 0.7  # cosine at the middle row of three, and ratio of its distances
# Share of the correlation that rows with phases of their own keep at most
OWN = {NEAR: 0.7, IN_LINE: 0.45}
ALIKE = {NEAR: (0.5, 0.8), IN_LINE: (0.6, 0.8)}  # correlation of neighbours of one shape, at least
CHANCE = 2.0  # times the correlation of noise, within these limits
# Standard error of such a scatter of independent pairs, times the root of their number
SPREAD = 1.17
MORE = 0.1  # of correlation that a free delay must bring
SCATTER_DB = {NEAR: 2.0, IN_LINE: 3.2}  # of levels between neighbours, more than fading makes


@dataclass(frozen=True)
class Coherence:
    """What neighbouring rows have in common; correlations are 1 where nothing differs.

    Attributes:
        pairs: of neighbours that were compared.
        distance: between them, the median [m].
        as_measured: size of the mean correlation with phases as they are; where rows are further
            apart than an eighth wavelength, of the advance of the phase between three rows in line.
        phase, delay: mean correlation after a free phase, and after a delay too, of each pair.
        level_db: scatter of levels between neighbours [dB].
        unknown_factor: what each row must be allowed.
    """

    pairs: int
    distance: float
    as_measured: float
    phase: float
    delay: float
    level_db: float
    unknown_factor: UnknownFactor

    def __str__(self) -> str:
        tag = (
            ""
            if self.unknown_factor == "none"
            else f"every row has {describe_factor(self.unknown_factor)} of its own: "
        )
        return (
            f"{tag}rows {self.distance * 1e3:.3g} mm apart correlate by {self.as_measured:.2f} "
            "as measured, "
            f"by {self.phase:.2f} after a free phase, {self.delay:.2f} after a free delay too; "
            "their levels "
            f"scatter by {self.level_db:.1f} dB ({self.pairs} pairs)"
        )


def estimate_coherence(data: Measurements) -> Coherence | None:
    """Judge the phases of channels; None where no rows are near enough,
    or there is one entry a row.

    Rows are compared within a run, and all antennas or stations of a moment as one.
    Nothing is drawn.
    """
    site = data.site
    if not site.target.is_complex or site.wavelength is None or data.uplink is not None:
        return None
    few = max(MOST_ENTRIES // (len(site.every_station) * data.target[0].size), 1)
    rows = Snapshots.from_rows(data, np.arange(min(len(data), few)))
    if rows.values[0].size < 2:
        return None
    power = np.sqrt((np.abs(rows.values) ** 2).mean((0, 2), keepdims=True))
    values, reach = rows.values / np.maximum(power, np.finfo(float).tiny), NEAR
    near = _neighbours(rows, NEAR * site.wavelength, pairs=True)
    if len(near) < FEWEST:
        reach, near = IN_LINE, _neighbours(rows, IN_LINE * site.wavelength, pairs=False)
    if len(near) < FEWEST:
        return None
    a, b = values[near[:, 0]], values[near[:, 1]]
    first, size = _correlation(a, b)
    measured = abs(first.mean())
    if reach == IN_LINE:  # in the next step the phase advances as in this one
        second, _ = _correlation(values[near[:, 2]], a)
        measured = np.sqrt(abs((first * second.conj()).mean()))
    turned = a * align_factors(a, b, rows.tones, "phase+delay")[:, None]
    phase, delay = float(np.abs(first).mean()), float(np.abs(_correlation(turned, b)[0]).mean())
    levels = to_decibels(size[:, 0] / size[:, 1])
    scatter = float(1.4826 * np.median(np.abs(levels))) / np.sqrt(2)
    unknown_factor: UnknownFactor = "none"
    noise = np.sqrt(max(np.log(max(len(resolvable_delays(rows.tones)), 3)), 1.0) / values[0].size)
    if measured < OWN[reach] * phase and max(phase, delay) > np.clip(CHANCE * noise, *ALIKE[reach]):
        unknown_factor = "phase+delay" if delay > phase + MORE else "phase"
        # Few pairs that fade scatter by chance
        least = scatter * (1 - 2 * SPREAD / np.sqrt(len(near)))
        unknown_factor = "phase+delay+gain" if least > SCATTER_DB[reach] else unknown_factor
    distances = np.linalg.norm(rows.places[near[:, 0]] - rows.places[near[:, 1]], axis=1)
    return Coherence(
        len(near),
        float(np.median(distances)),
        float(measured),
        phase,
        delay,
        scatter,
        unknown_factor,
    )


def set_unknown_factor(data: Measurements, align: str) -> Measurements:
    """Return measurements with what is free of each row: as `align` says,
    `auto` by `estimate_coherence`.

    Raises:
        SettingError: no such factor, or one of what are no channels.
    """
    choice("auto", *UNKNOWN_FACTORS).check("dataset.align", align)
    if not data.site.target.is_complex:
        if align not in ("auto", "none"):
            raise SettingError(
                f"dataset.align={align}: is for channels, these are {data.site.kind}"
            )
        return data
    unknown_factor: UnknownFactor = align  # type: ignore[assignment]
    if align == "auto":
        coherence = estimate_coherence(data)
        if coherence is None or coherence.unknown_factor == "none":
            return data
        unknown_factor = coherence.unknown_factor
        log.warning("%s; they are aligned (dataset.align=none keeps them as they are)", coherence)
        if (
            spacing := neighbour_distance(data.moving) / (data.site.wavelength or np.inf)
        ) > IN_LINE:
            reason = "neighbours tell levels, not the shape over subcarriers"
            log.warning("places are %.3g wavelengths apart: %s", spacing, reason)
    return replace(data, site=replace(data.site, unknown_factor=unknown_factor))


def _correlation(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of rows (P, A, K) each with each, (P,) complex, and what both measured (P, 2) of power."""
    both = (a != 0) & (b != 0)
    size = np.stack([(np.abs(values) ** 2 * both).sum((1, 2)) for values in (a, b)], 1).clip(1e-300)
    # Roots first: of two rows without power the product of sizes is 0.
    return (a * b.conj()).sum((1, 2)) / np.sqrt(size).prod(1), size


def _neighbours(rows: Snapshots, reach: float, pairs: bool) -> np.ndarray:
    """Rows of one run within `reach` [m]: pairs (P, 2), or triples (P, 3) in line,
    the middle one first.
    """
    triples = [np.zeros((0, 2 if pairs else 3), np.int64)]
    for _, run in rows_by(rows.run):
        at = rows.places[run]
        near, index = (
            part.reshape(len(run), -1) for part in cKDTree(at).query(at, k=min(AROUND, len(run)))
        )
        good = (near <= reach) & (index != np.arange(len(run))[:, None])
        if pairs:
            row, column = np.nonzero(good & (index > np.arange(len(run))[:, None]))
            triples.append(run[np.c_[row, index[row, column]]])
            continue
        good &= near > 0
        step = (at[index] - at[:, None]) / np.maximum(near, 1e-12)[..., None]
        first = good.argmax(1)
        towards = np.take_along_axis(step, first[:, None, None], 1)
        length = np.take_along_axis(near, first[:, None], 1)
        opposite = good & ((step * towards).sum(-1) < STRAIGHT) & (length > EVEN * near)
        middle = np.flatnonzero(good.any(1) & opposite.any(1))
        third = opposite.argmax(1)
        triples.append(
            run[np.c_[middle, index[middle, first[middle]], index[middle, third[middle]]]]
        )
    triples_of_all = np.concatenate(triples)
    return triples_of_all[evenly_spaced(len(triples_of_all), MOST)]
