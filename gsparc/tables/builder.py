"""The arrays of a table: the measurement, both ends, stations, runs and times."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pandas as pd

from gsparc.base.errors import Caution, list_first, suggest_name
from gsparc.data.schema import ENDS, OTHER
from gsparc.tables import heads, places
from gsparc.tables.column import JOINED, name_columns
from gsparc.tables.links.stations import PER_STATION
from gsparc.tables.measured import Measured
from gsparc.tables.places import Places
from gsparc.tables.sheet import Answer, say_column
from gsparc.tables.station_list import StationList
from gsparc.tables.times import read_times


class Builder(Measured):
    """Takes all arrays out of a table, noting what is wrong."""

    def build(self) -> dict[str, np.ndarray]:
        """Return all arrays; what is wrong is in `sheet.problems`."""
        measured = self._measurement()
        # Ends after the measurement: columns of several stations decide whether a station's column
        # is needed.
        self._ends(measured)
        for role in ("sensitivity_db", "frequency_hz", "spacing_hz"):
            if role in self.chosen and len(self.chosen[role][0].value) < 2:
                values = self._of_rows(role)
                self.arrays |= {} if values is None else {role: values}
        self._frequency(channels="csi" in self.arrays)
        for role in ("run", "row_name", "device"):
            if role in self.chosen:
                self.arrays[role] = self.sheet.joined(column.head for column in self.chosen[role])
        self._times([column.head or "" for column in self.chosen.get("time_s", ())])
        # Without names rows are called by their line in the file,
        # so that messages survive dropped rows.
        self.arrays.setdefault("row_name", np.array(self.sheet.rows))
        return self.arrays

    def _times(self, named: list[str]) -> None:
        """Add seconds of columns of times."""
        if not named:
            return
        if (times := read_times(self.sheet, named)) is None:
            return self.refuse("holds no times; expected seconds, dates or a clock", named[0])
        self.arrays["time_s"], meaning = times
        quoted = " and ".join(map(repr, named))
        self.notes.append(f"column{'s' * (len(named) > 1)} {quoted} taken as time_s: {meaning}")

    def _ends(self, measured: str | None) -> None:
        """Add positions and stations."""
        all_ends = places.read_ends(self.sheet, self.chosen, strict=False)
        ends = dict(all_ends)
        # Said beside what is wrong with levels: one look at the file mends both.
        coordinates = {
            f"{end}{axis}" for end in heads.ENDS[:-1] for axis in heads.AXES if axis != "z"
        }
        if self._is_asked(coordinates) or self._ask_places(coordinates):
            return None
        if coordinates.isdisjoint(self.chosen):
            fault = (
                f"no coordinates among {self.sheet.first_heads()}; say "
                "dataset.columns.x=COLUMN and .y"
            )
            return self.refuse(f"{fault}, or .lat, .lon")
        if self.sheet.is_open():
            return
        # Two named ends and one without a name: nothing says which
        # of the named ones it would replace.
        if len(ends) == 3:
            fault = "coordinates of rx, of tx and of an end without a name"
            return self.refuse(f"{fault}; expected two ends, rename one")
        stations = self._stations(measured, ends)
        if self.sheet.problems:
            return
        stay = next((end for end in all_ends if end not in ends), "")
        moving, where = self._moving(ends, stay)
        # Where there are no stations
        others = {str(OTHER[moving]): ends.popitem()[1]} if ends else {}
        if stations is not None:
            self.arrays["station_name"] = np.array(stations.names)
            self.arrays |= (
                {} if stations.label is None else {"station_label": np.array(stations.label)}
            )
            self.arrays |= (
                {} if stations.index is None else {"station": stations.index.astype(np.int64)}
            )
            # A list in degrees does not go with rows that are apart in metres,
            # of which nobody knows where.
            by_row = any(column.by_row for column in self.chosen.get(f"{moving}_x", ()))
            others["station"] = Places.unknown(len(stations.names)) if by_row else stations.places
        self._add_places(moving, where)
        for name, other in others.items():
            if other.degrees != where.degrees:
                rows, rest = ("degrees", "metres") if where.degrees else ("metres", "degrees")
                fault = (
                    f"{rows}, those of {ENDS.get(name, 'stations')} in {rest}; expected one of them"
                )
                return self.refuse(f"the places of rows are in {fault}")
            still = name != "station" and len(np.unique(other.all(), axis=0)) == 1
            self._add_places(name, other.take(np.array([0])) if still else other, still=still)

    def _ask_places(self, coordinates: set[str]) -> bool:
        """Ask about heads that hold words of coordinates, where none says more; whether it did."""
        if not coordinates.isdisjoint(self.chosen):
            return False
        likely = {
            axis: [head for head in self.sheet.heads if re.search(words, head)]
            for axis, words in heads.SHEET["likely"].items()
        }
        for pair in (("latitude", "longitude"), ("x", "y")):
            of_axes = [likely[axis] for axis in pair]
            if all(len(heads_of_axis) == 1 for heads_of_axis in of_axes):
                names = [heads_of_axis[0] for heads_of_axis in of_axes]
                cells = " and ".join(map(self.sheet.first_cell, names))
                why = f"{name_columns(names)} may be {' and '.join(pair)}"
                self.sheet.ask(why, Answer(dict(zip(pair, names, strict=True)), cells))
                return True
        return False

    def _moving(self, ends: dict[str, Places], stay: str) -> tuple[str, Places]:
        """Which end the rows are places of, where `stay` are stations;
        it is taken out of `ends`.
        """
        named: list[str] = [end for end in ("rx_", "tx_") if end in ends]
        if "" in ends:
            named = named or [stay] * bool(stay)
            # The end without a name is whichever the named one is not; unsaid, it is the receiver.
            moving = "tx" if named == ["rx_"] else "rx"
            station = self.chosen.get("station") or self.chosen.get("station_x") or ()
            words = {*heads.words_of(station[0].head or "")} if station else set()
            if not named and words & heads.LISTS["hearing"]:
                moving = "tx"
            if not named:
                other = "tx" if moving == "rx" else "rx"
                axis = "latitude" if ends[""].degrees else "x"
                rename = (
                    f"name them {other}_{axis}, ..., or say {say_column(f'{other}_{axis}', '...')}"
                )
                self.notes.append(
                    f"the coordinates are taken as the {ENDS[moving]}'s; if not, {rename}"
                )
            return moving, ends.pop("")
        # Both ends are named and the receiver never moves: the rows are places of the transmitter.
        if len(named) == 2 and len(np.unique(ends["rx_"].all(), axis=0)) == 1:
            named = ["tx_"]
        return named[0][:2], ends.pop(named[0])

    def _stations(self, measured: str | None, end_places: dict[str, Places]) -> StationList | None:
        """The stations, where there are; an end that is their place is taken out of
        `end_places`.
        """
        where = places.read_places(self.sheet, self.chosen, "station_")
        labels = tuple(c.label for c in self.chosen[measured]) if measured in heads.LEVELS else ()
        for label in [label for i, label in enumerate(labels) if label in labels[:i]]:
            self.refuse(f"two columns of the station {label!r}; rename one")
        if len(labels) > 1:
            return self._wide(labels, where, next(iter(end_places.values())).degrees)
        columns = self.chosen.get("station", ())
        if not columns:
            # A list of one station needs no column: every row can only be of it.
            if self.listed is not None and len(self.listed.names) == 1:
                return self._by_list(np.array(self.listed.names * len(self.sheet.rows)))
            if self.listed is not None:
                fault = "no column says which station a row is of"
                return self.refuse(f"{fault}; say dataset.columns.station=COLUMN")
            if (
                where is None
                and len(end_places) > 1
                and all(end.degrees for end in end_places.values())
            ):
                # Stations are fewer than the places that were measured at, whichever end they are.
                few = min(end_places, key=lambda end: len(np.unique(end_places[end].all(), axis=0)))
                where = end_places.pop(few)
            return None if where is None else self._unnamed(where)
        words, head = self.sheet.joined(c.head for c in columns), columns[0].head or ""
        if self.listed is not None:
            plain = self.sheet.joined([head])
            listed, joined = self.listed.use_names_of(plain), self.listed.use_names_of(words)
            exact = columns[0].label == JOINED and bool(columns[0].word)
            # Where the list knows the names without what other columns add to them,
            # these are taken.
            is_listed = set(plain) <= set(listed.names)
            words = plain if exact and is_listed else words
            # What other columns add to a listed name stands where that does: antennas, carriers,
            # devices.
            is_finer = is_listed and not set(words) <= set(joined.names)
            self.listed = (
                listed.part_by(plain, words) if is_finer else listed if words is plain else joined
            )
        nameless = f"no station; expected its name{self._complete_names()}"
        self.sheet.refuse_rows(head, np.flatnonzero(words == ""), nameless)
        if self.listed is not None:
            self._all_listed(words, head)
            return None if self.sheet.problems else self._by_list(words)
        index, distinct = pd.factorize(words)  # in the order of their first rows
        names = tuple(map(str, distinct))
        if where is not None:
            each = places.place_per_station(self.sheet, where, index, names)
            return None if each is None else StationList(names, each, index=index)
        if self.sheet.problems:
            return None
        ends = [end for end in ("tx_", "rx_") if end in end_places] if len(end_places) > 1 else []
        for end in ends:
            # A place that differs among a station's rows is no error yet:
            # the other end may be the station's.
            each = places.place_per_station(self.sheet, end_places[end], index, names, ask=True)
            if each is not None:
                end_places.pop(end)
                return StationList(names, each, index=index)
        if ends:
            places.place_per_station(self.sheet, end_places[ends[0]], index, names)
            return None
        if measured not in heads.LEVELS and len(names) == 1:
            return None  # the only transmitter: dataset.tx_position says where it is
        if measured in heads.LEVELS:
            return self._nowhere(names, next(iter(end_places.values())).degrees, index)
        fault = (
            "stations without places; add columns station_x, station_y, station_z (or station_lat, "
        )
        return self.refuse(fault + "station_lon), or say dataset.stations_file=FILE")

    def _complete_names(self) -> str:
        """The setting of columns that name a station in every row, for messages;
        empty without any.
        """
        full = [head for head in self.sheet.heads if (self.sheet.words(head) != "").all()]
        for head in full:
            for parts in [
                heads.TOGETHER[word] for word in heads.words_of(head) if word in heads.TOGETHER
            ]:
                names = [head, *[other for other in full if parts & {*heads.words_of(other)}]]
                if len(names) > 1:
                    return f", or {say_column('station', '+'.join(names))}, which no row lacks"
        return ""

    def _nowhere(
        self, names: tuple[str, ...], degrees: bool, index: np.ndarray | None = None
    ) -> StationList:
        """Stations at places that nobody gave."""
        self.notes.append(
            "no places of the stations: unknown; dataset.stations_file=FILE gives them"
        )
        return StationList(names, Places.unknown(len(names), degrees), index=index)

    def _wide(
        self, labels: tuple[str, ...], where: Places | None, degrees: bool
    ) -> StationList | None:
        if self.listed is None and where is not None:
            fault = f"{len(labels)} columns of stations in one place for all columns"
            return self.refuse(f"{fault}; say dataset.stations_file=FILE (name, x, y, z)")
        if self.listed is None:
            return self._nowhere(labels, degrees)
        self._all_listed(np.array(labels), None)
        names = self.listed.label or self.listed.names
        silent = [
            title
            for title, name in zip(names, self.listed.names, strict=True)
            if name not in labels
        ]
        if self.sheet.problems:
            return None
        self._note_silent("without a column, and left out", silent)
        # The list's order and that of the columns differ: levels stay,
        # facts of stations are reordered.
        order = np.array([self.listed.names.index(label) for label in labels])
        for role in PER_STATION:
            if role in self.listed.extra:
                self.arrays[role] = self.listed.extra[role][order]
        label = None if self.listed.label is None else tuple(self.listed.label[i] for i in order)
        return StationList(labels, self.listed.places.take(order), label=label)

    def _all_listed(self, words: np.ndarray, head: str | None) -> None:
        """Refuse names that the list of stations does not have."""
        assert self.listed is not None
        if (wrong := self.listed.shared_name_problem(words)) is not None:
            return self.refuse(wrong)
        if head is not None:
            self.listed = self.listed.add_missing(words, self.notes)
        names = {"", *self.listed.names}
        unlisted = [word for word in dict.fromkeys(words.tolist()) if word not in names]
        if unlisted:
            place = "the heads" if head is None else f"column {head!r}"
            hint = suggest_name(unlisted[0], self.listed.names)
            fault = f"{list_first([*map(repr, unlisted)])}: no listed station"
            fault += hint or f"; the list has {list_first(self.listed.names)}"
            self.sheet.problems.add(f"{self.sheet.source}, {place}", fault)

    def _by_list(self, words: np.ndarray) -> StationList:
        assert self.listed is not None
        index = pd.Index(self.listed.names).get_indexer(words)
        self.arrays |= self.listed.extra
        self._note_silent("heard in no row, and kept", np.delete(self.listed.names, index).tolist())
        return replace(self.listed, index=index)

    def _note_silent(self, where: str, names: list[str]) -> None:
        if names:
            self.notes.append(f"stations of the list, {where}: {list_first(names, 8)}")

    def _unnamed(self, where: Places) -> StationList | None:
        """Stations told apart by their places alone."""
        values, index = np.unique(where.all(), axis=0, return_inverse=True)
        # A station for each row or two would be a moving end taken for stations.
        if len(values) > max(1, len(self.sheet) // 2):
            fault = f"{len(values)} places of stations in {len(self.sheet)} rows"
            return self.refuse(f"{fault}; stations stay where they are")
        each = Places(values[:, :2], values[:, 2] if values.shape[1] > 2 else None, where.degrees)
        names = tuple(f"station {i}" for i in range(len(values)))
        return StationList(names, each, index=index.reshape(-1))

    def _add_places(self, name: str, where: Places, still: bool = False) -> None:
        """Add positions [m], or degrees and heights."""
        height = places.UNKNOWN_HEIGHT if where.height is None else where.height
        if where.height is None:
            note = (
                f"no height of the {ENDS.get(name, 'stations')}: taken as "
                f"{places.UNKNOWN_HEIGHT:g} m"
            )
            self.notes.append(note if name in ENDS else Caution(note))
        # Equal heights are kept as one: schema arrays of shape () hold for all rows.
        elif len(np.unique(where.height)) == 1:
            height = where.height[0]
        if where.degrees:
            before = "station_" if name == "station" else ""
            self.arrays[f"{before}latitude"] = where.across[:, 0]
            self.arrays[f"{before}longitude"] = where.across[:, 1]
        else:
            values = where.all()
            self.arrays[f"{name}_position"] = values[0] if still else values
        if where.degrees or where.height is None:
            self.arrays[f"{name}_height"] = np.asarray(height)
