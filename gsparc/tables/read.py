"""From a file that is a table to the named arrays of the schema."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.base.errors import Caution, DataError, Problems, list_first, suggest_name
from gsparc.data.schema import ENDS, OTHER
from gsparc.data.units import UNITS, WATTS
from gsparc.tables import heads, places
from gsparc.tables.advice import advise
from gsparc.tables.amplitudes import join_polar
from gsparc.tables.column import JOINED, Chosen, Column, name_block, name_columns
from gsparc.tables.columns import choose_columns, list_roles
from gsparc.tables.columns_file import edited_beside, read_columns
from gsparc.tables.links.stations import PER_STATION
from gsparc.tables.opening import read_sheet
from gsparc.tables.own_checks import LOWEST_HZ, MOST_DB
from gsparc.tables.places import Places, StationList
from gsparc.tables.raw import Raw
from gsparc.tables.roles import Answer, Role, Said, say_column, settle
from gsparc.tables.sheet import MEASURED, Sheet
from gsparc.tables.slots import unfold_slots, unfold_tones
from gsparc.tables.times import read_times


def parse_table(
    path: str | Path,
    columns: Mapping[str, object] = {},
    stations_file: str | Path | None = None,
    stations: Collection[str] = (),
    guess: bool = False,
    columns_file: str | Path | None = None,
) -> Raw:
    """Read the arrays of a table; notes say what was guessed.

    Args:
        path: *.csv, *.tsv, *.txt or *.parquet.
        columns: column by quantity (`heads.KINDS`) where a guess will not do; a number stands for
            all rows, a pattern with a `*` or a list for a column per station.
        stations_file: a second table: name, x, y, z or latitude, longitude, height of each station.
        stations: names in place of such a list: where heads hold them, no others are levels.
        guess: whether the likeliest reading of what is open is taken, and noted.
        columns_file: that says what columns are (`columns_file`); None: the one beside the table,
            if somebody edited it.

    Raises:
        DataError: all questions and problems, with row and column.
    """
    sheet, listed = read_sheet(path), None
    if stations_file is not None:
        listed = places.read_stations(
            replace(read_sheet(stations_file, sheet.problems), notes=sheet.notes)
        )
        sheet.problems.raise_if_any()

    def build(said: Said) -> tuple[Raw | None, list[Role], tuple[str, ...]]:
        asked = list[Role]()
        fresh = replace(sheet, problems=Problems(path), notes=[*sheet.notes], asked=asked)
        fresh = replace(fresh, marks=Counter())
        raw = _build(fresh, said, listed, stations)
        return raw, asked, tuple(fresh.problems)

    said: dict[str, object] = {}
    about = edited_beside(path) if columns_file is None else Path(columns_file)
    if about is not None:
        said |= read_columns(about, sheet.heads)
        sheet.notes.append(f"columns are what {about} says")
    given = {key: value for key, value in columns.items() if value is not None}
    others = {heads.OTHER_NAMES.get(key, key) for key in given}
    said = {key: value for key, value in said.items() if key not in others} | given
    settled = settle(build, said, sheet.source)
    questions, raw = [role.question() for role in settled.asked], settled.raw
    if questions and not guess:
        raise DataError([f"{sheet.source}: {question}" for question in questions], path)
    roles = (*settled.asked, *raw.roles)
    notes = (*questions, *raw.notes)
    return replace(raw, notes=notes, said=settled.said, roles=roles, heads=sheet.heads)


def _build(
    sheet: Sheet, columns: Said, listed: StationList | None, stations: Collection[str]
) -> Raw | None:
    """The arrays; None where something is wrong, or open."""
    given, whole = columns, sheet
    sheet, columns = unfold_slots(sheet, columns)
    sheet = unfold_tones(sheet)
    # The list of stations comes before the columns:
    # heads that hold its names are levels of stations.
    labelled: dict[str, str] = {}
    if listed is not None:
        parts = {head: heads.station_in_head(head) for head in sheet.heads}
        listed, labelled = listed.match_heads(parts)
    elif stations:
        sheet, labelled = _name_levels(sheet, stations)
    chosen = choose_columns(sheet, columns, labelled)
    # Everything after this trusts the choice of columns, so its problems are raised alone.
    if sheet.problems:
        return None
    sheet = places.drop_rows_without_place(sheet, chosen)
    arrays = Builder(sheet, chosen, listed).build()
    if sheet.is_open():
        return None
    power = next((chosen[role][0] for role in heads.LEVELS if role in chosen), None)
    about = {}
    if power is not None and "rssi_db" in chosen:
        about["level_unit"] = power.schema_unit
    # A column that is scaled has the schema's unit.
    if (
        power is not None
        and power.unit is not None
        and power.unit.name in WATTS
        and not power.unit.times
    ):
        about["unit"] = power.unit.name

    def reads(said: Said) -> Raw | None:
        again = replace(whole, problems=Problems(sheet.source), notes=[], asked=[])
        return _build(again, {**given, **said}, listed, stations)

    explain = partial(advise, sheet, chosen, reads)
    roles = tuple(list_roles(sheet, chosen, given))
    return Raw(arrays, about, notes=tuple(sheet.notes), explain=explain, roles=roles)


def _name_levels(sheet: Sheet, stations: Collection[str]) -> tuple[Sheet, dict[str, str]]:
    """Return a table with levels of these stations alone, if heads name any,
    and names by these heads.
    """
    roles = {head: heads.parse_head(head).role for head in sheet.heads}
    free = [head for head, role in roles.items() if role in (*heads.LEVELS, "station", None)]
    parts = {head: (heads.station_in_head(head), head) for head in free}
    levels = {head: name for head, names in parts.items() for name in names if name in stations}
    others = [
        head for head in free if levels and head not in levels and roles[head] in heads.LEVELS
    ]
    if others:
        which = list_first([*map(repr, others)])
        sheet.notes.append(
            Caution(f"columns {which} are of no station that was measured, and not used")
        )
    frame = sheet.frame.drop(columns=others)
    # A single column is of no station by itself
    if len(levels) == 1 and "station" not in roles.values():
        frame = frame.assign(station=next(iter(levels.values())))
    return replace(sheet, frame=frame), levels


# Arbitrary strength units (3GPP TS 27.007, 8.5); LTE counts up to 97
UNKNOWN_ASU, MOST_GSM = 99, 31


class Builder:
    """Takes arrays out of a table, noting what is wrong."""

    def __init__(self, sheet: Sheet, chosen: Chosen, listed: StationList | None) -> None:
        self.sheet, self.chosen, self.listed = sheet, chosen, listed
        self.refuse, self.notes = sheet.refuse, sheet.notes
        self.arrays: dict[str, np.ndarray] = {}
        self.tones = np.zeros(1, int)

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

    def _measurement(self) -> str | None:
        """Add the measurement; its quantity."""
        role = next((name for name in heads.MANY if name in self.chosen), None)
        if role is None:
            if not self._is_asked(heads.MANY):
                self._ask_measurement()
            return None
        if role not in heads.LEVELS:
            self._channels(heads.CHANNELS if role in heads.CHANNELS else heads.POLAR)
            return role
        columns = self.chosen[role]
        levels = [column.numbers(self.sheet) for column in columns]
        if any(values is None for values in levels):
            return role
        values = np.stack([v for v in levels if v is not None], axis=1)
        # Tells an empty column from a bad value: one message instead of one a row.
        if np.isnan(values).all():
            self.refuse("no value in any row", columns[0].head or "")
        for text, count in self.sheet.marks.items():
            note = f"{count} of {values.size} levels are {text!r}: taken as not heard"
            self.notes.append(
                Caution(f"{note}, below the weakest; dataset.not_heard=[] refuses them")
            )
        first = columns[0]
        guessed = role == "rssi_db" and first.unit is None and first.word not in ("", role)
        # Received levels in dBm are below 0: a column without one is a power, a share,
        # or lost its sign.
        names = [column.head or "" for column in columns]

        same = name_block(self.sheet, names)

        def times(factor: str) -> object:
            listed = isinstance(same, list)
            return [f"{name}*{factor}" for name in names] if listed else f"{same}*{factor}"

        # The head says neither decibels nor watts
        if guessed and np.isfinite(values).any() and not (values < 0).any():
            why = f"{name_columns(names)}: no value below 0: dBm without a minus sign, W or dBm"
            self._ask(why, names[0], rssi_db=[times("-1")], rssi=[same])
        size = np.median(np.abs(np.unique(values[np.isfinite(values)])))  # a mark counts once
        if role == "rssi_db" and size > MOST_DB and first.head and first.unit is None:
            why = f"{name_columns(names)}: most of it is beyond {MOST_DB} dB: in parts of a dB"
            factor = f"{10.0 ** -np.ceil(np.log10(size / MOST_DB)):g}"
            self._ask(why, names[0], rssi_db=[times(factor)])
        self.arrays[role] = values[:, 0] if len(columns) == 1 else values
        return role

    def _is_asked(self, roles: Collection[str]) -> bool:
        """Whether a question about one of these quantities is open."""
        return any(role.role in roles for role in self.sheet.asked or ())

    def _ask(self, why: str, head: str, **ways: Sequence[object]) -> None:
        """Ask about a column, by quantity what it may be."""
        cell = self.sheet.first_cell(head)
        answers = [Answer({role: way}, cell) for role, each in ways.items() for way in each]
        self.sheet.ask(why, *answers)

    def _ask_measurement(self) -> None:
        """Ask about a column that may be turned into levels, else refuse the table."""
        fault = f"no column of levels, powers or channels among {self.sheet.first_heads()}"
        for head in self.sheet.heads:
            words = {*heads.words_of(head)}
            if {"loss", "pathloss", "pl"} & words:
                return self._ask(f"{fault}; {head!r} are losses", head, rssi_db=[f"{head}*-1"])
            if "asu" in words:
                asu = pd.to_numeric(self.sheet.frame[head], errors="coerce")
                # Of LTE these would all be weak
                low = (asu[asu != UNKNOWN_ASU] <= MOST_GSM).all()
                ways = [f"{head}*2-113", f"{head}-140"] if low else [f"{head}-140"]
                why = f"{fault}; {head!r} is ASU, {'of GSM (times 2) or LTE' if low else 'of LTE'}"
                return self._ask(why, head, rssi_db=ways)
            if {"quality", "percent", "pct"} & words:
                return self.refuse(f"{fault}; {head!r} is {heads.PERCENT}")
        numbered = Counter(re.sub(r"\d+(?=\D*$)", "*", head) for head in self.sheet.heads)
        family, count = numbered.most_common(1)[0]
        alike = (
            (f"'{family}' (levels) or .csi_amp='{family}' (amplitudes)") if count > 1 else "COLUMN"
        )
        self.refuse(f"{fault}; say dataset.columns.rssi_db={alike}")

    def _channels(self, names: tuple[str, str]) -> None:
        """Add channels of columns of real and imaginary parts, or of amplitudes and phases."""
        pairs = [self._tones(part) for part in names]
        # A tone may lack one of its two columns: both sets are joined,
        # so that the lacking one is named.
        amplitudes = names == heads.POLAR and not pairs[1]
        self.tones = np.array(sorted(set(pairs[0]) | set(pairs[1])))
        for name, tones, other in zip(names, pairs, pairs[::-1], strict=True):
            for tone in [] if amplitudes else sorted(set(other) - set(tones)):
                fault = f"{other[tone].head!r} has no {name} beside it"
                self.refuse(f"{fault}; say dataset.columns.{name}=COLUMN")
        parts = [
            [part[tone].numbers(self.sheet) for tone in sorted(part)] for part in pairs if part
        ]
        if self.sheet.problems:
            return
        if amplitudes:
            self.arrays["csi"] = np.stack([v for v in parts[0] if v is not None], axis=1)
            if (self.arrays["csi"] < 0).any():
                head = pairs[0][self.tones[0]].head or ""
                self.refuse(
                    "amplitudes below 0: levels? say dataset.columns.rssi_db='NAME_*'", head
                )
            return
        first, second = (np.stack([v for v in part if v is not None], axis=1) for part in parts)
        csi = first + 1j * second
        if names == heads.POLAR:
            csi, notes = join_polar(first, second, [pair[self.tones[0]].unit for pair in pairs])
            self.notes += notes
        csi = csi[:, 0] if csi.shape[1] == 1 else csi
        self.arrays["csi"] = csi
        if np.isnan(csi).any():
            self.arrays["mask"] = ~np.isnan(csi)

    def _tones(self, part: str) -> dict[int, Column]:
        """Columns by the number of their tone, which may be negative; 0 of a single one without."""
        tones: dict[int, Column] = {}
        for column in self.chosen.get(part, ()):
            label = column.label.strip(" _.:()[]")
            frequency = MEASURED.fullmatch(label)
            if (
                frequency
                and frequency[2].lower() in UNITS
                and UNITS[frequency[2].lower()].kind == "frequency"
            ):
                label = f"{UNITS[frequency[2].lower()].factor * float(frequency[1]):.0f}"
            # A sign belongs to the number: tones -1 and 1 lie on both sides of the carrier.
            if not re.fullmatch(r"[-+]?\d+|", label):
                fault = f"{label!r} is no number of a tone; name columns csi_re_-2, csi_re_1, ..."
                self.refuse(f"{fault}, or say dataset.columns.{part}='NAME*'", column.head or "")
            elif tones.setdefault(int(label or 0), column) is not column:
                other = tones[int(label or 0)].head
                self.refuse(f"the same tone as {other!r}; rename one", column.head or "")
        return tones

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

    def _of_rows(self, role: str) -> np.ndarray | None:
        """Numbers (S,) of rows, () where all are one."""
        values = self.chosen[role][0].numbers(self.sheet)
        if values is None:
            return None
        different = np.unique(values[~np.isnan(values)])
        return different[0] if len(different) == 1 else values

    def _frequency(self, channels: bool) -> None:
        """Add frequencies of tones, or the carrier."""
        if channels and self.tones.min() >= LOWEST_HZ:
            self.arrays["frequency_hz"] = self.tones.astype(float)
        ends = self.chosen["frequency_hz"][0].value if "frequency_hz" in self.chosen else ()
        if len(ends) == 2:
            if not channels or len(self.tones) == 1:
                return self.refuse(
                    f"dataset.columns.frequency_hz: two frequencies {ends} for one tone"
                )
            # First and last frequency stand for the first and the last tone;
            # gaps between them stay gaps.
            self.arrays["frequency_hz"] = np.interp(self.tones, self.tones[[0, -1]], ends)
            if np.ptp(np.diff(self.tones)):
                self.notes.append("frequency_hz: spaced as the numbers of the tones are, with gaps")
        if channels and "spacing_hz" in self.arrays:
            middle = 0 if self.tones.min() < 0 else self.tones[len(self.tones) // 2]
            self.arrays["frequency_hz"] = (self.tones - middle) * self.arrays.pop("spacing_hz")
        if "carrier_hz" not in self.chosen:
            return
        column = self.chosen["carrier_hz"][0]
        values = self._of_rows("carrier_hz")
        if values is None:
            return
        # Stations are told apart by their carriers: a row without one would be of none.
        unknown = np.flatnonzero(np.isnan(values))
        self.sheet.refuse_rows(column.head, unknown, "no value; expected a frequency")
        # Numbers of 100 to 1e5 without a unit are MHz in the logs of phones and scanners;
        # GHz are below 100.
        if (
            column.unit is None
            and column.head
            and np.nanmin(values) >= 100
            and np.nanmax(values) < LOWEST_HZ
        ):
            values = 1e6 * values
            self.notes.append(
                f"column {column.head!r}: values below {LOWEST_HZ:g} are taken as MHz"
            )
        self.arrays["carrier_hz"] = values
        # Only a single tone lies at the carrier itself.
        if channels and not np.ndim(values) and self.arrays["csi"].ndim == 1:
            self.arrays.setdefault("frequency_hz", values)
