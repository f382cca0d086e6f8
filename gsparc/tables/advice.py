"""Advice on columns that are not used: tried on levels that are left out before it is given.

Levels of each station are a correlated field over places, and noise. With a column, as transmitters
(a field for each value), devices (an offset for each) or a number that is added, levels that are
left out must be predicted better, by several standard errors. A column that follows the level, a
quality or another reading of it, tells far rows as well as near ones, and is no advice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from scipy.spatial import cKDTree

from gsparc.base.errors import Caution
from gsparc.data.schema import Measurements
from gsparc.physics.decibels import to_decibels
from gsparc.processes.factor import Factor
from gsparc.processes.level_field import fit_level_field
from gsparc.tables.column import Chosen, used_heads
from gsparc.tables.heads import LISTS, words_of
from gsparc.tables.sheet import Sheet, say_column

LEAST_ROWS, MOST_ROWS = 60, 480  # links that tell; that are looked at
CENTRES = 6  # about which those are chosen, so that they stay dense
REPEATED = 4  # rows for each value of a column that may name something
MOST_PIECES = 5
SURE = 3.0  # standard errors by which the squared error falls: many columns are tried
LESS, COPY = 0.9, 0.1  # of near ones to far ones; of far ones that are left, at least
SPREAD = 10.0  # variance of constants, parts of that of a field
ALIKE = 1.03  # errors within this ratio are of columns that tell the same
Kind = Literal["transmitter", "device", "number"]
KINDS: tuple[Kind, ...] = ("number", "device", "transmitter")


@dataclass(frozen=True)
class Effect:
    """What a column does to levels.

    Attributes:
        head: of the column.
        kind: its values name transmitters, or devices that each have an offset, or are added to the
            level.
        error: of levels that are left out, without it and with it [dB].
        part: (n,) that it adds to the levels [dB].
        size: a device's largest offset to another [dB], or what a number is multiplied by.
    """

    head: str
    kind: Kind
    error: tuple[float, float]
    part: np.ndarray
    size: float = 0.0


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
    dense = _dense_rows(links.place)
    links, row, effects = links.take(dense), row[dense], list[Effect]()
    texts = {head: pd.factorize(words[row])[0] for head, words in columns.items()}
    while len(links) >= LEAST_ROWS and len(effects) < MOST_PIECES:
        gram = _gram(links)
        plain, _ = _leave_out(gram, links)
        rest = [head for head in columns if head not in {effect.head for effect in effects}]
        tried = [_try(gram, links, plain, h, texts[h], columns[h][row]) for h in rest]
        better = sorted(filter(None, tried), key=lambda effect: effect.error[1])
        if not better:
            break
        # Of columns that tell the same apart the first of the fewest values.
        alike = [effect for effect in better if effect.error[1] <= ALIKE * better[0].error[1]]
        best = min(alike, key=lambda effect: texts[effect.head].max())
        effects.append(best)
        if best.kind == "transmitter":
            links = replace(links, station=_pairs(links.station, texts[best.head]))
        else:
            links = replace(links, level=links.level - best.part)
    return effects


def _leave_out(
    gram: np.ndarray, links: LevelsAtPlaces, code: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n,) [dB] of levels, each left out, and what values `code` (n,) add to them."""
    same = links.station[:, None] == links.station
    covariance = np.where(same, gram + SPREAD, 0.0)
    of_code = np.zeros_like(gram) if code is None else SPREAD * (code[:, None] == code)
    inverse = Factor.from_gram(torch.from_numpy(covariance + of_code)).inverse.numpy()
    weights = inverse.sum(0)
    precision = inverse - np.outer(weights, weights) / weights.sum()
    solved = precision @ links.level
    return solved / precision.diagonal(), of_code @ solved


def _try(
    gram: np.ndarray,
    links: LevelsAtPlaces,
    plain: np.ndarray,
    head: str,
    code: np.ndarray,
    words: np.ndarray,
) -> Effect | None:
    """The better of what a column may be; None: it is nothing, or follows the level."""
    effects = list[Effect]()
    values = pd.to_numeric(pd.Series(words), errors="coerce").to_numpy(float)

    def add(kind: Kind, errors: np.ndarray, part: np.ndarray, far: float, size: float) -> None:
        near = float((errors**2).mean() / max((plain**2).mean(), 1e-12))
        if _fall(plain, errors) and far > COPY and near < LESS * far:
            both = math.sqrt((plain**2).mean()), math.sqrt((errors**2).mean())
            effects.append(Effect(head, kind, both, part, size))

    def share(level: np.ndarray, labels: np.ndarray) -> float:
        whole = _centred(links.level, links.station)
        return float(np.var(_centred(level, labels)) / max(np.var(whole), 1e-12))

    if 0 < code.max() < len(code) / REPEATED:
        errors, part = _leave_out(gram, links, code)
        far = share(links.level - part, links.station)
        add("device", errors, part, far, float(np.ptp(part)))
        parted = replace(links, station=_pairs(links.station, code))
        far = share(links.level, parted.station)
        add("transmitter", _leave_out(gram, parted)[0], part, far, 0.0)
    if LISTS["adds"] & {*words_of(head)} and np.isfinite(values).all() and np.ptp(values) > 0:
        for times in (1.0, -1.0, 0.1, -0.1, 0.01, -0.01):
            part = times * values
            errors, _ = _leave_out(gram, replace(links, level=links.level - part))
            add("number", errors, part, share(links.level - part, links.station), times)
    least = min((effect.error[1] for effect in effects), default=0.0)
    alike = [effect for effect in effects if effect.error[1] <= ALIKE * least]
    # Of kinds that tell the same the simplest.
    return min(alike, key=lambda effect: KINDS.index(effect.kind), default=None)


def _fall(plain: np.ndarray, errors: np.ndarray) -> bool:
    """Whether squares of errors (n,) are below those of plain ones by more than chance."""
    fall = plain**2 - errors**2
    return bool(fall.mean() > SURE * fall.std() / math.sqrt(len(fall)))


def is_better_parted(links: LevelsAtPlaces, code: np.ndarray) -> bool:
    """Tell whether levels that are left out are predicted better with a station for each code."""
    gram = _gram(links)
    parted = replace(links, station=_pairs(links.station, code))
    return _fall(_leave_out(gram, links)[0], _leave_out(gram, parted)[0])


def _gram(links: LevelsAtPlaces) -> np.ndarray:
    """Covariances (n, n) of the field of levels at the places of links."""
    field = fit_level_field(links.place, links.level, links.station)
    return field.kernel.gram(torch.from_numpy(links.place)).numpy()


def _centred(value: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Values (n,) less the mean of their group (n,)."""
    which = np.unique(group, return_inverse=True)[1].reshape(-1)
    return value - (np.bincount(which, value) / np.bincount(which))[which]


def _pairs(station: np.ndarray, code: np.ndarray) -> np.ndarray:
    return np.unique(np.c_[station, code], axis=0, return_inverse=True)[1].reshape(-1)


def _dense_rows(place: np.ndarray) -> np.ndarray:
    """Rows (m,) of places (n, d), at most `MOST_ROWS`, those about a few of them."""
    if len(place) <= MOST_ROWS:
        return np.arange(len(place))
    centres = place[np.random.default_rng(0).choice(len(place), CENTRES, replace=False)]
    return np.unique(cKDTree(place).query(centres, k=MOST_ROWS // CENTRES)[1])


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
        f"runs: {_gain(effect)}: {hints[effect.kind]}"
        for effect in find_effects(links, rows, {"run": data.run.astype(str)})
    ]


def _gain(effect: Effect) -> str:
    before, after = effect.error
    return f"levels left out are predicted to {after:.2g} instead of {before:.2g} dB"


def advise(
    sheet: Sheet,
    chosen: Chosen,
    reads: Callable[[Mapping[str, object]], Any],
    data: Measurements,
    file_row: np.ndarray,
) -> list[str]:
    """Return a caution for each column that explains what places and stations do not,
    and how to use it.

    Args:
        sheet: the table.
        chosen: its columns that are used.
        reads: the arrays with columns by quantity besides, None where they cannot be read.
        data: that these columns became.
        file_row: (S,) row of the table, from 0, of each row of these.
    """
    if "rssi_db" not in chosen or not np.ptp(data.moving, axis=0).any():
        return []
    links, measured = LevelsAtPlaces.of(data)
    row = file_row[measured]
    # Levels may drift
    used = used_heads(chosen) - {column.head for column in chosen.get("time_s", ())}
    words = {head: sheet.words(head) for head in sheet.heads if head not in used}
    if words and len(links) < LEAST_ROWS:
        few = f"columns that are not used are tried from {LEAST_ROWS} links on, here are"
        return [f"{few} {len(links)}: devices, powers or other transmitters would pass unseen"]
    notes = list[str]()
    power, wide = chosen["rssi_db"][0], len(chosen["rssi_db"]) > 1
    times = f"*{power.unit.times}" if power.unit is not None and power.unit.times else ""
    said = {"rssi_db": f"{power.head}{times}"}
    said |= {"station": "+".join(c.head or "" for c in chosen.get("station", ()))}
    for effect in find_effects(links, row, words):
        head, role = effect.head, "station"
        if effect.kind == "number":
            role, size = "rssi_db", abs(effect.size)
            text = f"{'+' if effect.size < 0 else '-'}{head}{'' if size == 1 else f'*{size:g}'}"
            meaning, does = (
                f"a number that adds {effect.size:g} dB each to the level",
                "takes it off",
            )
        elif effect.kind == "device":
            role, text, does = "device", f"+{head}", "takes each off"
            meaning = f"an offset of all levels for each value, up to {effect.size:.1f} dB: devices"
        else:
            text, meaning = f"+{head}", "another transmitter for each value"
            does = "tells them apart"
        said[role] = (said.get(role, "") + text).removeprefix("+")
        how = f"{say_column(role, said[role])} {does}"
        if role == "station" and wide:
            how = "a file for each value takes them apart"
        elif not _reads_whole(reads({role: said[role]}), data):
            continue
        notes.append(
            Caution(f"column {head!r} is not used, but with it {_gain(effect)}: {meaning}? {how}")
        )
    return notes


def _reads_whole(raw: Any, data: Measurements) -> bool:
    """Whether no row, and no station, is lost of what was read before."""
    if raw is None or raw.arrays["rssi_db"].ndim > 1:
        return raw is not None
    names = raw.arrays.get("station_name", ())
    stations = 0 if data.site.stations is None else len(data.site.stations)
    return (
        len(raw.arrays["rssi_db"]) >= (data.censored_side() <= 0).sum() and len(names) >= stations
    )
