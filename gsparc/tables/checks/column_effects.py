"""What a column explains of levels that places and stations do not: another transmitter, a device,
a number.

Levels of each station are a correlated field over places, and noise. Three rivals are scored by
likelihood, with a Bayesian information criterion for constants: a field for each value of the
column (transmitters), an offset for each value over all stations (devices), a multiple of the value
(a number). A column that follows the level, a quality or another reading of it, would win them all:
it tells far rows as well as near ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gsparc.data.blocks import rows_by
from gsparc.data.schema import Measurements
from gsparc.physics.decibels import to_decibels
from gsparc.processes.level_field import LevelField, fit_level_field

LEAST_ROWS, MOST_ROWS = 60, 480  # links that tell; that are looked at
CENTRES = 6  # about which those are chosen, so that they stay dense
NEAR = 8  # rows that a row is compared with
REPEATED = 4  # rows for each value of a column that may name something
RATIO = math.log(15)  # of likelihoods
COPY, LESS, WEAK = (0.9, 0.7), 0.9, 0.85  # see `_contrast`
TOLERANCE = 0.2  # of a slope that should be 1, or another power of ten
MOST_EFFECTS = 4
ALIKE = 1.03  # contrasts within this ratio are of columns that tell the same
Kind = Literal["transmitter", "device", "number"]


@dataclass(frozen=True)
class Effect:
    """What a column does to levels.

    Attributes:
        head: of the column.
        kind: its values name transmitters, or devices that each have an offset, or are added to the
            level.
        share: of the variance that places and stations leave, that it explains.
        size: a device's largest offset to another [dB], or what a number is multiplied by.
        contrast: what it leaves of differences between near rows over what it leaves between far
            ones.
    """

    head: str
    kind: Kind
    share: float
    size: float = 0.0
    contrast: float = 0.0


TRUTHS = ({"true", "false"}, {"0", "1"}, {"yes", "no"}, {"t", "f"}, {"y", "n"})
# Of the variance about near rows, from which on levels follow these rather than a receiver
SMOOTH = 0.25
SURE = 5.0  # deviations of the logarithm of a ratio of variances


@dataclass(frozen=True)
class LevelsAtPlaces:
    """Levels of links.

    Attributes:
        place: (n, d) [m].
        station: (n,) int64.
        level: (n,) [dB], finite.
    """

    place: np.ndarray
    station: np.ndarray
    level: np.ndarray

    def __len__(self) -> int:
        return len(self.level)

    @staticmethod
    def of(data: Measurements) -> tuple[LevelsAtPlaces, np.ndarray]:
        """Return those of powers that were measured, and (n,) their rows."""
        rows = np.flatnonzero((data.censored_side() == 0) & (data.target[:, 0] > 0))
        level = to_decibels(data.target[rows, 0].astype(np.float64))
        return LevelsAtPlaces(data.moving[rows], data.stations_of(rows), level), rows

    def take(self, rows: np.ndarray) -> LevelsAtPlaces:
        """Return some of them."""
        return LevelsAtPlaces(self.place[rows], self.station[rows], self.level[rows])


def find_effects(
    links: LevelsAtPlaces, row: np.ndarray, columns: Mapping[str, np.ndarray]
) -> list[Effect]:
    """Return what columns explain, the most first, each beside those before it.

    Args:
        links: whose stations are taken for granted.
        row: (n,) of a table, of each link.
        columns: by their heads, a text for each row of the table; empty: no value.
    """
    rng, effects_so_far = np.random.default_rng(0), list[Effect]()
    dense = _dense_rows(links.place, rng)
    links, row = links.take(dense), row[dense]
    texts = {head: pd.factorize(words[row])[0] for head, words in columns.items()}
    values = {head: _numbers(words[row]) for head, words in columns.items()}
    while len(links) >= LEAST_ROWS and len(effects_so_far) < MOST_EFFECTS:
        plain, pairs = _fit(links, links.station), (_near_pairs(links), _far_pairs(links, rng))
        rest = [head for head in columns if head not in {effect.head for effect in effects_so_far}]
        candidates = [
            _effect(links, plain, pairs, head, texts[head], values[head]) for head in rest
        ]
        effects = sorted(
            (candidate for candidate in candidates if candidate is not None),
            key=lambda one: one.contrast,
        )
        if not effects:
            break
        # Of columns that tell the same apart the first of the fewest values.
        alike = (effect for effect in effects if effect.contrast <= ALIKE * effects[0].contrast)
        best = min(alike, key=lambda one: texts[one.head].max())
        effects_so_far.append(best)
        value = values[best.head]
        if best.kind == "number" and value is not None:
            links = replace(links, level=links.level - best.size * value)
        elif best.kind == "device":
            links = replace(links, level=links.level - _devices(links, texts[best.head]).regression)
        else:
            links = replace(links, station=_pairwise(links.station, texts[best.head]))
    return effects_so_far


def run_warnings(data: Measurements) -> list[str]:
    """Warn of runs that tell levels apart as a transmitter elsewhere would, or another gain."""
    if not data.site.maps_levels or data.run is None:
        return []
    links, rows = LevelsAtPlaces.of(data)
    hints = {
        "transmitter": "did what stands still move between them? dataset.runs=[NAME] takes one",
        "device": "another gain or device in each? dataset.columns.device=HEAD takes offsets off "
        "a table's",
    }
    return [
        f"runs explain {effect.share:.0%} of what places and stations leave: {hints[effect.kind]}"
        for effect in find_effects(links, rows, {"run": data.run.astype(str)})
        if effect.kind in hints
    ]


def find_filled(
    links: LevelsAtPlaces, row: np.ndarray, columns: Mapping[str, np.ndarray]
) -> dict[str, str]:
    """Return columns of truths, and which of their values rows have that were filled
    in from near ones.

    What is interpolated has no noise of its own:
    it differs far less from its neighbours than a measurement.
    """
    filled, delta = {}, np.full(len(links), np.nan)
    for _, rows in rows_by(links.station):
        if len(rows) > NEAR:
            near = cKDTree(links.place[rows]).query(links.place[rows], k=NEAR // 2 + 1)[1][:, 1:]
            delta[rows] = links.level[rows] - links.level[rows][near].mean(1)
    for head, words in columns.items():
        cells = np.char.lower(words[row])
        if {*np.unique(cells).tolist()} not in TRUTHS:
            continue
        spread = {
            value: delta[(cells == value) & np.isfinite(delta)]
            for value in np.unique(cells).tolist()
        }
        (smooth, less), (_, more) = sorted(
            spread.items(), key=lambda item: np.median(np.abs(item[1]))
        )
        if min(len(less), len(more)) < LEAST_ROWS / 3:
            continue
        ratio = math.log(max(float(np.var(less)), 1e-12) / float(np.var(more)))
        if ratio < math.log(SMOOTH) and ratio < -SURE * math.sqrt(2 / len(less) + 2 / len(more)):
            filled[head] = str(words[row][cells == smooth][0])
    return filled


def _fit(
    links: LevelsAtPlaces, group: np.ndarray, columns: Sequence[np.ndarray] = ()
) -> LevelField:
    return fit_level_field(links.place, links.level, group, columns)


def _devices(links: LevelsAtPlaces, code: np.ndarray) -> LevelField:
    return _fit(
        links, links.station, [(code == device).astype(float) for device in np.unique(code)[1:]]
    )


def _effect(
    links: LevelsAtPlaces,
    plain: LevelField,
    pairs: Sequence[np.ndarray],
    head: str,
    code: np.ndarray,
    value: np.ndarray | None,
) -> Effect | None:
    """What one column explains; None: nothing, or it follows the level."""
    fits: dict[Kind, tuple[LevelField, float]] = {}
    if 0 < code.max() < len(code) / REPEATED:
        offsets, contrast = _devices(links, code), _contrast(links, pairs, code)
        if contrast < 1:
            fits["transmitter"] = _fit(links, _pairwise(links.station, code)), contrast
        # Few pairs are of one device, all are of known offsets: either may tell.
        if (contrast := min(contrast, _contrast(links, pairs, offsets.regression, 1.0))) < 1:
            fits["device"] = offsets, contrast
    if value is not None:
        fit = _fit(links, links.station, [value])
        exact = (
            abs(fit.slope[0] / _power_of_ten(fit.slope[0]) - 1) < TOLERANCE
            and abs(fit.slope[0]) < 2
        )
        if exact and (contrast := _contrast(links, pairs, value, float(fit.slope[0]))) < LESS:
            fits["number"] = fit, contrast
    kind = max(fits, key=lambda one: fits[one][0].score, default=None)
    if kind is None or (gain := fits[kind][0].score - plain.score) < RATIO:
        return None
    (best, contrast), share = fits[kind], 1 - math.exp(-2 * gain / len(links))
    size = float(np.ptp([0.0, *best.slope])) if kind == "device" else 0.0
    size = _power_of_ten(best.slope[0]) if kind == "number" else size
    return Effect(head, kind, share, size, contrast)


def _power_of_ten(slope: float) -> float:
    return math.copysign(10.0 ** round(math.log10(max(abs(slope), 1e-9))), slope)


def _contrast(
    links: LevelsAtPlaces, pairs: Sequence[np.ndarray], code: np.ndarray, slope: float = 0.0
) -> float:
    """What a column leaves of differences of near rows over what it leaves of far ones; 1:
    it follows levels.

    What a transmitter, a device or a number adds is a large part of what near rows differ by and a
    small one between far rows, whose places count; a quality tells far rows at least as well.

    Args:
        links: as they are known so far.
        pairs: (P, 2) of near rows, and of any rows of a station.
        code: (n,) the column's values, or numbers.
        slope: that multiplies numbers; 0: none.
    """
    level, which = links.level, np.unique(links.station, return_inverse=True)[1].reshape(-1)
    residual = level - slope * code if slope else level
    # Stations of few rows are looked at together, about their own means.
    few = np.bincount(which)[which] < LEAST_ROWS / 3
    for group in np.unique(part := np.where(few, -1, which)):
        mask = part == group
        whole, within = (_centred(value[mask], which[mask]) for value in (level, residual))
        within = within if slope else _centred(within, code[mask])
        if (
            np.var(within) < (1 - COPY[int(which.max() > 0)]) * np.var(whole)
            and mask.sum() >= LEAST_ROWS / 3
        ):
            return 1.0
    rest = []
    for first, second in (pair.T for pair in pairs):
        change, step = level[first] - level[second], code[first] - code[second]
        residual = change - slope * step if slope else change[step == 0]
        if min(len(residual), (step != 0).sum()) < NEAR:
            return 1.0
        rest.append(float((residual**2).mean() / max((change**2).mean(), 1e-12)))
    contrast = rest[0] / max(rest[1], 1e-12)
    if rest[1] > WEAK and contrast < 1 / LESS:  # it tells nothing of far rows
        return min(contrast, LESS)
    return contrast if contrast < LESS else 1.0


def _centred(value: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Values (n,) less the mean of their group (n,)."""
    which = np.unique(group, return_inverse=True)[1].reshape(-1)
    return value - (np.bincount(which, value) / np.bincount(which))[which]


def _near_pairs(links: LevelsAtPlaces) -> np.ndarray:
    """Pairs (P, 2) of near rows of a station."""
    pairs = [np.zeros((0, 2), np.int64)]
    for _, rows in rows_by(links.station):
        count = min(NEAR + 1, len(rows))
        index = rows[
            cKDTree(links.place[rows]).query(links.place[rows], k=count)[1].reshape(-1, count)
        ]
        both = np.sort(np.c_[np.repeat(rows, count), index.ravel()], axis=1)
        pairs.append(np.unique(both[both[:, 0] != both[:, 1]], axis=0))
    return np.concatenate(pairs)


def _far_pairs(links: LevelsAtPlaces, rng: np.random.Generator) -> np.ndarray:
    """Pairs (P, 2) of any rows of a station."""
    pairs = np.concatenate(
        [rng.choice(ids, (4 * NEAR * len(ids), 2)) for _, ids in rows_by(links.station)]
    )
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _pairwise(station: np.ndarray, code: np.ndarray) -> np.ndarray:
    return np.unique(np.c_[station, code], axis=0, return_inverse=True)[1].reshape(-1)


def _dense_rows(place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rows (m,) of places (n, d), at most `MOST_ROWS`, those about a few of them."""
    if len(place) <= MOST_ROWS:
        return np.arange(len(place))
    centres = place[rng.choice(len(place), CENTRES, replace=False)]
    return np.unique(cKDTree(place).query(centres, k=MOST_ROWS // CENTRES)[1])


def _numbers(words: np.ndarray) -> np.ndarray | None:
    """Numbers (n,) of text; None where one has none."""
    values = pd.to_numeric(pd.Series(words), errors="coerce").to_numpy(float)
    return values if np.isfinite(values).all() and np.ptp(values) > 0 else None
