"""A list of stations: a second table, whose names a table of measurements is matched by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from gsparc.base.errors import Caution, list_first
from gsparc.tables.columns import choose_columns, rename_for_stations
from gsparc.tables.heads import LISTS, TOGETHER, parse_head, words_of
from gsparc.tables.links.stations import PER_STATION, SECTOR
from gsparc.tables.places import UNKNOWN_HEIGHT, Places, read_places
from gsparc.tables.sectors import TILTS, number_sites, read_sectors, sector_quantity
from gsparc.tables.sheet import Sheet

LEAST_LISTED = 10  # stations of a drive: of fewer, one that the list lacks is a mistake


@dataclass(frozen=True)
class StationList:
    """Stations in the order of their file.

    Attributes:
        names: (T,).
        places: (T,).
        extra: (T,) arrays by name: `PER_STATION`.
        index: (S,) which station each row of another table is of; None where each has a column
            there.
        aliases: other names of all of them.
        repeated: names that several of them share, by the head of their column.
        label: (T,) its own names, where `names` are others.
    """

    names: tuple[str, ...]
    places: Places
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    index: np.ndarray | None = None
    aliases: tuple[tuple[str, ...], ...] = ()
    repeated: dict[str, tuple[str, ...]] = field(default_factory=dict)
    label: tuple[str, ...] | None = None

    def shared_name_problem(self, words: np.ndarray) -> str | None:
        """Return what is wrong where words (S,) are of a column whose names several stations
        share.
        """
        column = set(words.tolist())
        for head, names in self.repeated.items():
            twice = [
                name for name in dict.fromkeys(names) if names.count(name) > 1 and name in column
            ]
            if twice and len(column & set(names)) > len(column & set(self.names)):
                which = [
                    station
                    for station, name in zip(self.names, names, strict=True)
                    if name == twice[0]
                ]
                advice = (
                    "leave only those of the area in the list, or say "
                    "dataset.columns.station=HEAD+HEAD"
                )
                return (
                    f"{head} {twice[0]} names {list_first(which)} of the list of stations; {advice}"
                )
        return None

    def use_names_of(self, words: np.ndarray) -> StationList:
        """Return the same under the names that most of words (S,) are of, its own first."""
        column = set(words.tolist())
        # Of names that fit alike the list's own are taken, as `max` keeps the first.
        names = max((self.names, *self.aliases), key=lambda names: len(column & set(names)))
        return replace(self, names=names, label=None if names == self.names else self.names)

    def part_by(self, words: np.ndarray, longer: np.ndarray) -> StationList:
        """Return a station for each of `longer` names (S,), where that of words (S,) is listed."""
        names, first = np.unique(longer, return_index=True)
        which = pd.Index(self.names).get_indexer(words[first])
        facts = {name: array[which] for name, array in self.extra.items()}
        return StationList(tuple(map(str, names)), self.places.take(which), facts)

    def match_heads(self, parts: Mapping[str, str]) -> tuple[StationList, dict[str, str]]:
        """Return the same under the names that heads, or their `parts`, hold,
        and that of each such head.
        """
        renamed = self.use_names_of(np.array([*parts, *parts.values()]))
        matches = {
            head: name
            for head, part in parts.items()
            for name in (part, head)
            if name in renamed.names
        }
        # One head alone may be called like a station by chance, unless by its own name.
        return (renamed, matches) if len(matches) > 1 or renamed.label is None else (self, {})

    def add_missing(self, words: np.ndarray, notes: list[str]) -> StationList:
        """Add those of words (S,) that it lacks, if few, at unknown places, with a note;
        return it.
        """
        names = [word for word in dict.fromkeys(words.tolist()) if word]
        missing_names = [word for word in names if word not in self.names]
        # Of few stations, or with a third of them missing,
        # it is the wrong list rather than an old one.
        if not missing_names or len(names) < LEAST_LISTED or len(names) < 3 * len(missing_names):
            return self
        rows, more = int(np.isin(words, missing_names).sum()), len(missing_names)
        finding = (
            f"{more} of {len(names)} stations are not in the list, with {rows} of {len(words)} rows"
        )
        notes.append(Caution(f"{finding}: {list_first(missing_names)}; their places are unknown"))
        height = (
            None if self.places.height is None else np.r_[self.places.height, np.full(more, np.nan)]
        )
        across = np.concatenate([self.places.across, np.full((more, 2), np.nan)])
        extra = {
            # Of what a list says besides, only facts of sectors may be unknown (`Stations.sector`).
            name: np.r_[array, np.full(more, np.nan if name in SECTOR else array[0])]
            for name, array in self.extra.items()
        }
        where = Places(across, height, self.places.degrees)
        label = None if self.label is None else (*self.label, *missing_names)
        return replace(
            self, names=(*self.names, *missing_names), places=where, extra=extra, label=label
        )


def read_stations(sheet: Sheet) -> StationList | None:
    """Read a table of stations: name, and x, y, z or latitude, longitude, height, empty:
    unknown.
    """
    called = [head for head in sheet.heads if head.strip().lower() in ("name", "id")]
    naming = [head for head in sheet.heads if parse_head(head).role == "station"]
    # A list names a station in each row, and may name its site, too
    if not called and len(naming) > 1:
        called = [head for head in naming if len(set(sheet.words(head).tolist())) == len(sheet)][:1]
    # What is of a beam, or a carrier, is no measurement, whatever its head says besides.
    group = {*SECTOR, *TILTS, "carrier_hz"}
    others = sheet.frame[[head for head in sheet.heads if sector_quantity(head) not in group]]
    plain = replace(sheet, frame=others, notes=[])
    columns = choose_columns(plain, {"station": called[0]} if len(called) == 1 else {}).values()
    chosen = {
        rename_for_stations(group[0]).role: tuple(map(rename_for_stations, group))
        for group in columns
    }
    notes = (note for note in plain.notes if not note.startswith("not used"))
    sheet.notes.extend(type(note)(f"{sheet.source}: {note}") for note in notes)
    if "station" not in chosen:
        return sheet.refuse("no column of names; expected one called name or station")
    coordinates = read_places(sheet, chosen, "station_", unknown=True)
    used = {column.head for columns in chosen.values() for column in columns}
    aliases = _aliases(sheet, used)
    sectors = read_sectors(sheet, used | {pair[0] for pair in aliases})
    sites = number_sites(sheet)
    if sites is not None:
        sectors["station_site"] = sites[1]
    if coordinates is not None and coordinates.height is None and "height" in sectors:
        coordinates = replace(
            coordinates, height=np.nan_to_num(sectors["height"], nan=UNKNOWN_HEIGHT)
        )
    if coordinates is None:
        if not sheet.problems:
            sheet.refuse("no coordinates; expected columns x, y, z or latitude, longitude, height")
        return None
    names = sheet.joined(c.head for c in chosen["station"])
    values_of = {"+".join(heads): tuple(sheet.joined(heads).tolist()) for heads in aliases}
    unique = {head: each for head, each in values_of.items() if len(set(each)) == len(each)}
    repeated = {head: each for head, each in values_of.items() if len(set(each)) < len(each)}
    by = ["+".join(c.head or "" for c in chosen["station"]), *unique]
    # Names that repeat, like sites in a list of sectors,
    # give way to those of a column without copies.
    if unique and len(set(names.tolist())) < len(names) and (names != "").all():
        names, by = np.array(unique[by[1]]), by[1:]
    of_sites = "" if sites is None else f", sites by {sites[0]!r}"
    sheet.notes.append(
        f"{sheet.source}: stations are matched by {list_first([*map(repr, by)])}{of_sites}"
    )
    for i in np.flatnonzero(names == ""):
        sheet.problems.add(f"{sheet.source}, {sheet.rows[i]}", "no name; expected the station's")
    values, counts = np.unique(names, return_counts=True)
    for name in values[(counts > 1) & (values != "")]:
        rows = " and ".join(sheet.rows[i] for i in np.flatnonzero(names == name)[:2])
        sheet.refuse(f"station {str(name)!r} is listed twice, in {rows}")
    facts = sectors | {
        role: chosen[role][0].numbers(sheet) for role in PER_STATION if role in chosen
    }
    extra = {
        role: array for role, array in facts.items() if role in PER_STATION and array is not None
    }
    return StationList(
        tuple(map(str, names)), coordinates, extra, None, tuple(unique.values()), repeated
    )


def _aliases(sheet: Sheet, used: set[str | None]) -> list[tuple[str, ...]]:
    """Columns, alone and with those that make them unique,
    that may name the stations of a list besides.
    """
    result: list[tuple[str, ...]] = []
    for head in sheet.heads:
        words = set(words_of(head)) & LISTS["station"]
        if not words:
            continue
        result += [(head,)] if head not in used else []
        beside = TOGETHER.get(min(words), set())
        result += [
            (head, other)
            for other in sheet.heads
            if other != head and set(words_of(other)) & beside
        ]
    return result
