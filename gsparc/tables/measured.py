"""Levels, powers or channels out of the columns of a table."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np
import pandas as pd

from gsparc.base.errors import Caution
from gsparc.data.target import MOST_DB
from gsparc.data.units import UNITS
from gsparc.tables import heads
from gsparc.tables.column import Chosen, Column, name_block, name_columns
from gsparc.tables.other_names import join_polar
from gsparc.tables.own_checks import LOWEST_HZ
from gsparc.tables.sheet import MEASURED, Answer, Sheet
from gsparc.tables.station_list import StationList

# Arbitrary strength units (3GPP TS 27.007, 8.5); LTE counts up to 97
UNKNOWN_ASU, MOST_GSM = 99, 31


class Measured:
    """Takes the measurement out of a table: levels, powers or channels, and their frequencies."""

    def __init__(self, sheet: Sheet, chosen: Chosen, listed: StationList | None) -> None:
        self.sheet, self.chosen, self.listed = sheet, chosen, listed
        self.refuse, self.notes = sheet.refuse, sheet.notes
        self.arrays: dict[str, np.ndarray] = {}
        self.tones = np.zeros(1, int)

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
