"""Whether measurements follow the schema's conventions, told by the direct path between known ends.

Each rival of `CONVENTIONS` is scored as the declared one is. Of channels the share of
a row's power along the direct path counts, with a free factor for each row, free phases of the
antennas and a free delay common to all rows, and whether the factors of rows agree; of spectra how
much of the sphere is stronger than the direction of the other end; of powers how well they fall
with distance. A row counts once, however many entries it has, since reflections are common to them,
and rows within half a wavelength count as one. Places must agree, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from gsparc.data.blocks import rows_by
from gsparc.data.moments import Snapshots
from gsparc.data.schema import LIGHT, Measurements
from gsparc.processes.few_rows import sample_row_numbers
from gsparc.processes.level_field import fit_level_field
from gsparc.tables.advice import LevelsAtPlaces
from gsparc.tables.conventions import CONVENTIONS, convert_conventions, known_array, traits

RATIO = math.log(1000)  # of likelihoods
ROWS = 400
# Of the rows drawn, at most, where that leaves LEAST rows
ENTRIES = {"csi": 2**15, "spectrum": 2**22}
LEAST = 64
FEWEST = {"csi": 32, "spectrum": 50}  # rows that tell
COHERENT = 8  # antennas, tones or both with one factor: fewer fit anything
ANY = {"csi": 0.01, "spectrum": 0.003}  # share that no path explains
# Of the median row, at least of a rival; a worse one says nothing
FIT = {"csi": 0.12, "spectrum": 0.8}
# The same of one delay for all rows, and its gain: reflections fit one, too
ONE_DELAY, CLEAR = 0.7, 0.15
HALVINGS = 3  # of the places, into groups
DROPPED = 2  # groups that speak most for a rival: the others must do so, too
SHARED = 8  # rows with one phase, at least
DELAYS = 4  # tried for each tone
LEAST_DB = 6.0  # of the largest value: less is no spectrum in decibels
EDGE = 0.5  # of the strongest lobe's peak; further down lie other paths and the floor
CLEAR_PLACES = math.log(1e6)  # of powers: shadowing is not Gaussian
EXPONENTS = 1.0, 6.0  # of a law of distance
# Logarithm of the ratio for the median spectrum, at least: lobes of arrays are no exact beams
LOBE = 0.5


@dataclass(frozen=True)
class Score:
    """How well rows follow a convention.

    Attributes:
        rows: (S,) logarithms of likelihoods.
        phases: the same of the factors that rows have in common.
        fit: share of the median row that it explains.
    """

    rows: np.ndarray
    phases: float
    fit: float

    @property
    def log_likelihood(self) -> float:
        """Of all rows; phases of neighbouring rows are not independent, and count half."""
        return float(self.rows.sum()) + self.phases / 2


def convention_warnings(data: Measurements) -> list[str]:
    """Name the convention that rows seem to follow instead of the declared one,
    and what mends it.
    """
    facts = data.site.target
    if facts.is_level:
        return _rivals_of_places(data)
    if facts.kind not in FEWEST:
        return []
    whole, labels = _arrayed(data)
    rows = _drawn(whole)
    few, drawn, labels = data.subset(rows[:1]), whole.subset(rows), labels[rows]
    entries = drawn.target.shape[2] * (1 if known_array(drawn) is None else drawn.target.shape[1])
    if len(rows) < FEWEST[facts.kind]:
        return []
    if facts.is_complex:
        return _rivals(drawn, few, labels) if entries >= COHERENT else []
    return _rivals(drawn, few, labels) + _decibels(drawn)


def _arrayed(data: Measurements) -> tuple[Measurements, np.ndarray]:
    """Rows, and labels (S,) int64 of those with one phase;
    stations heard at one place become an array.
    """
    stations = data.site.every_station
    run, station = data.runs_of(), data.stations_of()
    single = data.site.target.is_complex and data.target.shape[1] == 1
    if data.place is None or len(stations) < COHERENT or not single:
        return data, run * (int(station.max()) + 1) + station
    heard = Snapshots.from_rows(data, np.arange(len(data)))
    measured = np.ones(data.target.shape, bool) if data.mask is None else data.mask
    middle, turned = stations.position.mean(axis=0), np.tile(np.eye(3), (len(heard.places), 1, 1))
    site = replace(data.site, array=stations.position[heard.stations] - middle)
    return Measurements(
        site,
        heard.places,
        np.tile(middle, (len(heard.places), 1)),
        turned,
        heard.values,
        heard.arrange(measured) != 0,
    ), heard.run


def _drawn(data: Measurements) -> np.ndarray:
    """Rows (n,) at places of their own, drawn at random; channels half a wavelength apart."""
    place, facts = np.hstack([data.tx, data.rx_position]), data.site.target
    rows = np.flatnonzero(np.isfinite(place).all(axis=1))
    order = np.random.default_rng(0).permutation(rows)[: 20 * ROWS]
    if not len(order):
        return order
    side = float(np.ptp(place[order], axis=0).max()) / ROWS + 1e-9
    side = side if facts.is_image else max(side, LIGHT / float(data.site.tones().mean()) / 2)
    cells = np.floor((place[order] - place[order].min(axis=0)) / side)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return order[first[: min(ROWS, max(LEAST, ENTRIES[facts.kind] // data.target[0].size))]]


def _rivals(data: Measurements, few: Measurements, labels: np.ndarray) -> list[str]:
    """A warning where a rival fits far better than what is declared,
    with those that fit as well.
    """
    facts, declared = data.site.target, _score(data, labels)
    rivals: dict[str, Score] = {}
    for name in _tried(few):
        with suppress(ValueError):  # a grid turned beyond a pole
            placed = convert_conventions(data, [name])
            # Within a wavelength all places are one: whatever does not move fits.
            if (
                facts.is_image
                or np.ptp(placed.moving, axis=0).max() > LIGHT / placed.site.tones().mean()
            ):
                score = _score(placed, labels)
                delayed = score.fit > ONE_DELAY and (score.rows - declared.rows).mean() > CLEAR
                if score.fit > FIT[facts.kind] and (delayed or name != "delays_removed"):
                    rivals[name] = score
    best = max(rivals.values(), key=lambda one: one.log_likelihood, default=declared)
    if (
        _of_most_groups(best.rows - declared.rows, data) + (best.phases - declared.phases) / 2
        <= RATIO
    ):
        return []
    how = f"{len(data.target)} rows drawn fit the direct path more than 1,000 times better"
    return _mending(how, {name: rival.log_likelihood for name, rival in rivals.items()})


def _tried(data: Measurements) -> list[str]:
    return [
        n
        for n, convention in CONVENTIONS.items()
        if convention.tried and convention.trait in traits(data)
    ]


def _mending(how: str, rivals: Mapping[str, float]) -> list[str]:
    """The best of rivals by their likelihoods, with those that are as likely, and what mends it."""
    alike = [name for name, rival in rivals.items() if rival > max(rivals.values()) - RATIO]
    ways = " or ".join(f"dataset.{name}=true" for name in alike)
    ways += ", which these rows do not tell apart," if len(alike) > 1 else ""
    return [f"{how} with {CONVENTIONS[alike[0]].words}: is it that? {ways} mends it"]


def _rivals_of_places(data: Measurements) -> list[str]:
    """A warning where powers fall with distance far better at places
    as another convention has them.

    Beside a field of levels for each station:
    what is alike about near rows says nothing of distances.
    """
    links, rows = LevelsAtPlaces.of(data)
    candidates = np.flatnonzero(
        np.isfinite(np.hstack([data.tx, data.rx_position])[rows]).all(axis=1)
    )
    if data.site.paired or len(candidates) < FEWEST["spectrum"]:
        return []
    drawn = candidates[sample_row_numbers(len(candidates), ROWS, 0)]
    data, links = data.subset(rows[drawn]), links.take(drawn)

    def score(placed: Measurements, least: float = 10 * EXPONENTS[0]) -> float:
        distance = np.linalg.norm(placed.tx - placed.rx_position, axis=1)
        nearest = float(np.ptp(placed.moving[:, :3], axis=0).max()) / 300
        away = np.log10(np.maximum(distance, nearest))
        field = fit_level_field(placed.moving, links.level, links.station, [away])
        return field.score if least < -field.slope[0] < 10 * EXPONENTS[1] else -math.inf

    rivals = {name: score(convert_conventions(data, [name])) for name in _tried(data)}
    best, declared = max(rivals.values(), default=-math.inf), score(data, -math.inf)
    if not best - declared > CLEAR_PLACES:
        return []
    return _mending(
        f"{len(drawn)} powers drawn fall with distance a million times likelier", rivals
    )


def _groups(place: np.ndarray) -> np.ndarray:
    """Numbers (S,) of parts of the site, halved again and again along their longest side."""
    part = np.zeros(len(place), np.int64)
    for _ in range(HALVINGS):
        for number, inside in rows_by(part):
            along = place[inside, np.ptp(place[inside], axis=0).argmax()]
            part[inside] = 2 * number + (along > np.median(along))
    return part


def _of_most_groups(gain: np.ndarray, data: Measurements) -> float:
    """Sum of gains (S,) of all groups but those that speak most for a rival."""
    groups = rows_by(_groups(np.hstack([data.tx, data.rx_position])))
    return float(np.sort([gain[rows].sum() for _, rows in groups])[:-DROPPED].sum())


def _score(data: Measurements, labels: np.ndarray) -> Score:
    return (
        _spectra(data) if data.site.target.is_image else _channels(data, data.site.tones(), labels)
    )


def _channels(data: Measurements, tones: np.ndarray, labels: np.ndarray) -> Score:
    """By the share of power along the direct path,
    with factors of rows and antennas and a common delay.
    """
    measured = np.ones(data.target.shape, bool) if data.mask is None else data.mask
    values = np.where(measured, data.target, 0).astype(np.complex128)
    away, array = (data.tx - data.rx_position)[:, None], known_array(data)
    if array is not None:
        away = away - np.einsum("sij,aj->sai", data.rx_rotation, array)
    distance = np.linalg.norm(away, axis=2)
    direct = values * np.exp(2j * np.pi * distance[..., None] * tones / LIGHT)
    spacing = float(np.median(np.diff(np.sort(tones)))) if len(tones) > 1 else 1.0
    count = min(DELAYS * len(tones), 256) if len(tones) > 1 else 1
    delays = (np.arange(count) - count // 2) / count / spacing
    antennas = direct @ np.exp(2j * np.pi * np.outer(tones - tones.mean(), delays))
    used = measured.sum(axis=(1, 2)).astype(float)
    if array is None:
        used /= measured.any(axis=2).sum(axis=1).clip(1)
    power = (used * (np.abs(values) ** 2).sum(axis=(1, 2))).clip(1e-300)

    # Likelihoods (S,) at the delay that fits best
    def best(share: np.ndarray) -> tuple[np.ndarray, int]:
        rows = -np.log1p(-(1 - ANY["csi"]) * (share / power[:, None]).clip(0, 1))
        delay = int(rows.sum(axis=0).argmax())
        return rows[:, delay], delay

    if array is None:
        rows, delay = best((np.abs(antennas) ** 2).sum(axis=1))
        factor = antennas[:, 0, delay]
    else:
        rows, delay = best(np.abs(antennas.sum(axis=1)) ** 2)
        factor = antennas[:, :, delay].sum(axis=1)
        # Of antennas whose phases are free.
        other = antennas[:, :, best((np.abs(antennas) ** 2).sum(axis=1))[1]]
        if len(values) > 2 * other.shape[1]:
            level = np.sqrt((np.abs(other) ** 2).mean(axis=1, keepdims=True)).clip(1e-150)
            phases = np.angle(np.linalg.svd(other / level, full_matrices=False)[2][0])
            turned = other @ np.exp(-1j * phases)
            free, _ = best(np.abs(turned[:, None]) ** 2)
            if free.sum() > rows.sum():
                rows, factor = free, turned
    return Score(rows, _common(factor, labels), float(np.median(1 - np.exp(-rows))))


def _common(factor: np.ndarray, labels: np.ndarray) -> float:
    """Logarithm of the likelihood that factors (S,) of the same label have one phase."""
    unit, total = factor / np.abs(factor).clip(1e-150), 0.0
    for label in np.unique(labels):
        same = unit[labels == label]
        if len(same) >= SHARED:
            total -= len(same) * math.log1p(-(1 - ANY["csi"]) * abs(same.mean()) ** 2)
    return total


def _spectra(data: Measurements) -> Score:
    """By the share of the sphere that is stronger than the direction of the other end;
    half of it outside.
    """
    grid = data.site.grid
    assert grid is not None
    x, y, z = np.einsum("sji,sj->is", data.rx_rotation, data.tx - data.rx_position)
    row = np.rint(
        (np.arctan2(z, np.hypot(x, y)) - grid.first_elevation) / grid.elevation_step
    ).astype(int)
    column = np.rint(
        (np.arctan2(y, x) - grid.first_azimuth) / grid.azimuth_step % grid.per_turn
    ).astype(int)
    column = column % grid.width if grid.periodic else column
    inside = (row >= 0) & (row < grid.height) & (column < grid.width)
    angle = grid.solid_angles().numpy() / float(grid.solid_angles().sum())
    values = data.target.reshape(len(row), grid.height, grid.width)
    at = values[np.arange(len(row)), row.clip(0, grid.height - 1), column.clip(0, grid.width - 1)]
    at = at[:, None, None]
    stronger = (((values > at) + 0.5 * (values == at)) * angle).sum(axis=(1, 2))
    stronger = np.where(inside, stronger, 0.5)
    return Score(-np.log(stronger + ANY["spectrum"]), 0.0, 1 - 2 * float(np.median(stronger)))


def _decibels(data: Measurements) -> list[str]:
    """A warning where the strongest lobes of spectra fall as parabolas to their edges,
    not as beams do.
    """
    grid, values = data.site.grid, data.target.astype(np.float64) * data.site.target_scale
    assert grid is not None
    if data.target.dtype.kind != "f" or values.max() < LEAST_DB:
        return []
    gains = np.array(
        [_lobe(value.ravel(), grid.directions().numpy().reshape(-1, 3)) for value in values]
    )
    gains = np.nan_to_num(gains)
    if _of_most_groups(gains, data) < RATIO or np.median(gains) < LOBE:
        return []
    how = (
        f"the strongest lobes of {len(values)} spectra drawn, up to {values.max():.3g}, fit a beam"
    )
    return [
        f"{how} more than 1,000 times better as decibels: dataset.decibels=true makes them linear"
    ]


def _lobe(values: np.ndarray, directions: np.ndarray) -> float:
    """Logarithm of the likelihood that a Gaussian beam (P,) is in decibels over that it is linear.

    Fitted about its peak, to where it has fallen to `EDGE`.
    """
    peak = int(values.argmax())
    angle = np.arccos((directions @ directions[peak]).clip(-1, 1))
    outside = angle[values < EDGE * values[peak]].min(initial=np.pi)
    inside = (angle <= 1.5 * outside) & (values >= EDGE * values[peak])
    level = values[inside] / values[peak]
    across = np.linalg.svd(directions[peak][None])[2][1:]
    x, y = (directions[inside] @ across.T).T
    terms = np.column_stack([np.ones(len(x)), x, y, x * x, y * y, x * y])
    if len(level) <= terms.shape[1] + 2:
        return 0.0
    parabola = level - terms @ np.linalg.lstsq(terms, level, rcond=None)[0]
    log = np.linalg.lstsq(terms * level[:, None], np.log(level) * level, rcond=None)[0]
    beam = level - np.exp(terms @ log)
    return 0.5 * math.log((beam @ beam + 1e-9) / (parabola @ parabola + 1e-9))
